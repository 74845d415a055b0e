"""The file metrics.csv of a run, a row for each iteration and seed, and the same numbers as TensorBoard events."""

import contextlib
import csv
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

import numpy as np

from ccil_jax.training.history import without_unknown
from experiments.cli.command_line import UsageError
from experiments.runs.intervals import known_mean

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
    "reward_critic_explained_variance",
    "cost_critic_explained_variance",
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


def columns_of(metrics: Mapping[str, np.ndarray]) -> list[str]:
    """The names of the metrics that a method reports, in the order of the columns of metrics.csv."""
    known = [name for name in METRICS if name in metrics]
    return known + sorted(set(metrics) - set(known))


def rows_of(metrics: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    """The metrics `[iterations, num_seeds]` of these names as one array `[iterations, num_seeds, names]`, float64."""
    return np.stack([np.asarray(metrics[name], np.float64) for name in names], axis=-1)


def tagged(iteration: int, names: Sequence[str], row: np.ndarray) -> tuple[int, dict[str, float]]:
    """An iteration as logs of events have it.

    Args:
        iteration: its number, from 1.
        names: of the metrics, `env_steps` among them.
        row: `[num_seeds, names]`; NaN where a value is unknown.

    Returns:
        The place on the axis, in environment steps, and the known values under `mean/NAME` and `seed_N/NAME`.
    """
    # Behaviour cloning takes no environment steps; its axis is the number of iterations.
    steps = int(row[0, names.index("env_steps")]) or iteration
    groups = {"mean": known_mean(row, axis=0), **{f"seed_{s}": numbers for s, numbers in enumerate(row)}}
    values = {
        f"{group}/{name}": float(numbers[i])
        for i, name in enumerate(names)
        for group, numbers in groups.items()
        if name != "env_steps" and not math.isnan(numbers[i])
    }
    return steps, values


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
            self._names = columns_of(metrics)
            writer.writerow(["iteration", "seed", *self._names])
        rows = rows_of(metrics, self._names)
        for number, row in enumerate(rows, first + 1):
            writer.writerows([number, s, *(_text(x) for x in values)] for s, values in enumerate(row))
        return rows

    def _write_events(self, iteration: int, row: np.ndarray) -> None:
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.proto.summary_pb2 import Summary

        steps, numbers = tagged(iteration, self._names, row)
        values = [Summary.Value(tag=tag, simple_value=number) for tag, number in numbers.items()]
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
