"""Progress of a training: a live bar on a terminal, plain lines elsewhere (in log files and pipes).

Everything is written to standard error. Importing this module imports neither JAX nor rich.
"""

import math
import sys
import time
from types import TracebackType
from typing import Any, Self

import numpy as np

_SECONDS_BETWEEN_LINES = 10.0


class Display:
    """Shows the return, the cost beside its limit, the multiplier, the speed and the time left.

    Use it as a context manager, and hand `update` to `runner.train` as `on_progress`.
    """

    def __init__(self, title: str, num_iterations: int, cost_limit: float | None, *, has_multiplier: bool) -> None:
        """Prepares the display; the bar appears when the context begins.

        Args:
            title: stands at the beginning of the bar or of each line.
            num_iterations: of the whole training (`Config.num_iterations`).
            cost_limit: is shown beside the cost (`Config.cost_limit`); None where there is none, or where the runs that
                are trained together have different ones.
            has_multiplier: whether there is a multiplier to show (`Config.has_multiplier`).
        """
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        # A name of a folder may look like rich's markup or like the name of an emoji. It is shown as it is.
        self._console = Console(file=sys.stderr, soft_wrap=True, markup=False, emoji=False)
        self._cost_limit = cost_limit
        self._has_multiplier = has_multiplier
        self._title = title
        self._started = self._last_line = time.monotonic()
        self._first_iteration: int | None = None
        self._bar: Any = None
        if self._console.is_terminal:
            columns = (
                TextColumn("{task.description}", markup=False),
                BarColumn(bar_width=None),
                MofNCompleteColumn(),
                TextColumn("{task.fields[status]}", markup=False),
                TimeRemainingColumn(),
            )
            self._bar = Progress(*columns, console=self._console, expand=True)
            self._task = self._bar.add_task(title, total=num_iterations, status="compiling ...")

    def message(self, text: str) -> None:
        """Prints one line above the bar."""
        self._console.print(text, highlight=False)

    def update(self, progress: Any) -> None:
        """Shows the state after a chunk of iterations, a `ccil_jax.training.loop.Progress`."""
        now = time.monotonic()
        if self._first_iteration is None:
            self._first_iteration, self._started = progress.iteration, now
            self.message(f"compiled in {progress.compile_seconds:.1f} s")
        status = self._status(progress)
        if self._bar is not None:
            self._bar.update(self._task, completed=progress.iteration, status=status)
        elif progress.iteration == progress.num_iterations or now - self._last_line >= _SECONDS_BETWEEN_LINES:
            self._last_line = now
            left = self._time_left(progress, now)
            self.message(f"{self._title} {progress.iteration}/{progress.num_iterations}  {status}{left}")

    def _status(self, progress: Any) -> str:
        latest = {name: _known_mean(rows[-1]) for name, rows in progress.metrics.items()}
        limit = "" if self._cost_limit is None else f" / {number(self._cost_limit)}"
        labels = {"loss": "loss", "held_out_loss": "held out"}  # behaviour cloning does not act while it learns
        if "episode_return" in latest:
            labels = {"episode_return": "return", "episode_cost": "cost"}
        if self._has_multiplier:
            labels["multiplier"] = "lambda"
        # An agent of the user's own may report other metrics.
        parts = [
            f"{label} {number(latest[name])}{limit if name == 'episode_cost' else ''}"
            for name, label in labels.items()
            if name in latest
        ]
        if "episode_return" in latest:
            parts.append(f"{progress.env_steps_per_second:,.0f} steps/s")
        return "  ".join(parts)

    def _time_left(self, progress: Any, now: float) -> str:
        done = progress.iteration - (self._first_iteration or 0)
        if done <= 0:
            return ""
        seconds = round((now - self._started) / done * (progress.num_iterations - progress.iteration))
        return f"  {seconds // 60}:{seconds % 60:02d} left"

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()


def _known_mean(row: np.ndarray) -> float:
    """Mean over the runs [num_runs] whose value is known; NaN where none is."""
    known = row[~np.isnan(row)]
    return float(known.mean()) if known.size else math.nan


def number(value: float | None) -> str:
    """Three or four significant digits, never in exponent form; a dash for None and NaN."""
    if value is None or math.isnan(value):
        return "-"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.1f}" if abs(value) >= 100 else f"{value:.2f}"
