"""The files of a run folder: one row per iteration and seed, strict JSON, nothing twice after a resumption."""

import csv
import dataclasses
import errno
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccil_jax.config import Config
from ccil_jax.presets import PRESETS
from experiments.cli import options
from experiments.cli.command_line import UsageError
from experiments.runs import provenance, resuming, run_folder
from experiments.runs.metrics_file import MetricsWriter, read_metrics


def metrics(num_iterations: int, first: int = 0, **more: float) -> dict[str, np.ndarray]:
    """Two seeds; every number tells its iteration and seed."""
    steps = np.arange(first + 1, first + num_iterations + 1)[:, None] * np.ones((1, 2))
    values = {"env_steps": 100 * steps, "episode_return": steps + np.array([[0.0, 0.5]])}
    return {**values, **{name: np.full((num_iterations, 2), value) for name, value in more.items()}}


def test_metrics_file_has_one_row_per_iteration_and_seed(tmp_path: Path) -> None:
    with MetricsWriter(tmp_path) as writer:
        writer.write(2, metrics(2, kl=0.01, new_metric=1.0))
        writer.write(3, metrics(1, first=2, kl=0.02, new_metric=1.0))
    with (tmp_path / "metrics.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["iteration", "seed", "env_steps", "episode_return", "kl", "new_metric"]
    assert rows[1:3] == [["1", "0", "100", "1", "0.01", "1"], ["1", "1", "100", "1.5", "0.01", "1"]]
    assert [row[:2] for row in rows[1:]] == [[str(i), str(s)] for i in (1, 2, 3) for s in (0, 1)]
    read = read_metrics(tmp_path)
    np.testing.assert_array_equal(read["episode_return"], [[1, 1.5], [2, 2.5], [3, 3.5]])
    assert "iteration" not in read
    assert list(tmp_path.glob("events.*"))


def test_a_resumed_run_repeats_no_row(tmp_path: Path) -> None:
    """Killed in the middle of a line, iterations after the last checkpoint, that of iteration 2."""
    with MetricsWriter(tmp_path) as writer:
        writer.begin({})
        writer.write(4, metrics(4))
    path = tmp_path / "metrics.csv"
    whole = path.read_text()
    path.write_text(whole[:-5])
    with MetricsWriter(tmp_path) as writer:
        writer.begin(metrics(2))
        writer.write(3, metrics(1, first=2))
        writer.write(4, metrics(1, first=3))
    assert path.read_text() == whole


def test_counters_pass_31_bits(tmp_path: Path) -> None:
    """Nine digits would do for float32, not for steps."""
    with MetricsWriter(tmp_path) as writer:
        writer.begin({})
        writer.write(1, {"env_steps": np.array([[2**31 + 1]])})
    assert (tmp_path / "metrics.csv").read_text().splitlines() == ["iteration,seed,env_steps", "1,0,2147483649"]
    assert read_metrics(tmp_path)["env_steps"].item() == 2**31 + 1


@pytest.mark.parametrize("content", [None, "", "iteration,seed\n", "iteration,seed,x\n1,0,1\n1,1\n"])
def test_damaged_metrics_are_reported(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "metrics.csv").write_text(content)
    with pytest.raises(UsageError, match=r"metrics\.csv: missing, empty or damaged"):
        read_metrics(tmp_path)


def test_json_is_strict_and_whole(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    run_folder.write_json(path, {"a": np.float32(0.5), "b": float("nan"), "c": (1, np.array([2.0, np.inf]))})
    assert json.loads(path.read_text()) == {"a": 0.5, "b": None, "c": [1, [2.0, None]]}
    with pytest.raises(TypeError):
        run_folder.write_json(path, {"a": object()})
    assert json.loads(path.read_text())["a"] == 0.5
    assert provenance.git_commit() is None or len(provenance.git_commit() or "") >= 40


def test_a_full_disk_is_told_with_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with MetricsWriter(tmp_path) as writer:
        writer.begin({})
        monkeypatch.setattr(writer._events, "write_event", full)
        with pytest.raises(OSError, match="No space left") as caught:
            writer.write(1, {"env_steps": np.full((1, 2), 64), "kl": np.zeros((1, 2))})
    assert caught.value.filename == str(tmp_path)


def events(folder: Path) -> Iterator[tuple[int, dict[str, float]]]:
    """Step and values of every event that has some."""
    from tensorboardX.proto.event_pb2 import Event

    (file,) = folder.glob("events*")
    data, at = file.read_bytes(), 0
    while at < len(data):  # length, its checksum, the event, its checksum
        (length,) = struct.unpack_from("<Q", data, at)
        event: Any = Event.FromString(data[at + 12 : at + 12 + length])
        at += 16 + length
        if event.summary.value:
            yield event.step, {value.tag: value.simple_value for value in event.summary.value}


def test_nothing_is_said_of_episodes_before_one_has_ended(tmp_path: Path) -> None:
    """Two seeds: none has an episode after the first iteration, one after the second, both after the third."""
    nan = np.nan
    rows = metrics(3) | {"episode_cost": np.array([[nan, nan], [nan, 4.0], [2.0, 6.0]])}
    with MetricsWriter(tmp_path) as writer:
        writer.begin({})
        writer.write(3, rows)
    with (tmp_path / "metrics.csv").open(newline="") as file:
        assert [row["episode_cost"] for row in csv.DictReader(file)] == ["", "", "", "4", "2", "6"]
    np.testing.assert_array_equal(read_metrics(tmp_path)["episode_cost"], rows["episode_cost"])
    said = [values for _, values in events(tmp_path)]
    costs = [{tag: value for tag, value in values.items() if tag.endswith("/episode_cost")} for values in said]
    assert costs == [
        {},
        {"mean/episode_cost": 4.0, "seed_1/episode_cost": 4.0},
        {"mean/episode_cost": 4.0, "seed_0/episode_cost": 2.0, "seed_1/episode_cost": 6.0},
    ]
    assert all({"mean/episode_return", "seed_0/episode_return", "seed_1/episode_return"} <= set(v) for v in said)


def test_folders_of_earlier_versions_are_read_without_their_placeholders(tmp_path: Path) -> None:
    rows = metrics(3) | {"episode_cost": np.array([[25.0, 25.0], [25.0, 4.0], [2.0, 6.0]])}
    rows |= {"episodes_finished": np.array([[0, 0], [0, 1], [1, 0]]), "kl": np.full((3, 2), 0.5)}
    with MetricsWriter(tmp_path) as writer:
        writer.begin(rows)
    read, nan = read_metrics(tmp_path), np.nan
    np.testing.assert_array_equal(read["episode_cost"], [[nan, nan], [nan, 4.0], [2.0, 6.0]])
    np.testing.assert_array_equal(read["episode_return"], [[nan, nan], [nan, 2.5], [3.0, 3.5]])
    np.testing.assert_array_equal(read["kl"], rows["kl"])


def test_events_advance_where_no_environment_steps_are_taken(tmp_path: Path) -> None:
    """Behaviour cloning: its axis is the number of iterations, chunk after chunk. Others keep environment steps."""
    cloning, steps = tmp_path / "cloning", tmp_path / "steps"
    for folder, rows in ((cloning, {"env_steps": np.zeros((2, 1))}), (steps, {"env_steps": np.full((2, 1), 50)})):
        folder.mkdir()
        with MetricsWriter(folder) as writer:
            writer.begin({})
            for iteration in (2, 4):
                writer.write(iteration, rows | {"loss": np.ones((2, 1))})
    assert [step for step, _ in events(cloning)] == [1, 2, 3, 4]
    assert [step for step, _ in events(steps)] == [50] * 4


# Earlier versions ----------------------------------------------------------------------------------------------------

FACTS: dict[str, Any] = {
    "task": "Swimmer",
    "physics": "native",
    "env_options": {},
    "preset": "default",
    "command": "train",
    "seed": 0,
    "num_seeds": 2,
    "eval_episodes": 50,
    "demonstrations": None,
    **dict.fromkeys(("expert_return", "expert_cost", "expert_length")),
}


def earlier_run(folder: Path, **fields: Any) -> Path:
    """A run folder as it was before the policy could begin with a clone; `fields` differ from the defaults."""
    run_folder.write_config(folder, Config(**fields), FACTS)
    content = run_folder.read_json(folder / "config.json")
    for name in ("action_likelihood", "cloning_updates", "warmup_iterations", "cloning_weight", "outer_loss"):
        del content["config"][name]
    run_folder.write_json(folder / "config.json", {**content, "config": {**content["config"], "bc_epochs": 150}})
    return folder


def test_a_run_of_an_earlier_version_has_the_defaults_of_what_it_does_not_say(tmp_path: Path) -> None:
    """Also where the preset that it began with says something else by now."""
    fields: dict[str, Any] = {"method": "ccil", "gamma": 0.9, "cost_limit": 3.0}
    run = run_folder.read_run(earlier_run(tmp_path, **fields))
    assert run.config == Config(**fields)
    assert not run.gone
    assert "bc_epochs" not in run.settings
    saved = resuming.resumed(tmp_path, {})
    assert (saved["cloning_updates"], saved["action_likelihood"], saved["gamma"]) == (0, "gaussian", 0.9)
    assert PRESETS["default"]["cloning_updates"] > 0
    config = options.config_from({}, "default", saved)
    assert {name for name, value in dataclasses.asdict(config).items() if value != getattr(run.config, name)} == {
        "cost_limit"  # is resolved from the demonstrations, once more
    }


def test_a_cloning_of_an_earlier_version_is_read_and_not_continued(tmp_path: Path) -> None:
    run = run_folder.read_run(earlier_run(tmp_path, method="bc", actor_learning_rate=0.01))
    assert run.config == Config(method="bc", actor_learning_rate=0.01)
    assert run.gone == {"bc_epochs": 150}
    assert run.settings["bc_epochs"] == 150
    assert "cloning_updates" not in run.settings
    for given in ({}, {"cloning_updates": 300}):
        message = r"--resume: .*written with bc_epochs 150 by an earlier version: bc now counts gradient steps \("
        with pytest.raises(UsageError, match=message + r"cloning_updates\), .*begin a new run in another folder$"):
            resuming.resumed(tmp_path, given)


def test_a_field_of_another_version_is_named(tmp_path: Path) -> None:
    content = run_folder.read_json(earlier_run(tmp_path) / "config.json")
    content["config"]["new_field"] = 1
    run_folder.write_json(tmp_path / "config.json", content)
    with pytest.raises(UsageError, match="field 'new_field' is not known to this version; use the version that wrote"):
        run_folder.read_run(tmp_path)
