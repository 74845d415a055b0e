"""Sound files of other formats: every number arrives, in the right row, and the converter writes what was read."""

import contextlib
import errno
import io
import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest

from ccil_jax.demonstrations import formats, hdf5, hdf5_child
from ccil_jax.demonstrations.trajectories import Demonstrations, load_demonstrations, save_demonstrations
from ccil_jax.errors import DemonstrationsError, UserError
from experiments import convert

LENGTHS = (3, 4, 2)
RNG = np.random.default_rng(0)
OBS = [RNG.normal(size=(n, 8)).astype(np.float32) for n in LENGTHS]
ACTIONS = [RNG.normal(size=(n, 2)).astype(np.float32) for n in LENGTHS]
REWARDS = [RNG.normal(size=n).astype(np.float32) for n in LENGTHS]
COSTS = [np.array(c, np.float32) for c in ([0, 1, 1], [1, 0, 0, 2], [0, 0])]


def objects(parts: list[Any]) -> np.ndarray:
    array = np.empty(len(parts), object)
    array[:] = parts
    return array


def legacy(path: Path, *, protocol_names: str = "numpy._core", **changes: Any) -> Path:
    arrays = {
        "obs": objects(OBS),
        "acs": objects(ACTIONS),
        "rews": objects([list(map(float, r)) for r in REWARDS]),
        "ep_rets": np.array([r.sum() for r in REWARDS]),
        "costs": np.array([c.sum() for c in COSTS]),
        "accucost": objects([list(np.cumsum(c)) for c in COSTS]),  # boxed numbers in lists
        **changes,
    }
    np.savez(path, allow_pickle=True, **{k: v for k, v in arrays.items() if v is not None})
    if protocol_names != "numpy._core":  # as NumPy 1 wrote it, stored without compression and checksum untouched
        import zipfile

        with zipfile.ZipFile(path) as archive:
            members = {n: archive.read(n) for n in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in members.items():
                archive.writestr(name, _renamed(content))
    return path


def _renamed(content: bytes) -> bytes:
    """A member whose pickle, if it is one, names NumPy 1's module (protocol 3, where names are lines of text)."""
    import io
    import pickle

    file = io.BytesIO(content)
    array = np.lib.format.read_array(file, allow_pickle=True)
    if not array.dtype.hasobject:
        return content
    file.seek(0)
    np.lib.format.read_magic(file)
    np.lib.format.read_array_header_1_0(file)
    header = content[: file.tell()]
    return header + pickle.dumps(array, protocol=3).replace(b"numpy._core.multiarray", b"numpy.core.multiarray")


def dsrl(path: Path, **changes: Any) -> Path:
    ends = np.cumsum(LENGTHS) - 1
    terminals, timeouts = np.zeros((2, sum(LENGTHS)), bool)
    terminals[ends[0]], timeouts[ends[1:]] = True, True
    arrays = {
        "observations": np.concatenate(OBS),
        "next_observations": np.concatenate(OBS),
        "actions": np.concatenate(ACTIONS),
        "rewards": np.concatenate(REWARDS),
        "costs": np.concatenate(COSTS),
        "terminals": terminals,
        "timeouts": timeouts,
        **changes,
    }
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            if array is not None:
                file.create_dataset(name, data=array, compression="gzip")
    return path


def minari(folder: Path, *, cost: str | None = "cost", extra: int = 1) -> Path:
    (folder / "data").mkdir(parents=True)
    with h5py.File(folder / "data" / "main_data.hdf5", "w") as file:
        for i, length in enumerate(LENGTHS):
            group = file.create_group(f"episode_{i + 8}")  # 8, 9, 10: their order is not that of their names
            group["observations"] = np.concatenate([OBS[i], np.full((1, 8), 9, np.float32)])
            group["actions"], group["rewards"] = ACTIONS[i], REWARDS[i]
            group["terminations"] = (np.arange(length) == length - 1) & (i == 0)
            group["truncations"] = (np.arange(length) == length - 1) & (i > 0)
            if cost is not None:
                group[f"infos/{cost}"] = np.concatenate([np.full(extra, 7, np.float32), COSTS[i]])
    (folder / "data" / "metadata.json").write_text(json.dumps({"dataset_id": "swimmer/expert-v0", "x": 1}))
    return folder


def assert_arrived(path: Path, *, flags: bool) -> None:
    found = load_demonstrations(path)
    np.testing.assert_array_equal(found.obs, np.concatenate(OBS))
    np.testing.assert_array_equal(found.actions, np.concatenate(ACTIONS))
    np.testing.assert_array_equal(found.rewards, np.concatenate(REWARDS))
    np.testing.assert_array_equal(found.costs, np.concatenate(COSTS))
    np.testing.assert_array_equal(found.episode_ends, [3, 7, 9])
    np.testing.assert_array_equal(found.episode_costs, [2, 3, 0])
    assert np.flatnonzero(found.terminated).tolist() == ([2] if flags else [])
    assert np.flatnonzero(found.truncated).tolist() == ([6, 8] if flags else [])


@pytest.fixture
def hdf5_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reader of HDF5 without the process that protects us from strangers' files: these are our own, and many."""

    def run_child(arguments: Sequence[str]) -> tuple[int, str]:
        with contextlib.redirect_stderr(io.StringIO()) as complaint:
            return hdf5_child.main(arguments), complaint.getvalue().strip()

    monkeypatch.setattr(hdf5_child, "limit_resources", lambda max_bytes: None)
    monkeypatch.setattr(hdf5, "run_child", run_child)


ENDS = np.array([3, 6])  # of the two episodes that the writers below split their arrays into
SOUND: dict[str, np.ndarray] = {
    "obs": np.arange(48.0).reshape(6, 8),
    "actions": np.linspace(-1, 1, 12).reshape(6, 2),
    "rewards": np.array([1.0, 0, 0, 1, 1, 0]),
    "costs": np.array([0.0, 1, 1, 0, 0, 1]),
    "terminated": np.zeros(6, bool),
    "truncated": np.isin(np.arange(6), ENDS - 1),
}


def write_own(folder: Path, arrays: dict[str, np.ndarray]) -> Path:
    np.savez(folder / "own.npz", **arrays, episode_ends=ENDS[:, None], metadata=np.array("{}"))
    return folder / "own.npz"


def write_saved(folder: Path, arrays: dict[str, np.ndarray]) -> Path:
    save_demonstrations(folder / "saved.npz", Demonstrations(**arrays, episode_ends=ENDS[:, None]))
    return folder / "saved.npz"


def write_baselines(folder: Path, arrays: dict[str, np.ndarray]) -> Path:
    names = {"obs": "obs", "acs": "actions", "rews": "rewards", "costs": "costs"}
    np.savez(folder / "b.npz", **{new: np.stack(np.split(arrays[old], ENDS[:1])) for new, old in names.items()})
    return folder / "b.npz"


def write_dsrl(folder: Path, arrays: dict[str, np.ndarray]) -> Path:
    names = {"obs": "observations", "terminated": "terminals", "truncated": "timeouts"}
    with h5py.File(folder / "d.hdf5", "w") as file:
        file.update({names.get(key, key): array for key, array in arrays.items()})
    return folder / "d.hdf5"


def write_minari(folder: Path, arrays: dict[str, np.ndarray]) -> Path:
    """With a reset that costs NaN, where the type of the costs knows it, or else 7."""
    names = {"obs": "observations", "terminated": "terminations", "truncated": "truncations", "costs": "infos/cost"}
    (folder / "m" / "data").mkdir(parents=True)
    with h5py.File(folder / "m" / "data" / "main_data.hdf5", "w") as file:
        for key, array in arrays.items():
            for i, part in enumerate(np.split(array, ENDS[:1])):
                row = np.full((1, *part.shape[1:]), np.nan if part.dtype.kind == "f" else 7).astype(part.dtype)
                parts = {"costs": [row, part], "obs": [part, np.zeros_like(row)]}.get(key, [part])
                file[f"episode_{i}/{names.get(key, key)}"] = np.concatenate(parts)
    return folder / "m"


WRITERS: dict[str, Callable[[Path, dict[str, np.ndarray]], Path]] = {
    "own": write_own,
    "saved": write_saved,
    "baselines": write_baselines,
    "dsrl": write_dsrl,
    "minari": write_minari,
}
NAMES = {  # what a format calls costs, rewards and flags; baselines know no flags
    "own": ("costs", "rewards", "truncated"),
    "saved": ("costs", "rewards", "truncated"),
    "baselines": ("costs' of trajectory 0", "rews' of trajectory 0", None),
    "dsrl": ("costs", "rewards", "timeouts"),
    "minari": ("episode_0/infos/cost", "episode_0/rewards", "episode_0/truncations"),
}


def assert_sound(found: Demonstrations, *, flags: bool) -> None:
    for key in ("obs", "actions", "rewards", "costs"):
        np.testing.assert_array_equal(getattr(found, key), SOUND[key].astype(np.float32))
        assert getattr(found, key).dtype == np.float32
    np.testing.assert_array_equal(found.episode_ends, ENDS)
    assert found.truncated.tolist() == (SOUND["truncated"].tolist() if flags else [False] * 6)
    assert found.truncated.dtype == np.bool_


@pytest.mark.usefixtures("hdf5_in_this_process")
@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("kind", [np.bool_, np.uint8, np.int64, np.float32])
@pytest.mark.parametrize("in_columns", [False, True])
def test_numbers_and_flags_of_every_kind_are_the_same(
    tmp_path: Path, writer: str, kind: type, in_columns: bool
) -> None:
    arrays = {**SOUND, **{key: SOUND[key].astype(kind) for key in SOUND if SOUND[key].ndim == 1}}
    if in_columns:
        arrays = {
            key: array[:, None] for key, array in arrays.items()
        }  # also [6, 1, 8], of one environment side by side
    assert_sound(load_demonstrations(WRITERS[writer](tmp_path, arrays)), flags=writer != "baselines")


@pytest.mark.usefixtures("hdf5_in_this_process")
@pytest.mark.parametrize("writer", WRITERS)
def test_vectors_are_one_column(tmp_path: Path, writer: str) -> None:
    arrays = {**SOUND, "obs": np.arange(6.0), "actions": np.linspace(-1, 1, 6)}
    found = load_demonstrations(WRITERS[writer](tmp_path, arrays))
    np.testing.assert_array_equal(found.obs, np.arange(6, dtype=np.float32)[:, None])
    np.testing.assert_array_equal(found.actions, np.linspace(-1, 1, 6, dtype=np.float32)[:, None])


@pytest.mark.usefixtures("hdf5_in_this_process")
@pytest.mark.parametrize("writer", WRITERS)
def test_several_values_a_step_are_refused_by_name_and_shape(tmp_path: Path, writer: str) -> None:
    for key, name in zip(("costs", "rewards", "truncated"), NAMES[writer], strict=True):
        if name is not None:
            (tmp_path / key).mkdir()
            wide = np.repeat(SOUND[key][:, None], 2, axis=1)
            with pytest.raises(DemonstrationsError, match=rf"'{name}.* has shape \(\d, 2\), must have shape \(\d,\)"):
                load_demonstrations(WRITERS[writer](tmp_path / key, {**SOUND, key: wide}))


@pytest.mark.usefixtures("hdf5_in_this_process")
@pytest.mark.parametrize("writer", [name for name in WRITERS if NAMES[name][2]])
def test_flags_other_than_0_and_1_are_refused(tmp_path: Path, writer: str) -> None:
    arrays = {**SOUND, "truncated": np.array([0, 0, 2, 0, 0, 1.0])}
    with pytest.raises(DemonstrationsError, match=rf"'{NAMES[writer][2]}' holds 2\.0 \(row 2\), must hold flags"):
        load_demonstrations(WRITERS[writer](tmp_path, arrays))


@pytest.mark.usefixtures("hdf5_in_this_process")
@pytest.mark.parametrize("cost", [np.array([0, 0, 1, 1, 9.0]), np.zeros((4, 3)), np.array([b"x"] * 4), None])
def test_what_only_shares_the_name_of_costs_does_not_matter(tmp_path: Path, cost: np.ndarray | None) -> None:
    """A group, text or an array of several terms beside the costs; but not a second array of costs."""
    folder = write_minari(tmp_path, SOUND)
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        file["episode_0/infos/event"] = np.array([b"a"] * 4)
        if cost is None:
            file["episode_0/infos/costs/hazard"] = np.ones(4)
        else:
            file["episode_0/infos/costs"] = cost
    if cost is not None and cost.dtype.kind == "f" and cost.ndim == 1:
        with pytest.raises(DemonstrationsError, match=r"'episode_0/infos/costs' has shape \(5,\)"):
            load_demonstrations(folder)
    else:
        assert_sound(load_demonstrations(folder), flags=True)


@pytest.mark.usefixtures("hdf5_in_this_process")
def test_two_arrays_of_costs_must_agree(tmp_path: Path) -> None:
    folder = write_minari(tmp_path, SOUND)
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        file["episode_0/costs"] = SOUND["costs"][:3, None]
    assert_sound(load_demonstrations(folder), flags=True)
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        file["episode_0/costs"][...] = 1 - SOUND["costs"][:3, None]
    with pytest.raises(DemonstrationsError, match="'episode_0/infos/cost' and 'episode_0/costs' hold different costs"):
        load_demonstrations(folder)
    both = legacy(tmp_path / "both.npz", costs=objects(COSTS))
    np.testing.assert_array_equal(load_demonstrations(both).costs, np.concatenate(COSTS))
    other = legacy(tmp_path / "other.npz", costs=objects([COSTS[0], COSTS[1], np.array([0, 1.0])]))
    with pytest.raises(DemonstrationsError, match="'accucost' of trajectory 2 and 'costs' hold different costs"):
        load_demonstrations(other)


def test_a_default_cost_replaces_no_cost_that_the_file_has(tmp_path: Path) -> None:
    folder = minari(tmp_path / "m")
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        del file["episode_9/infos/cost"]
    with pytest.raises(DemonstrationsError, match="'episode_9' has no costs, other episodes have"):
        load_demonstrations(folder, default_cost=0.0)


def test_totals_are_no_costs_of_steps(tmp_path: Path) -> None:
    """[E] and [E, 1] are totals of the episodes; where every episode has one step, [E, 1] are its steps."""
    for i, totals in enumerate((np.ones(3), np.ones((3, 1)))):
        with pytest.raises(DemonstrationsError, match="holds no cost of each step"):
            load_demonstrations(legacy(tmp_path / f"{i}.npz", accucost=None, costs=totals))
    np.savez(tmp_path / "short.npz", obs=np.ones((3, 1, 8)), acs=np.ones((3, 1, 2)), costs=np.ones((3, 1)))
    np.testing.assert_array_equal(load_demonstrations(tmp_path / "short.npz").episode_costs, np.ones(3))


def test_other_arrays_in_our_own_file_do_not_matter(tmp_path: Path) -> None:
    extra = {"acs": np.zeros((6, 9)), "infos": np.array(["x"] * 6), "notes": objects([{"a": 1}])}
    assert_sound(load_demonstrations(write_own(tmp_path, {**SOUND, **extra})), flags=True)


@pytest.mark.usefixtures("hdf5_in_this_process")
def test_a_byte_order_mark_in_metadata_does_not_matter(tmp_path: Path) -> None:
    folder = minari(tmp_path / "m")
    facts = folder / "data" / "metadata.json"
    facts.write_bytes(b"\xef\xbb\xbf" + facts.read_bytes())
    assert load_demonstrations(folder).metadata["dataset_id"] == "swimmer/expert-v0"
    arrays = {**SOUND, "episode_ends": ENDS}
    for i, text in enumerate(
        (np.array('\ufeff{"task": "Ant"}'), np.frombuffer(b'\xef\xbb\xbf{"task": "Ant"}', np.uint8))
    ):
        np.savez(tmp_path / f"{i}.npz", **arrays, metadata=text)
        assert load_demonstrations(tmp_path / f"{i}.npz").metadata == {"task": "Ant"}


@pytest.mark.parametrize("names", ["numpy._core", "numpy.core"])
def test_object_arrays_of_either_numpy(tmp_path: Path, names: str) -> None:
    assert_arrived(legacy(tmp_path / "expert.npz", protocol_names=names), flags=False)


def test_costs_of_each_step_do_as_well_as_running_sums(tmp_path: Path) -> None:
    assert_arrived(legacy(tmp_path / "expert.npz", accucost=None, costs=objects(COSTS)), flags=False)


def test_episodes_of_equal_length_are_plain_arrays(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "e.npz", obs=np.ones((2, 3, 8)), acs=np.ones((2, 3, 1, 2)), accucost=np.ones((2, 3, 1)).cumsum(1)
    )
    found = load_demonstrations(tmp_path / "e.npz")
    assert found.obs.shape == (6, 8)
    assert found.actions.shape == (6, 2)
    np.testing.assert_array_equal(found.episode_costs, [3, 3])
    assert found.rewards is None


def test_a_pickle_of_python_2(tmp_path: Path) -> None:
    """As protocol 2 of Python 2 wrote an object array of one float64 vector [2.5, -1]: text and bytes are one type."""

    def text(value: bytes) -> bytes:
        return b"U" + bytes([len(value)]) + value

    def dtype(code: bytes, order: bytes) -> bytes:
        state = b"(K\x03" + text(order) + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
        return b"cnumpy\ndtype\n" + text(code) + b"K\x00K\x01\x87R" + state

    new = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
    inner = new + b"(K\x01K\x02\x85" + dtype(b"f8", b"<") + b"\x89" + text(np.array([2.5, -1.0]).tobytes()) + b"tb"
    content = b"\x80\x02" + new + b"(K\x01K\x01\x85" + dtype(b"O8", b"|") + b"\x89](" + inner + b"etb."
    from ccil_jax.demonstrations import pickled_npz

    np.testing.assert_array_equal(pickled_npz.unpickle(content, (1,), "x")[0][0], [2.5, -1.0])


def test_all_pickles_of_a_file_share_one_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ccil_jax.demonstrations import pickled_npz

    path = legacy(tmp_path / "expert.npz")
    monkeypatch.setattr(pickled_npz, "MAX_OPCODES", 320)  # obs and acs take 153 each, rews 84
    with pytest.raises(DemonstrationsError, match="'rews' takes the file past 320 opcodes of pickles"):
        load_demonstrations(path)


def test_dsrl(tmp_path: Path) -> None:
    assert_arrived(dsrl(tmp_path / "d.hdf5"), flags=True)
    flags = np.concatenate([(np.arange(n) == n - 1) for n in LENGTHS]).astype(np.float32)
    found = load_demonstrations(dsrl(tmp_path / "floats.hdf5", terminals=flags, timeouts=np.zeros(9)))
    np.testing.assert_array_equal(found.episode_ends, [3, 7, 9])


def test_steps_after_the_last_complete_episode_are_left_out(tmp_path: Path) -> None:
    found = load_demonstrations(dsrl(tmp_path / "d.hdf5", timeouts=np.arange(9) == 6))
    np.testing.assert_array_equal(found.episode_ends, [3, 7])
    assert found.num_steps == 7


@pytest.mark.parametrize(("cost", "extra"), [("cost", 1), ("costs", 0)])
def test_minari(tmp_path: Path, cost: str, extra: int) -> None:
    folder = minari(tmp_path / "expert-v0", cost=cost, extra=extra)
    assert_arrived(folder, flags=True)
    assert_arrived(folder / "data" / "main_data.hdf5", flags=True)
    assert load_demonstrations(folder).metadata == {"format": "minari", "dataset_id": "swimmer/expert-v0"}


def test_without_costs_only_where_a_default_is_given(tmp_path: Path) -> None:
    for path in (minari(tmp_path / "m", cost=None), legacy(tmp_path / "l.npz", accucost=None, costs=None)):
        with pytest.raises(DemonstrationsError, match="holds no cost of each step"):
            load_demonstrations(path)
        found = load_demonstrations(path, default_cost=0.5)
        np.testing.assert_array_equal(found.costs, np.full(9, 0.5))
        assert found.metadata["default_cost"] == 0.5  # so that a reader knows that nobody has measured them
    assert "default_cost" not in load_demonstrations(legacy(tmp_path / "own.npz"), default_cost=0.5).metadata


def test_the_converter_writes_what_was_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out" / "swimmer.npz"
    assert convert.main([str(legacy(tmp_path / "expert.npz")), "--env", "Swimmer", "--out", str(out)]) == 0
    assert "3 trajectories, 9 steps" in capsys.readouterr().out
    assert_arrived(out, flags=False)
    assert load_demonstrations(out).metadata["task"] == "Swimmer"


def test_the_converter_says_what_a_run_must_allow(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = write_own(tmp_path, SOUND), tmp_path / "out.npz"
    assert convert.main([str(path), "--env", "Swimmer", "--out", str(out)]) == 0
    assert "6 steps (at most 3 each)" in capsys.readouterr().out


def test_a_full_disk_ends_the_converter_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, out = write_own(tmp_path, SOUND), tmp_path / "out.npz"
    monkeypatch.setattr(np, "savez_compressed", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(SystemExit) as end:
        convert.main([str(path), "--env", "Swimmer", "--out", str(out)])
    assert end.value.code == 2
    assert f"--out {out}: cannot be written (No space left on device); make space" in capsys.readouterr().err


def test_the_converter_answers_wrong_use_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(legacy(tmp_path / "expert.npz"))
    out = ("--out", str(tmp_path / "out.npz"))
    for arguments, message in (
        ((path, "--env", "Ant", *out), "'obs' has 8 columns, Ant has obs_dim 27"),
        ((path, *out), "--env: required"),
        ((path, "--env", "Swimmer", "--out", path), "exists"),
        ((path, "--env", "Swimmer", "--out", "x.csv"), "named *.npz"),
        ((path, "--env", "Swimmer", *out, "--default-cost", "nan"), "--default-cost nan"),
        ((path, "--env", "Swimmer", *out, "--default-cost", "0"), "expert.npz has costs of its own; leave it out"),
    ):
        with pytest.raises(SystemExit) as end:
            convert.main(arguments)
        assert end.value.code == 2
        stderr = capsys.readouterr().err
        assert message in stderr
        assert stderr.count("\n") == 1
    assert not (tmp_path / "out.npz").exists()


# Formats from outside ------------------------------------------------------------------------------------------------

TABLES = '''
"""A user's own format: a text file, whose lines are step, action and observation, cost, reward, and how it ended."""
import numpy as np
from ccil_jax import Format

HEADER = "# swimmer steps"


def read(path):
    table = np.loadtxt(path, delimiter=",")
    ended = table[:, 12].astype(int)
    return {
        "obs": table[:, 2:10],
        "actions": table[:, :2],
        "costs": table[:, 10:11],
        "rewards": table[:, 11].tolist(),
        "terminated": ended == 1,
        "truncated": ended == 2,
        "episode_ends": np.flatnonzero(ended) + 1,
        "metadata": {"format": "tables"},
    }


def recognizes(path):
    return path.is_file() and path.read_bytes().startswith(HEADER.encode())


TABLES = Format(name="tables", recognizes=recognizes, read=read)
NOT_A_FORMAT = 3
'''


def write_table(path: Path) -> Path:
    ended = np.zeros(sum(LENGTHS))
    ended[np.cumsum(LENGTHS) - 1] = [1, 2, 2]
    columns = [*map(np.concatenate, (ACTIONS, OBS)), *(np.concatenate(x)[:, None] for x in (COSTS, REWARDS))]
    np.savetxt(path, np.hstack([*columns, ended[:, None]]), delimiter=",", header="swimmer steps")
    return path


@pytest.fixture
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The text that names a user's format, whose module is in the current folder; the table is restored afterwards."""
    (tmp_path / "own_tables.py").write_text(TABLES)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "own_tables", raising=False)
    monkeypatch.setattr(formats, "FORMATS", [*formats.FORMATS])
    return "own_tables:TABLES"


def test_a_registered_format_is_recognised_and_read(outside: str, tmp_path: Path) -> None:
    path = write_table(tmp_path / "steps.csv")
    with pytest.raises(DemonstrationsError, match=r"not an \.npz archive"):
        load_demonstrations(path)
    own = formats.named(outside)
    formats.register_format(own)
    assert_arrived(path, flags=True)
    assert load_demonstrations(path).metadata == {"format": "tables"}
    assert_arrived(dsrl(tmp_path / "still.hdf5"), flags=True)
    assert load_demonstrations(write_own(tmp_path, SOUND)).num_steps == 6
    with pytest.raises(UserError, match="format 'tables': registered already; choose another name"):
        formats.register_format(own)
    for wrong in (None, read_text, formats.Format(name="", recognizes=own.recognizes, read=own.read)):
        with pytest.raises(UserError, match=r"^register_format: .*give"):
            formats.register_format(wrong)


def test_a_registered_format_is_asked_before_our_own(outside: str, tmp_path: Path) -> None:
    """An archive that ours would refuse, or read as something else."""
    np.savez(tmp_path / "other.npz", swimmer=np.arange(3))
    arrays = {**SOUND, "episode_ends": ENDS}
    formats.register_format(
        formats.Format(name="other", recognizes=lambda path: path.name == "other.npz", read=lambda path: arrays)
    )
    np.testing.assert_array_equal(load_demonstrations(tmp_path / "other.npz").costs, SOUND["costs"])
    assert [known.name for known in formats.FORMATS] == ["other", "baselines", "hdf5", "minari", "ccil_jax"]


def read_text(path: Path) -> Any:
    return path.read_text()


OWN_ARRAYS = {**SOUND, "episode_ends": ENDS}
UNTRUSTED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no mapping": (read_text, "the reader of format strange returned str; it must return the arrays by name"),
    "no obs": (lambda path: {k: v for k, v in OWN_ARRAYS.items() if k != "obs"}, "returned no 'obs'; it must return"),
    "unknown": (lambda path: {**OWN_ARRAYS, "acs": 1}, "returned the unknown 'acs'; it must return actions, episode_e"),
    "metadata": (lambda path: {**OWN_ARRAYS, "metadata": "x"}, "returned metadata of type str; they must be a dict"),
    "no costs": (lambda path: {**OWN_ARRAYS, "costs": None}, "holds no cost of each step; constrained methods need it"),
    "NaN": (lambda path: {**OWN_ARRAYS, "costs": np.full(6, np.nan)}, "'costs' holds NaN or infinity"),
    "negative": (lambda path: {**OWN_ARRAYS, "costs": -np.ones(6)}, "'costs' is negative"),
    "rows differ": (lambda path: {**OWN_ARRAYS, "actions": np.ones((5, 2))}, "'actions' has 5 rows, 'obs' has 6"),
    "two columns": (lambda path: {**OWN_ARRAYS, "costs": np.ones((6, 2))}, "'costs' has shape (6, 2)"),
    "objects": (lambda path: {**OWN_ARRAYS, "obs": [None] * 6}, "'obs' has dtype object"),
    "ragged": (lambda path: {**OWN_ARRAYS, "obs": [[1.0], [1.0, 2.0]]}, "'obs' cannot be turned into an array"),
    "ends": (lambda path: {**OWN_ARRAYS, "episode_ends": [3, 7]}, "'episode_ends' covers 7 of 6 rows"),
    "done inside": (lambda path: {**OWN_ARRAYS, "terminated": np.ones(6)}, "'terminated' is true before"),
    "fails": (
        lambda path: OWN_ARRAYS["acs"],
        "format strange failed with KeyError: 'acs'; check the file, or the functions",
    ),
    "refuses": (Mock(side_effect=DemonstrationsError("steps.txt: line 3 is cut off")), "line 3 is cut off"),
}


@pytest.mark.parametrize("name", UNTRUSTED)
def test_what_a_reader_from_outside_returns_is_not_trusted(name: str, outside: str, tmp_path: Path) -> None:
    read, message = UNTRUSTED[name]
    (tmp_path / "steps.txt").write_text("")
    formats.register_format(formats.Format(name="strange", recognizes=lambda path: path.suffix == ".txt", read=read))
    with pytest.raises(DemonstrationsError, match=re.escape(message)) as caught:
        load_demonstrations(tmp_path / "steps.txt")
    assert "steps.txt" in str(caught.value)
    assert "\n" not in str(caught.value)
    if name == "no costs":
        assert load_demonstrations(tmp_path / "steps.txt", default_cost=2.0).mean_episode_cost == 6.0


def test_a_format_that_fails_to_recognise_is_named(outside: str, tmp_path: Path) -> None:
    own = formats.Format(name="strange", recognizes=lambda path: path.read_text() == "", read=read_text)
    formats.register_format(own)
    with pytest.raises(DemonstrationsError, match="format strange failed with IsADirectoryError"):
        load_demonstrations(tmp_path)


def test_the_converter_reads_a_format_of_the_users(
    outside: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is found in the current folder, and need not be registered."""
    path, out = write_table(tmp_path / "steps.csv"), tmp_path / "out.npz"
    with pytest.raises(SystemExit):
        convert.main([str(path), "--env", "Swimmer", "--out", str(out)])
    assert convert.main([str(path), "--env", "Swimmer", "--out", str(out), "--format", outside]) == 0
    assert_arrived(out, flags=True)
    capsys.readouterr()
    for text, message in (
        ("own_tables:MISSING", "--format own_tables:MISSING: module 'own_tables' has no attribute 'MISSING'"),
        ("own_tables", "--format own_tables: not of the form module:attribute"),
        ("own_tables:NOT_A_FORMAT", "--format own_tables:NOT_A_FORMAT: int is no ccil_jax.Format; give one"),
        ("no_such_module_here:X", "--format no_such_module_here:X: there is no module 'no_such_module_here'"),
    ):
        with pytest.raises(SystemExit) as end:
            convert.main([str(path), "--env", "Swimmer", "--out", str(tmp_path / "x.npz"), "--format", text])
        assert end.value.code == 2
        stderr = capsys.readouterr().err
        assert message in stderr
        assert stderr.count("\n") == 1
