"""The folder of one training run: config, metrics, summary, checkpoints, figures, TensorBoard events."""

import contextlib
import csv
import dataclasses
import json
import math
import os
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

import numpy as np

from ccil_jax.config import Config, check_types
from ccil_jax.errors import ConfigError
from ccil_jax.training.history import without_unknown
from ccil_jax.training.versions import versions
from envs import registry
from envs.registry import TASKS, TaskInfo
from experiments.cli.command_line import UsageError
from experiments.runs.intervals import known_mean
from experiments.runs.provenance import git_commit

METRICS = (  # order of the columns of metrics.csv, which has those that the method reports
    "env_steps",
    "episode_return",
    "episode_cost",
    "cost_rate",
    "episode_length",
    "episodes_finished",
    "multiplier",
    "cost_weight",
    "meta_gradient",
    "kl",
    "surrogate",
    "step_fraction",
    "rejected_not_finite",
    "rejected_by_kl",
    "rejected_by_surrogate",
    "no_direction",
    "entropy",
    "imitation_reward",
    "discriminator_loss",
    "discriminator_accuracy_expert",
    "discriminator_accuracy_learner",
    "discriminator_accuracy_held_out",
    "reward_critic_loss",
    "cost_critic_loss",
    "critic_loss",
    "policy_loss",
    "recovered_reward_expert",
    "recovered_reward_learner",
    "loss",
    "held_out_loss",
    "skipped_updates",
)
_FACTS = frozenset(
    {"task", "physics", "env_options", "preset", "seed", "num_seeds", "eval_episodes", "demonstrations"}
    | {"expert_return", "expert_cost", "expert_length"}
)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes strict JSON: numbers that are not finite become null. The file is replaced as a whole or not at all."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(json.dumps(_plain(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    temporary.replace(path)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in `path`. Raises `UsageError` if it is missing or damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror}); give a folder that `train` wrote") from None
    except ValueError:
        raise UsageError(f"{path}: not JSON; the run folder is damaged, restore or repeat the run") from None
    if not isinstance(content, dict):
        raise UsageError(f"{path}: not a JSON object; the run folder is damaged, restore or repeat the run")
    return content


@dataclasses.dataclass(frozen=True)
class Run:
    """The content of a run's config.json."""

    folder: Path
    config: Config
    facts: dict[str, Any]  # task, physics, env_options, seeds, demonstrations, ...


def read_run(folder: Path) -> Run:
    """Reads config.json. Raises `UsageError` if it is missing, damaged or of another version."""
    path = folder / "config.json"
    return parse_run(path, read_json(path))


def parse_run(path: Path, facts: dict[str, Any]) -> Run:
    """The run that the content of a config.json describes.

    Args:
        path: of the file that has the content; its folder is that of the run.
        facts: the content; `config` is taken out of it.

    Raises:
        UsageError: a key is missing or unknown, or a value has a wrong type.
    """
    fields = facts.pop("config", None)
    names = {f.name for f in dataclasses.fields(Config)}
    if not isinstance(fields, dict) or not _FACTS.issubset(facts):
        raise UsageError(f"{path}: keys are missing; give a folder that this version's `train` or `expert` wrote")
    if unknown := sorted(set(fields) - names):
        raise UsageError(f"{path}: field '{unknown[0]}' is not known to this version; use the version that wrote it")
    task = TASKS.get(str(facts["task"]))
    if task:  # an earlier version wrote options that make no difference to these tasks
        known = {*task.options, "max_episode_steps"}
        facts["env_options"] = {name: value for name, value in facts["env_options"].items() if name in known}
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()}
    config = Config(**values)
    try:
        check_types(config)
    except ConfigError as error:
        raise UsageError(f"{path}: {error}; the run folder is damaged, restore or repeat the run") from None
    return Run(path.parent, config, facts)


def task_of(run: Run) -> TaskInfo:
    """The task of a run. Raises `UsageError` where it is not known here, or its module cannot be imported."""
    try:
        return registry.find_task(run.facts["task"])
    except ValueError as error:
        task = run.facts["task"]
        raise UsageError(f"RUN_DIR {run.folder}: of task {task}, which is not known here ({error})") from None


def was_continued(run: Run, summary: Mapping[str, Any]) -> bool:
    """Whether a run has been continued for longer since `summary`, the content of summary.json, was written.

    Then its policies may be newer than the summary. config.json says how long the run is to be; the summary says how
    long it was. A run whose seeds were all given up ends earlier, and each of its seeds has left a diagnostic file.
    """
    if summary["env_steps"] >= run.config.num_iterations * run.config.steps_per_iteration:
        return False
    return not all((run.folder / f"fault_seed_{row['seed']}.npz").is_file() for row in summary["per_seed"])


def write_config(folder: Path, config: Config, facts: Mapping[str, Any]) -> None:
    """Writes config.json: `facts` (task, physics, command, seeds, ...), versions, commit, and all hyperparameters."""
    made_by = {"versions": versions(), "git_commit": git_commit()}
    content = {**facts, **made_by, "config": dataclasses.asdict(config)}
    write_json(folder / "config.json", content)


def read_metrics(folder: Path) -> dict[str, np.ndarray]:
    """metrics.csv as `{name: [num_iterations, num_seeds]}`; NaN where a value is unknown.

    Raises `UsageError` if the file is missing or ragged.
    """
    path = folder / "metrics.csv"
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.reader(file)
            names = next(reader)
            table = np.array([[float(x) if x else math.nan for x in row] for row in reader], np.float64)
        num_seeds = int(table[:, 1].max()) + 1
        shaped = table.reshape(-1, num_seeds, len(names))
    except (OSError, StopIteration, ValueError, IndexError):
        raise UsageError(f"{path}: missing, empty or damaged; give a run folder with at least one iteration") from None
    metrics = {name: shaped[:, :, i] for i, name in enumerate(names) if name not in ("iteration", "seed")}
    return without_unknown(metrics)  # earlier versions wrote numbers before there were any


class MetricsWriter:
    """Writes metrics.csv and TensorBoard events, a chunk of iterations at a time; use it as a context manager.

    A value that is unknown (NaN) is an empty field of the file, and is left out of the events. Call `begin` first: it
    replaces the rows of a process that was killed, some of which may be newer than its last checkpoint.
    """

    def __init__(self, folder: Path) -> None:
        # Imported here because it imports protobuf, which is slow. It is not `SummaryWriter`, whose thread ends without
        # a word when the disk is full, so that the training would wait for it for ever.
        from tensorboardX.event_file_writer import EventsWriter

        self.path = folder / "metrics.csv"
        self._events: Any = EventsWriter(str(folder / "events"))
        self._names: list[str] = []

    def begin(self, history: Mapping[str, np.ndarray]) -> None:
        """Writes the file anew with the rows `[iterations, num_seeds]` of a checkpoint; {} for a new run."""
        temporary = self.path.with_name(".metrics.csv.tmp")
        with temporary.open("w", newline="", encoding="utf-8") as file:
            if history:
                self._append(file, history, first=0)
        temporary.replace(self.path)

    def write(self, iteration: int, metrics: Mapping[str, np.ndarray]) -> None:
        """Adds rows `[chunk, num_seeds]`; with the last of them `iteration` iterations are done."""
        with self.path.open("a", newline="", encoding="utf-8") as file:
            first = iteration - len(metrics["env_steps"])
            rows = self._append(file, metrics, first)
        try:
            for number, row in enumerate(rows, first + 1):
                self._write_events(number, row)
            self._events.flush()
        except OSError as error:  # tensorboardX does not name the file
            raise OSError(error.errno, error.strerror, str(self.path.parent)) from error

    def _append(self, file: TextIO, metrics: Mapping[str, np.ndarray], first: int) -> np.ndarray:
        writer = csv.writer(file, lineterminator="\n")
        if not self._names:
            known = [name for name in METRICS if name in metrics]
            self._names = known + sorted(set(metrics) - set(known))
            writer.writerow(["iteration", "seed", *self._names])
        rows = np.stack([np.asarray(metrics[name], np.float64) for name in self._names], axis=-1)
        for number, row in enumerate(rows, first + 1):
            writer.writerows([number, s, *(_text(x) for x in values)] for s, values in enumerate(row))
        return rows

    def _write_events(self, iteration: int, row: np.ndarray) -> None:
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.proto.summary_pb2 import Summary

        # Behaviour cloning takes no environment steps; its axis is the number of passes over the demonstrations.
        steps = int(row[0, self._names.index("env_steps")]) or iteration
        means = known_mean(row, axis=0)
        values = [
            Summary.Value(tag=f"{group}/{name}", simple_value=numbers[i])
            for i, name in enumerate(self._names)
            for group, numbers in (("mean", means), *((f"seed_{s}", numbers) for s, numbers in enumerate(row)))
            if name != "env_steps" and not math.isnan(numbers[i])
        ]
        self._events.write_event(Event(wall_time=time.time(), step=steps, summary=Summary(value=values)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):  # `write` has already raised an error for a full disk
            self._events.close()


def _text(value: float) -> str:
    """A number as text: nine digits, which tell all float32 numbers apart; integers in full; empty for NaN."""
    if math.isnan(value):
        return ""
    return str(int(value)) if value.is_integer() and abs(value) < 2**53 else f"{value:.9g}"
