"""Sound files of other formats: every number arrives, in the right row, and the converter writes what was read."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from ccil_jax.demonstrations import DemonstrationsError, load_demonstrations
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
    from ccil_jax import legacy_npz

    np.testing.assert_array_equal(legacy_npz.unpickle(content, (1,), "x")[0][0], [2.5, -1.0])


def test_all_pickles_of_a_file_share_one_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ccil_jax import legacy_npz

    path = legacy(tmp_path / "expert.npz")
    monkeypatch.setattr(legacy_npz, "MAX_OPCODES", 320)  # obs and acs take 153 each, rews 84
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
        np.testing.assert_array_equal(load_demonstrations(path, default_cost=0.5).costs, np.full(9, 0.5))


def test_the_converter_writes_what_was_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out" / "swimmer.npz"
    assert convert.main([str(legacy(tmp_path / "expert.npz")), "--env", "Swimmer", "--out", str(out)]) == 0
    assert "3 trajectories, 9 steps" in capsys.readouterr().out
    assert_arrived(out, flags=False)
    assert load_demonstrations(out).metadata["task"] == "Swimmer"


def test_the_converter_answers_wrong_use_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(legacy(tmp_path / "expert.npz"))
    out = ("--out", str(tmp_path / "out.npz"))
    for arguments, message in (
        ((path, "--env", "Ant", *out), "'obs' has 8 columns, Ant has obs_dim 27"),
        ((path, *out), "--env: required"),
        ((path, "--env", "Swimmer", "--out", path), "exists"),
        ((path, "--env", "Swimmer", "--out", "x.h5"), "named *.npz"),
        ((path, "--env", "Swimmer", *out, "--default-cost", "nan"), "--default-cost nan"),
    ):
        with pytest.raises(SystemExit) as end:
            convert.main(arguments)
        assert end.value.code == 2
        stderr = capsys.readouterr().err
        assert message in stderr
        assert stderr.count("\n") == 1
    assert not (tmp_path / "out.npz").exists()
