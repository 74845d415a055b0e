"""Demonstrations to and from Minari and DSRL: each is written or read back by the other library, to the last bit."""

import dataclasses
import importlib.util
import json
import warnings
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from gymnasium.spaces import Box
from minari.data_collector import EpisodeBuffer

from ccil_jax.demonstrations import formats
from ccil_jax.demonstrations.trajectories import Demonstrations, load_demonstrations, save_demonstrations
from ccil_jax.errors import DemonstrationsError, UserError
from ccil_jax.training.filesystem import content_sha256
from envs.registry import TASKS
from experiments import convert, evaluate, train
from experiments.cli.command_line import UsageError
from experiments.runs import demonstration_files, resuming
from experiments.runs.run_log import write_config
from experiments.sweeps import variants
from tests.test_commands import blocks

ENDS = np.array([3, 7, 9])
FINAL_OBS = np.random.default_rng(1).normal(size=(3, 8)).astype(np.float32)
NAME = "minari:swimmer/test-v0"


def make(**changes: Any) -> Demonstrations:
    """Three episodes of Swimmer, as far as the sizes go; the first terminates."""
    rng = np.random.default_rng(0)
    last = np.isin(np.arange(9), ENDS - 1)
    fields: dict[str, Any] = {
        "obs": rng.normal(size=(9, 8)).astype(np.float32),
        "actions": rng.uniform(-1, 1, size=(9, 2)).astype(np.float32),
        "rewards": rng.normal(size=9).astype(np.float32),
        "costs": np.array([0, 1, 1, 0.1, 0, 0, 2, 0, 0], np.float32),
        "terminated": last & (np.arange(9) < 3),
        "truncated": last & (np.arange(9) > 3),
        "episode_ends": ENDS,
        "final_obs": FINAL_OBS,
        "metadata": {"task": "Swimmer", "method": "expert", "env_options": {"max_episode_steps": 4}, "command": "made"},
    }
    return Demonstrations(**{**fields, **changes})


def assert_same(found: Demonstrations, wanted: Demonstrations) -> None:
    for field in dataclasses.fields(wanted):
        if field.name != "metadata":
            ours, theirs = getattr(found, field.name), getattr(wanted, field.name)
            assert ours.dtype == theirs.dtype
            np.testing.assert_array_equal(ours, theirs, err_msg=field.name)


@pytest.fixture
def local(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of Minari's local datasets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "local"))
    return tmp_path / "local"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    save_demonstrations(tmp_path / "d.npz", make())
    return tmp_path / "d.npz"


def refused(main: Any, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


@pytest.mark.usefixtures("local")
def test_minari_reads_what_the_converter_writes(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = [str(file), "--env", "Swimmer", "--out", NAME]
    assert convert.main(given) == 0
    assert f"{NAME}: 3 trajectories, 9 steps" in capsys.readouterr().out
    assert f"--out {NAME}: there is such a dataset; choose another" in refused(convert.main, given, capsys)
    assert convert.main([*given, "--overwrite"]) == 0

    wanted: Any = make()
    dataset = minari.load_dataset("swimmer/test-v0")
    starts = [0, *ENDS[:-1]]
    for episode, start, end, final in zip(dataset.iterate_episodes(), starts, ENDS, FINAL_OBS, strict=True):
        np.testing.assert_array_equal(episode.observations, [*wanted.obs[start:end], final])
        np.testing.assert_array_equal(episode.actions, wanted.actions[start:end])
        np.testing.assert_array_equal(episode.rewards, wanted.rewards[start:end])
        np.testing.assert_array_equal(episode.terminations, wanted.terminated[start:end])
        np.testing.assert_array_equal(episode.truncations, wanted.truncated[start:end])
        np.testing.assert_array_equal(episode.infos["cost"], [0, *wanted.costs[start:end]])
        assert episode.observations.dtype == episode.infos["cost"].dtype == np.float32
    assert list(minari.list_local_datasets()) == ["swimmer/test-v0"]
    metadata = dataset.storage.metadata
    assert metadata["algorithm_name"] == "expert"
    assert json.loads(metadata["description"])["command"].startswith("made\n")

    env = dataset.recover_environment()
    assert env.spec.id == "ccil/Swimmer-v0"
    assert env.spec.max_episode_steps == 4
    assert env.action_space == dataset.action_space == Box(-1, 1, (2,), np.float32)

    found = load_demonstrations(NAME)
    assert_same(found, wanted)
    assert found.metadata["dataset_id"] == "swimmer/test-v0"


def test_a_dataset_that_minari_made_is_found_by_its_name(local: Path, tmp_path: Path) -> None:
    wanted: Any = make()
    buffers = [
        EpisodeBuffer(
            observations=np.concatenate([wanted.obs[start:end], FINAL_OBS[i : i + 1]]),
            actions=wanted.actions[start:end],
            rewards=wanted.rewards[start:end],
            terminations=wanted.terminated[start:end],
            truncations=wanted.truncated[start:end],
            infos={"cost": wanted.costs[start:end], "x_position": np.zeros(end - start)},
        )
        for i, (start, end) in enumerate(zip([0, *ENDS[:-1]], ENDS, strict=True))
    ]
    spaces = {"observation_space": Box(-9, 9, (8,)), "action_space": Box(-1, 1, (2,))}
    with warnings.catch_warnings():  # about an author and the like
        warnings.simplefilter("ignore", UserWarning)
        minari.create_dataset_from_buffers("swimmer/theirs-v3", buffers, **spaces)
    name = "minari:swimmer/theirs-v3"
    assert_same(load_demonstrations(name), wanted)

    given = ["--method", "bc", "--env", "Swimmer", "--demos", name, "--out", str(tmp_path / "run")]
    setup = train.make_plan(train.make_parser().parse_args(given)).setup
    assert setup.demonstrations_path == local / "swimmer" / "theirs-v3"
    fields = {"env": "Swimmer", "method": "bc", "demos": name}
    assert variants.make_variant("x", fields, tmp_path / "sweep").plan.setup == setup
    assert convert.main([name, "--env", "Swimmer", "--out", str(tmp_path / "own.npz")]) == 0
    assert_same(load_demonstrations(tmp_path / "own.npz"), wanted)


@pytest.mark.usefixtures("local")
def test_the_page_records_a_dataset_with_costs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By gymnasium and Minari alone. Its reward has a control cost, which our task's has not, and that is said."""
    (block,), page = blocks("docs/demonstrations.md", "python"), dict[str, Any]()
    monkeypatch.chdir(tmp_path)  # MuJoCo writes to a log file about an attribute of gymnasium's model
    with warnings.catch_warnings():  # about an author and the like, and about Minari's temporary folders
        warnings.simplefilter("ignore", UserWarning)
        warnings.simplefilter("ignore", ResourceWarning)
        exec(compile(block, "docs/demonstrations.md", "exec"), page)  # noqa: S102  (the page is ours)
        page.pop("env")._tmp_dir.cleanup()
    name, note = "minari:cheetah/random-v0", "the demonstrations are of HalfCheetah-v5, whose reward contains the con"
    found: Any = load_demonstrations(name)
    np.testing.assert_array_equal(found.costs, 0.1 * np.square(found.actions.astype(float)).sum(axis=1) > 0.2)
    np.testing.assert_array_equal(found.episode_lengths, [1000, 1000])
    assert 0 < found.costs.mean() < 1
    assert convert.main([name, "--env", "HalfCheetah", "--out", str(tmp_path / "own.npz")]) == 0
    assert f"note: {note}" in capsys.readouterr().out
    assert note in (demonstration_files.note_on_rewards(load_demonstrations(tmp_path / "own.npz"), "HalfCheetah") or "")
    assert demonstration_files.note_on_rewards(make(metadata={"environment": "Swimmer-v5"}), "Swimmer") is None
    assert demonstration_files.note_on_rewards(make(metadata={"environment": "ccil/Hopper-v0"}), "Hopper") is None
    assert demonstration_files.note_on_rewards(None, "Hopper") is None


def test_a_task_that_gymnasium_does_not_know_has_no_environment(local: Path) -> None:
    save_demonstrations("minari:walk-v0", make(metadata={"task": "my_module:Walk"}))
    dataset = minari.load_dataset("walk-v0")
    assert dataset.spec.env_spec is None
    assert dataset.action_space == Box(-np.inf, np.inf, (2,), np.float32)
    assert sorted(path.name for path in local.iterdir()) == ["walk-v0"]  # nothing is left over


@pytest.mark.usefixtures("local")
def test_names_are_answered_in_one_line(
    tmp_path: Path, file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = "minari:mujoco/hopper/expert-v0"
    message = f"{missing}: no such dataset on this machine ({tmp_path}/local/mujoco/hopper/expert-v0); "
    message += "download it with `minari download mujoco/hopper/expert-v0`"
    with pytest.raises(DemonstrationsError) as error:
        load_demonstrations(missing)
    assert str(error.value) == message
    for main in (train.main, convert.main):
        given = ["--demos", missing] if main is train.main else [missing, "--out", "x.npz"]
        assert message in refused(main, ["--env", "Hopper", *given], capsys)
    with pytest.raises(UsageError, match=f"--demos: {missing}: no such dataset"):
        variants.make_variant("x", {"env": "Hopper", "method": "bc", "demos": missing}, tmp_path)
    for wrong in ("minari:", "minari:hopper", "minari:../../etc-v0", "minari:/etc/x-v0"):
        with pytest.raises(DemonstrationsError, match="not the name of a dataset; give one such as minari:mujoco"):
            load_demonstrations(wrong)
        assert "not the name of a dataset" in refused(
            convert.main, [str(file), "--env", "Swimmer", "--out", wrong], capsys
        )
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for call in (load_demonstrations, formats.writer_of):
        with pytest.raises(DemonstrationsError, match=r"needs the package minari; .*pip install 'ccil_jax\[minari\]'"):
            call(missing)
    with pytest.raises(DemonstrationsError, match=r"x\.hdf5: writing HDF5 needs h5py; .*'ccil_jax\[hdf5\]'"):
        formats.writer_of("x.hdf5")


DSRL_KEYS = ("observations", "next_observations", "actions", "rewards", "costs", "terminals", "timeouts")


def read_as_dsrl(path: Path) -> dict[str, np.ndarray]:
    """What DSRL's `OfflineEnv.get_dataset` does with a file, and what it insists on."""
    names: list[str] = []
    with h5py.File(path, "r") as opened:
        opened.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        found = {name: opened[name][:] for name in names}
    assert set(found) == set(DSRL_KEYS)
    steps = len(found["observations"])
    assert found["observations"].shape == found["next_observations"].shape == (steps, TASKS["Swimmer"].obs_dim)
    assert found["actions"].shape == (steps, TASKS["Swimmer"].action_dim)
    assert all(found[name].shape == (steps,) for name in DSRL_KEYS[3:])
    return {name: array.astype(np.float32) if name in DSRL_KEYS[:5] else array for name, array in found.items()}


def test_dsrl_reads_what_the_converter_writes(file: Path, tmp_path: Path) -> None:
    out, wanted = tmp_path / "d.hdf5", make()
    assert convert.main([str(file), "--env", "Swimmer", "--out", str(out)]) == 0
    found = read_as_dsrl(out)
    np.testing.assert_array_equal(found["observations"], wanted.obs)
    np.testing.assert_array_equal(found["actions"], wanted.actions)
    np.testing.assert_array_equal(found["rewards"], wanted.rewards)
    np.testing.assert_array_equal(found["costs"], wanted.costs)
    np.testing.assert_array_equal(found["terminals"], wanted.terminated)
    np.testing.assert_array_equal(found["timeouts"], wanted.truncated)
    following = [FINAL_OBS[ENDS.tolist().index(t)] if t in ENDS else wanted.obs[t] for t in range(1, 10)]
    np.testing.assert_array_equal(found["next_observations"], following)
    assert_same(load_demonstrations(out), wanted)
    with h5py.File(out) as opened:
        assert json.loads(opened.attrs["metadata"])["task"] == "Swimmer"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d.hdf5", "d.npz"]


@pytest.mark.usefixtures("local")
def test_what_is_not_known_is_not_invented(tmp_path: Path) -> None:
    for name in (tmp_path / "d.h5", NAME):
        with pytest.raises(DemonstrationsError, match=r"needs the observation after each .* record them again with"):
            save_demonstrations(name, make(final_obs=None))
        with pytest.raises(DemonstrationsError, match="needs rewards"):
            save_demonstrations(name, make(rewards=None))
    with pytest.raises(DemonstrationsError, match=r"d\.h5: trajectory 1 neither terminates nor is truncated"):
        save_demonstrations(tmp_path / "d.h5", make(truncated=np.zeros(9, bool)))
    with pytest.raises(DemonstrationsError, match=r"d\.h5: the metadata are longer than"):
        save_demonstrations(tmp_path / "d.h5", make(metadata={"x": "y" * 70_000}))
    assert list(tmp_path.iterdir()) in ([], [tmp_path / "local"])


def test_a_recording_may_have_any_of_the_names(local: Path, tmp_path: Path) -> None:
    for name in (NAME, str(tmp_path / "new.hdf5"), str(tmp_path / "new.npz")):
        given = evaluate.make_parser().parse_args([str(tmp_path), "--record", name])
        assert evaluate.check_files(given, None) == [("--record", Path(name))]
    (local / "swimmer" / "test-v0").mkdir(parents=True)
    with pytest.raises(UsageError, match=f"--record {NAME}: there is such a dataset"):
        evaluate.check_files(evaluate.make_parser().parse_args([str(tmp_path), "--record", NAME]), None)
    with pytest.raises(UsageError, match=r"--record x\.csv: a demonstrations file is named"):
        evaluate.check_files(evaluate.make_parser().parse_args([str(tmp_path), "--record", "x.csv"]), None)


def test_the_content_of_a_folder_is_told_apart(local: Path, tmp_path: Path) -> None:
    save_demonstrations("minari:a-v0", make(metadata={"x": 1}))
    (local / "a-v0").rename(tmp_path / "moved")
    first = content_sha256(tmp_path / "moved")
    save_demonstrations("minari:a-v0", make(metadata={"x": 1}, costs=np.ones(9, np.float32)))
    assert content_sha256(local / "a-v0") != first
    assert content_sha256(tmp_path / "moved") == first
    assert content_sha256(tmp_path / "missing") is None


def test_a_run_that_learnt_from_a_folder_is_resumed_with_the_same_one(local: Path, tmp_path: Path) -> None:
    save_demonstrations(NAME, make())
    run = tmp_path / "run"
    given = ["--method", "bc", "--env", "Swimmer", "--demos", NAME, "--out", str(run)]
    write_config(train.make_plan(train.make_parser().parse_args(given)), env=None)
    assert resuming.resumed(run, {})["demos"] == local / "swimmer" / "test-v0"
    save_demonstrations(NAME, make(costs=np.ones(9, np.float32)))
    with pytest.raises(UserError, match=r"--demos .*test-v0: not the file that the run in .* began with"):
        resuming.resumed(run, {})
