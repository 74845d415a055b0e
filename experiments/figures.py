"""Learning curves as PNG files: mean and standard deviation over seeds, with the expert's level drawn."""

import base64
import dataclasses
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments import run_folder

PANELS = (
    ("episode_return", "Return"),
    ("episode_cost", "Cost per episode"),
    ("cost_rate", "Cost rate"),
)
CLONING_PANELS = (  # of a method that does not act while it learns
    ("loss", "Loss, nats"),
    ("held_out_loss", "Loss on held-out steps, nats"),
)
_MAX_POINTS = 100  # of a curve: few episodes end in an iteration, and their scatter would hide the learning
COLORS = ("#0b6e99", "#d1495b", "#6a994e", "#e09f3e", "#7b5ea7", "#3d405b", "#00a5a5", "#a44a3f")
STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8a8f98",
    "axes.grid": True,
    "grid.color": "#e7e9ec",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "xtick.color": "#4a4f57",
    "ytick.color": "#4a4f57",
    "legend.frameon": False,
}


@dataclasses.dataclass(frozen=True)
class Curve:
    """One run's metrics, [num_iterations, num_seeds] each, and the levels to draw beside them (None: unknown)."""

    label: str
    metrics: dict[str, np.ndarray]
    expert_levels: dict[str, float | None]  # by metric name
    cost_limit: float | None


def read_curve(folder: Path, label: str | None = None) -> Curve:
    """The curve of a run folder. Raises `UsageError` for a folder without metrics."""
    run = run_folder.read_run(folder)
    cost, length = run.facts["expert_cost"], run.facts["expert_length"]
    return Curve(
        label=label or run.config.method,
        metrics=run_folder.read_metrics(folder),
        expert_levels={
            "episode_return": run.facts["expert_return"],
            "episode_cost": cost,
            "cost_rate": cost / length if length else None,
        },
        cost_limit=run.config.cost_limit,
    )


def draw_run(folder: Path) -> Path:
    """Writes figures/curves.png (three panels) and one file per panel; returns the path of the first."""
    curve = read_curve(folder)
    task = run_folder.read_run(folder).facts["task"]
    target = folder / "figures"
    target.mkdir(exist_ok=True)
    for name, _ in panels_of([curve]):
        (target / f"{name}.png").write_bytes(png(draw_panels([curve], task, [name])))
    path = target / "curves.png"
    path.write_bytes(png(draw_panels([curve], task)))
    return path


def panels_of(curves: Sequence[Curve]) -> tuple[tuple[str, str], ...]:
    """(metric, title) of the panels that at least one of the curves has something to show in."""
    return tuple(panel for panel in PANELS + CLONING_PANELS if any(panel[0] in c.metrics for c in curves))


def draw_panels(curves: Sequence[Curve], task: str, names: Sequence[str] | None = None) -> Figure:
    """One panel per metric that the runs have (or for each of `names`), all runs overlaid."""
    panels = [panel for panel in panels_of(curves) if names is None or panel[0] in names]
    steps = {_steps_per_iteration(c) for c in curves}
    label = f"iterations of {min(steps):,} steps" if len(steps) == 1 else "environment steps per seed"
    if steps == {0}:
        label = "passes over the demonstrations"
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.1 * len(panels) + 0.3, 3.9), dpi=150, layout="constrained")
        for axes, (name, title) in zip(np.atleast_1d(figure.subplots(1, len(panels))), panels, strict=True):
            for i, curve in enumerate(curves):
                if name in curve.metrics:
                    _draw_curve(axes, curve, name, COLORS[i % len(COLORS)], by_iteration=len(steps) == 1)
            _draw_levels(axes, curves, name)
            axes.set_title(title)
            axes.set_xlabel(label)
        _decorate(figure, curves, task)
    return figure


def png(figure: Figure) -> bytes:
    """The figure as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def html_image(image: bytes, text: str) -> str:
    """An `img` element that holds the PNG file itself; `text` stands for it where it is not shown."""
    source = f"data:image/png;base64,{base64.b64encode(image).decode()}"
    return f"<img alt='{html.escape(text, quote=True)}' src='{source}'>"


def _steps_per_iteration(curve: Curve) -> int:
    return int(curve.metrics["env_steps"][0, 0])


def _window(curve: Curve) -> int:
    """Iterations behind one point of the curve."""
    return -(-len(curve.metrics["env_steps"]) // _MAX_POINTS)


def binned(values: np.ndarray, window: int) -> np.ndarray:
    """Means over `window` rows in turn, the last over what is left: [T, ...] -> [ceil(T / window), ...]; NaN stays."""
    starts = np.arange(0, len(values), window)
    counts = np.diff([*starts, len(values)]).reshape(-1, *[1] * (values.ndim - 1))
    means: np.ndarray = np.add.reduceat(values, starts, axis=0, dtype=np.float64) / counts
    return means


def _draw_curve(axes: Axes, curve: Curve, name: str, color: str, *, by_iteration: bool) -> None:
    values = curve.metrics[name]  # [num_iterations, num_seeds]
    if name != "cost_rate" and "episodes_finished" in curve.metrics:  # before the first end there is nothing to show
        values = np.where(np.cumsum(curve.metrics["episodes_finished"], axis=0) > 0, values, np.nan)
    x = np.arange(1, len(values) + 1) if by_iteration else curve.metrics["env_steps"][:, 0]
    window = _window(curve)
    x, values = binned(x, window), binned(values, window)
    mean, deviation = values.mean(axis=1), values.std(axis=1)
    if values.shape[1] > 1:
        axes.plot(x, values, color=color, linewidth=0.7, alpha=0.35)
        axes.fill_between(x, mean - deviation, mean + deviation, color=color, alpha=0.18, linewidth=0)
    axes.plot(x, mean, color=color, linewidth=2.0, label=curve.label)


def _draw_levels(axes: Axes, curves: Sequence[Curve], name: str) -> None:
    levels = sorted({level for c in curves if (level := c.expert_levels.get(name)) is not None})
    for i, level in enumerate(levels):
        axes.axhline(level, color="#22262b", linewidth=1.3, linestyle=(0, (5, 3)), label=None if i else "expert")
    limits = sorted({c.cost_limit for c in curves if c.cost_limit is not None}) if name == "episode_cost" else []
    for i, limit in enumerate(limits):
        axes.axhline(limit, color="#a0281f", linewidth=1.3, linestyle=(0, (1, 2)), label=None if i else "cost limit")
    if name in ("episode_cost", "cost_rate"):
        axes.set_ylim(bottom=0.0)  # costs are not negative, and a band below zero would mislead


def _decorate(figure: Figure, curves: Sequence[Curve], task: str) -> None:
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    counts = sorted({c.metrics["env_steps"].shape[1] for c in curves})
    seeds = " or ".join(str(c) for c in counts)
    windows = sorted({_window(c) for c in curves})
    points = "" if windows == [1] else f"; each point: {' or '.join(map(str, windows))} iterations"
    figure.suptitle(
        f"{task}: mean and standard deviation over {seeds} seed{'' if counts == [1] else 's'}{points}",
        x=0.008,
        horizontalalignment="left",
        fontsize=10.5,
        color="#4a4f57",
    )
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6)
