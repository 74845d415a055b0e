"""The training loop in Python: it calls the compiled program, collects metrics, reports, saves and stops."""

import dataclasses
import time
from collections.abc import Callable, Sequence

import numpy as np

from ccil_jax.config import Config
from ccil_jax.training import guard
from ccil_jax.training.checkpointing import Checkpointer
from ccil_jax.training.guard import GuardedState
from ccil_jax.training.history import without_unknown
from ccil_jax.training.program import Program

CHECKPOINT_SECONDS = 60.0  # between two checkpoints; a process that is killed loses about this much work
SAVING_SHARE = 0.02  # of the time may go into saving: a state that takes long to save is saved less often
CHUNK_SECONDS = 1.0  # between two returns to Python, unless a single iteration takes longer

History = dict[str, np.ndarray]  # metrics [iterations, num_runs], by name


@dataclasses.dataclass(frozen=True, kw_only=True)
class Progress:
    """What `on_progress` is called with after every chunk of iterations."""

    iteration: int  # number of iterations that are finished
    num_iterations: int  # of the whole training
    metrics: History  # of the iterations of this chunk, [chunk, num_runs] each; NaN for what is not known yet
    env_steps_per_second: float  # of this chunk, all runs together
    compile_seconds: float
    stopped: np.ndarray  # [num_runs] bool: runs that were given up, see `guard.protect`


@dataclasses.dataclass(frozen=True, kw_only=True)
class Snapshot:
    """All runs of a program after a number of iterations."""

    iteration: int
    state: GuardedState  # [num_runs]-leading; its buffers are gone once the program has gone on from it
    history: History  # of all iterations so far; {} before the first
    stopped: np.ndarray  # [num_runs] bool


def snapshot_of(config: Config, iteration: int, state: GuardedState, history: History) -> Snapshot:
    """A snapshot of this state. NaN takes the place of metrics that are not known yet."""
    return Snapshot(
        iteration=iteration,
        state=state,
        history=without_unknown(history),
        stopped=np.asarray(guard.stopped(state, config.max_skipped_updates)),
    )


def go_on(
    program: Program,
    config: Config,
    snapshot: Snapshot,
    last: int,
    *,
    checkpoints: Checkpointer | None,
    observers: Sequence[Callable[[Progress], None]],
    should_stop: Callable[[], bool] | None,
) -> Snapshot:
    """Goes on from `snapshot` until `last` iterations are done, all runs have stopped, or `should_stop` says so.

    Args:
        program: of all runs.
        config: stands for all runs: only its static fields are used here.
        snapshot: where to begin.
        last: the iteration after which to stop.
        checkpoints: where to save, about once in `CHECKPOINT_SECONDS` and at the end; None for nowhere.
        observers: are called after every chunk, once it is saved.
        should_stop: is asked after every chunk.
    """
    saver = _Saver(checkpoints)
    length = 1  # the first chunk measures how long an iteration takes
    while snapshot.iteration < last and not snapshot.stopped.all():
        length = min(length, last - snapshot.iteration)
        start = time.perf_counter()
        snapshot = _advance(program, config, snapshot, length)
        elapsed = time.perf_counter() - start
        finished = snapshot.iteration >= last or bool(snapshot.stopped.all())
        stop = finished or (should_stop is not None and should_stop())
        saver.save(snapshot, now=stop)
        progress = Progress(
            iteration=snapshot.iteration,
            num_iterations=config.num_iterations,
            metrics={name: rows[-length:] for name, rows in snapshot.history.items()},
            env_steps_per_second=length * config.steps_per_iteration * len(snapshot.stopped) / elapsed,
            compile_seconds=program.compile_seconds,
            stopped=snapshot.stopped,
        )
        for observe in observers:
            observe(progress)
        if stop:
            break
        length = max(1, min(program.chunk_length, int(CHUNK_SECONDS * length / elapsed)))
    return snapshot


def _advance(program: Program, config: Config, snapshot: Snapshot, length: int) -> Snapshot:
    """`length` iterations more."""
    state, metrics = program.chunk(snapshot.state, length)
    # Cut by NumPy: JAX would compile a slice for every length.
    rows = _rows({name: np.asarray(value)[:, :length] for name, value in metrics.items()}, snapshot.iteration, config)
    before = snapshot.history
    # Of a metric that an earlier version did not have, the rows so far are unknown.
    unknown = np.full((snapshot.iteration, len(snapshot.stopped)), np.nan)
    history = {name: np.concatenate([before.get(name, unknown), row]) if before else row for name, row in rows.items()}
    return snapshot_of(config, snapshot.iteration + length, state, history)


def _rows(metrics: History, done: int, config: Config) -> History:
    """Metrics of a chunk, [num_runs, chunk] each, as rows [chunk, num_runs], with the number of environment steps."""
    rows = {name: value.T for name, value in metrics.items()}
    length, num_runs = next(iter(rows.values())).shape
    # Counted by NumPy, because JAX's integers have 32 bits, and a long training takes more steps than they can count.
    env_steps = np.arange(done + 1, done + length + 1, dtype=np.int64) * config.steps_per_iteration
    return {"env_steps": np.tile(env_steps[:, None], (1, num_runs)), **rows}


class _Saver:
    """Saves snapshots at the right times."""

    def __init__(self, checkpoints: Checkpointer | None) -> None:
        self._checkpoints = checkpoints
        self._saved_at = time.perf_counter()
        self._seconds = 0.0  # that the last save took

    def save(self, snapshot: Snapshot, *, now: bool) -> None:
        """Saves if it is time for it, or if it must be `now`."""
        waited = time.perf_counter() - self._saved_at
        if self._checkpoints is None or not (now or waited > max(CHECKPOINT_SECONDS, self._seconds / SAVING_SHARE)):
            return
        start = time.perf_counter()
        self._checkpoints.save(snapshot.iteration, {"state": snapshot.state, "history": snapshot.history})
        self._saved_at = time.perf_counter()
        self._seconds = self._saved_at - start
