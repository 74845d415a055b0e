"""Metrics at Weights & Biases, offline: what is in the file that would be sent is what metrics.csv has."""

import importlib.util
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import wandb
from wandb.proto.wandb_internal_pb2 import Record

from experiments import expert, train
from experiments.cli.command_line import UsageError
from experiments.runs import wandb_log
from experiments.runs.metrics_file import MetricsWriter, read_metrics
from experiments.runs.run_log import _writers_of
from experiments.runs.wandb_log import WandbWriter
from experiments.sweeps import variants
from tests.probe_envs import quick_compilation

METRICS = {
    "env_steps": np.array([[40, 40], [80, 80]]),
    "episode_return": np.array([[np.nan, 1.5], [2.1, -3.0]], np.float32),
    "kl": np.array([[0.1, 0.2], [0.3, 0.4]], np.float32),
}


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Nothing is sent and nothing of this machine's user is read; the process behind wandb ends with the test."""
    for name, value in {"WANDB_MODE": "offline", "HOME": str(tmp_path), "NETRC": str(tmp_path / "netrc")}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    wandb.teardown()
    yield
    wandb.teardown()


def records(folder: Path) -> list[Any]:
    """The records of the only run in a folder: of LevelDB's log format, after a header of seven bytes."""
    wandb.teardown()  # the process that writes them has ended
    (path,) = folder.glob("wandb/offline-run-*/*.wandb")
    content, place, found, parts = path.read_bytes(), 7, [], b""
    while place + 7 <= len(content):
        left = 32768 - place % 32768
        if left < 7:  # the rest of a block is filled with zeros
            place += left
            continue
        _, length, kind = struct.unpack_from("<IHB", content, place)
        parts += content[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):  # a whole record, or the last part of one
            found.append(Record.FromString(parts))
            parts = b""
    return found


def history(folder: Path) -> list[dict[str, float]]:
    rows = [record.history for record in records(folder) if record.HasField("history")]
    return [{item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in row.item} for row in rows]


def test_the_numbers_are_those_of_the_file(tmp_path: Path) -> None:
    writers = MetricsWriter(tmp_path), WandbWriter("my-project", tmp_path, {"task": "Swimmer", "hidden_sizes": (8, 8)})
    for writer in writers:
        with writer:
            writer.begin({name: rows[:1] for name, rows in METRICS.items()})  # of an earlier process
            writer.write(2, {name: rows[1:] for name, rows in METRICS.items()})
    saved, logged = read_metrics(tmp_path), history(tmp_path)
    assert [(row["iteration"], row["env_steps"]) for row in logged] == [(1, 40), (2, 80)]
    for name in ("episode_return", "kl"):
        for number, row in enumerate(logged):
            for seed in range(2):
                value = row.get(f"seed_{seed}/{name}", np.nan)
                np.testing.assert_allclose(value, saved[name][number, seed], rtol=1e-8)
            np.testing.assert_allclose(row[f"mean/{name}"], np.nanmean(METRICS[name][number]), rtol=1e-6)
    (run,) = [record.run for record in records(tmp_path) if record.HasField("run")]
    assert (run.project, run.display_name) == ("my-project", tmp_path.name)
    config = {item.key: json.loads(item.value_json) for item in run.config.update}
    assert (config["task"], config["hidden_sizes"]) == ("Swimmer", [8, 8])


def test_what_cannot_be_logged_is_refused_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"^--wandb a/b: Invalid project name"):
        wandb_log.check("a/b")
    wandb_log.check("my-project")
    monkeypatch.setenv("WANDB_MODE", "online")
    wandb.teardown()
    with pytest.raises(UsageError, match=r"^--wandb my-project: nobody is logged in .* set WANDB_MODE=offline"):
        wandb_log.check("my-project")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    run = ["--env", "Swimmer", "--wandb", "my-project"]
    for launcher, more in ((train, ["--method", "bc"]), (expert, ["--out", str(tmp_path / "e.npz")])):
        with pytest.raises(UsageError, match=r"^--wandb my-project: needs the package wandb; .*'ccil_jax\[wandb\]'"):
            launcher.make_plan(launcher.make_parser().parse_args([*run, *more]))
    assert not list(tmp_path.glob("runs/*"))


def test_a_run_has_a_project_only_if_it_is_given_one(tmp_path: Path) -> None:
    given = ["--method", "bc", "--env", "Swimmer", "--out", str(tmp_path / "run")]
    plans = [train.make_plan(train.make_parser().parse_args([*given, *more])) for more in ([], ["--wandb", "p"])]
    kinds: list[list[type]] = []
    for plan in plans:
        writers = _writers_of(plan)
        kinds.append([type(writer) for writer in writers])
        for writer in writers:
            writer.__exit__(None, None, None)
    assert kinds == [[MetricsWriter], [MetricsWriter, WandbWriter]]
    assert plans[0].setup == plans[1].setup  # they may share a program
    fields = {"method": "bc", "env": "Swimmer", "wandb": "p"}
    assert variants.make_variant("x", fields, tmp_path / "sweep").plan.wandb == "p"


def test_the_scores_of_the_evaluation_come_last(tmp_path: Path) -> None:
    """Those of summary.json, of each seed and their means; what is unknown, as the return of no expert, is left out."""
    options = ["--method", "trpo", "--env", "Swimmer", "--preset", "tiny", "--num-seeds", "2", "--eval-episodes", "2"]
    folder = tmp_path / "run"
    with quick_compilation():
        assert train.main([*options, "--out", str(folder), "--wandb", "my-project"]) == 0
    content = json.loads((folder / "summary.json").read_text())
    updates = [item for record in records(folder) for item in record.summary.update]
    logged = {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in updates}
    scores = {name: value for name, value in logged.items() if name.startswith("evaluation/")}
    for seed, row in enumerate(content["per_seed"]):
        known = {name: value for name, value in row.items() if value is not None and name != "seed"}
        assert {name: scores.pop(f"evaluation/seed_{seed}/{name}") for name in known} == known
    means = {name: score["mean"] for name, score in content["aggregate"].items() if score}
    assert {"episode_return", "episode_cost"} <= means.keys()
    assert scores == {f"evaluation/mean/{name}": mean for name, mean in means.items()}
