"""A run that stops half-way and goes on from its checkpoint ends as the unbroken run does, bit for bit."""

import contextlib
import dataclasses
import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from ccil_jax.agents import build
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.errors import CheckpointError, ConfigError
from ccil_jax.training import runner
from ccil_jax.training.runner import Result
from tests.probe_envs import Walk, assert_same_bits, quick_compilation, same_bits, walk_config, walk_demonstrations


def train(
    directory: Path | None = None, *, resume: bool = False, stop_after: int | None = None, num_iterations: int = 20
) -> Result:
    with quick_compilation():
        return runner.train(
            walk_config(method="malm", env_steps=num_iterations * 64),
            Walk(),
            walk_demonstrations(),
            num_seeds=2,
            seed=3,
            checkpoint_dir=directory,
            resume=resume,
            stop_after=stop_after,
        )


def test_a_stopped_and_resumed_run_is_the_unbroken_run(tmp_path: Path) -> None:
    whole = train()
    half = train(tmp_path, stop_after=10)
    assert half.env_steps == whole.env_steps // 2 == 10 * 64
    assert not same_bits(half.state, whole.state)
    # Every call builds its program anew, as a new process would.
    resumed = train(tmp_path, resume=True)
    assert resumed.env_steps == whole.env_steps == 20 * 64
    assert_same_bits(resumed.state, whole.state)
    assert set(resumed.metrics) == set(whole.metrics)
    for name, rows in whole.metrics.items():
        assert rows.shape == (20, 2)
        assert_same_bits(resumed.metrics[name], rows)
        assert_same_bits(resumed.metrics[name][:10], half.metrics[name])
    np.testing.assert_array_equal(whole.metrics["env_steps"][:, 0], 64 * np.arange(1, 21))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(whole.metrics))


def test_a_folder_with_checkpoints_is_not_trained_into(tmp_path: Path) -> None:
    half = train(tmp_path, stop_after=10)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file() and path.name[0] != "."}
    with pytest.raises(CheckpointError, match=r"holds checkpoints already \(steps 10\)"):
        train(tmp_path)
    assert {path: path.read_bytes() for path in before} == before
    again = train(tmp_path, resume=True, stop_after=0)  # reads, and takes no step
    assert_same_bits(again.state, half.state)


def test_no_step_is_no_step(tmp_path: Path) -> None:
    nothing = train(tmp_path, stop_after=0)
    assert (nothing.env_steps, nothing.metrics) == (0, {})
    assert not (tmp_path / "0").exists()
    with pytest.raises(ConfigError, match="stop_after -1: give an integer from 0"):
        train(stop_after=-1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"seed": -1}, "seed -1: give an integer from 0 to 4294967295"),
        ({"seed": "a"}, "seed 'a': give an integer"),
        ({"num_seeds": 1.5}, r"num_seeds 1\.5: give an integer from 1"),
        ({"num_seeds": True}, "num_seeds True: give an integer"),
        ({"stop_after": 1.5}, r"stop_after 1\.5: give an integer from 0"),
        ({"one_by_one": "false"}, "one_by_one 'false': give True or False"),
        ({"resume": True}, "resume True: there is nothing to go on from; give checkpoint_dir"),
        ({"moved": ("gamma",)}, "moved gamma: for a training that is resumed"),
    ],
)
def test_settings_that_mean_nothing_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        runner.train(walk_config(method="trpo"), Walk(), **settings)
    with pytest.raises(ConfigError, match="give at least one configuration"):
        runner.train_runs([], Walk())


def test_demonstrations_without_rows_are_refused() -> None:
    flat = dataclasses.replace(walk_demonstrations(), actions=walk_demonstrations().actions[:, 0])
    with pytest.raises(ConfigError, match=r"demonstrations: actions has shape \(40,\), no rows, but Walk has 1"):
        build.resolve(walk_config(method="gail"), Walk(), flat)


def test_a_training_is_not_resumed_to_be_shorter(several: Path, tmp_path: Path) -> None:
    shutil.copytree(several, tmp_path / "copy")
    (tmp_path / "copy" / "1").rename(tmp_path / "copy" / "30")  # as if it had gone on for longer than it is asked to
    with pytest.raises(ConfigError, match=r"env_steps 1280: the training in .* has done 1920; give"):
        train_several(tmp_path / "copy", resume=True)


def test_what_took_no_step_has_nothing_to_save(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nothing to save, as no iteration was carried out"):
        runner.save(train(stop_after=0), tmp_path)


def test_a_multiplier_that_an_earlier_version_logged_is_left_out(
    several: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It wrote 0 for methods that have none; the metrics of a resumed run must agree with those of the checkpoint."""
    shutil.copytree(several, tmp_path / "copy")
    restore = runner._restore

    def older(*arguments: Any) -> Any:
        state, history = restore(*arguments)
        return state, {**history, "multiplier": np.zeros((1, 4), np.float32)}

    monkeypatch.setattr(runner, "_restore", older)
    seen: list[set[str]] = []
    result, _ = train_several(
        tmp_path / "copy",
        resume=True,
        stop_after=2,
        on_start=lambda history: seen.append(set(history)),
        on_progress=lambda progress: seen.append(set(progress.metrics)),
    )
    assert seen == [set(result.metrics)] * 2
    assert "multiplier" not in result.metrics


def test_a_metric_that_an_earlier_version_did_not_have_is_unknown_for_its_iterations(
    several: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(several, tmp_path / "copy")
    restore, name = runner._restore, "cost_critic_explained_variance"

    def older(*arguments: Any) -> Any:
        state, history = restore(*arguments)
        return state, {other: rows for other, rows in history.items() if other != name}

    monkeypatch.setattr(runner, "_restore", older)
    result, _ = train_several(tmp_path / "copy", resume=True, stop_after=2)
    explained = result.metrics[name]
    done = len(explained) - 1
    assert done >= 1
    assert np.isnan(explained[:done]).all()
    assert np.isfinite(explained[done:]).all()


def other_demonstrations() -> Demonstrations:
    same = walk_demonstrations()
    return dataclasses.replace(same, actions=-same.actions)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 4}, "written with seed 3, this run has 4"),
        ({"num_seeds": 1}, "written with num_seeds 2, this run has 1"),
        ({"demonstrations": other_demonstrations()}, "written with demonstrations [0-9a-f]{64}, this run has"),
        ({"rates": (0.01, 0.03)}, r"written with critic_learning_rate 0\.02, this run has 0\.03"),
        ({"rates": (0.02, 0.01)}, r"written with critic_learning_rate 0\.01, this run has 0\.02"),
        ({"rates": (0.01,)}, "written with number of configurations 2, this run has 1"),
        ({"rates": (0.01, 0.03), "moved": ("critic_learning_rate",)}, ""),
        ({"moved": ("hidden_sizes",)}, "moved hidden_sizes: only a traced field may differ"),
        ({"seed": 2**32}, "seed 4294967296: give an integer from 0"),
    ],
)
def test_another_training_is_not_resumed(several: Path, tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    shutil.copytree(several, tmp_path / "copy")
    with contextlib.nullcontext() if not message else pytest.raises((CheckpointError, ConfigError), match=message):
        assert train_several(tmp_path / "copy", resume=True, stop_after=1, **changes)[0].env_steps == 64


def train_several(
    directory: Path,
    *,
    rates: tuple[float, ...] = (0.01, 0.02),
    demonstrations: Demonstrations | None = None,
    num_seeds: int = 2,
    seed: int = 3,
    **settings: Any,
) -> list[Result]:
    configs = [walk_config(method="gail", critic_learning_rate=rate) for rate in rates]
    demonstrations = demonstrations or walk_demonstrations()
    with quick_compilation():
        return runner.train_runs(
            configs, Walk(), demonstrations, num_seeds=num_seeds, seed=seed, checkpoint_dir=directory, **settings
        )


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkpoints of two configurations that are trained together, after one iteration."""
    folder = tmp_path_factory.mktemp("several")
    train_several(folder, stop_after=1)
    return folder


def test_a_longer_run_ends_where_it_should(tmp_path: Path) -> None:
    """Seven iterations in one chunk, then on to ten: no chunk may lead beyond."""
    short = train(tmp_path, num_iterations=7)
    longer = train(tmp_path, num_iterations=10, resume=True)
    assert longer.env_steps == 10 * 64
    np.testing.assert_array_equal(longer.metrics["env_steps"][:, 0], 64 * np.arange(1, 11))
    for name, rows in short.metrics.items():
        assert_same_bits(longer.metrics[name][:7], rows)
