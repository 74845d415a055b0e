"""Learning curves as PNG files: mean and standard deviation over seeds, with the level of the demonstrations drawn."""

import base64
import dataclasses
import html
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ccil_jax.config import CLONING_UPDATES_PER_ITERATION
from experiments.cli.names import safe_name
from experiments.runs import run_folder
from experiments.runs.intervals import known_deviation, known_mean
from experiments.runs.labels import literal
from experiments.runs.metrics_file import read_metrics

PANELS = (
    ("episode_return", "Return"),
    ("episode_cost", "Cost per episode"),
    ("cost_rate", "Cost rate"),
)
CLONING_PANELS = (  # of a method that does not act while it learns
    ("loss", "Loss, nats"),
    ("held_out_loss", "Loss on held-out steps, nats"),
)
INNER_PANELS = (  # of what goes on inside a method
    ("multiplier", "Multiplier"),
    ("meta_gradient", "Meta-gradient of the multiplier"),
    ("discriminator_accuracy_held_out", "Discriminator's accuracy, held-out"),
)
_DEMONSTRATIONS, _ERROR, _LIMIT = _LEVEL_LABELS = ("mean of the demonstrations", "its standard error", "cost limit")
_MAX_POINTS = 100  # of a curve. Few episodes end in an iteration, so that single iterations scatter too much
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
SMALL = (4.6, 3.1)  # inches, of a single panel; with the larger letters it can be read on a telephone
SMALL_STYLE: Any = {**STYLE, "font.size": 11.5, "axes.titlesize": 12.5}


@dataclasses.dataclass(frozen=True)
class Curve:
    """One run's metrics, [num_iterations, num_seeds] each, and the levels to draw beside them (None: unknown)."""

    label: str
    metrics: Mapping[str, np.ndarray]
    expert_levels: Mapping[str, float | None]  # by metric name
    cost_limit: float | None
    expert_errors: Mapping[str, float | None] = dataclasses.field(default_factory=dict)  # their standard errors

    iteration: str = f"iterations of {CLONING_UPDATES_PER_ITERATION} gradient steps"  # where it takes no step of a task

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps that an iteration takes; 0 for behaviour cloning."""
        return int(self.metrics["env_steps"][0, 0])

    @property
    def window(self) -> int:
        """Iterations that one point of the curve is a mean of."""
        return -(-len(self.metrics["env_steps"]) // _MAX_POINTS)


def read_curve(folder: Path, label: str | None = None) -> Curve:
    """The curve of a run folder. Raises `UsageError` for a folder without metrics."""
    run = run_folder.read_run(folder)
    cost, length = run.facts["expert_cost"], run.facts["expert_length"]
    return Curve(
        label=label or run.config.method,
        metrics=read_metrics(folder),
        expert_levels={
            "episode_return": run.facts["expert_return"],
            "episode_cost": cost,
            "cost_rate": cost / length if length else None,
        },
        cost_limit=run.config.prescribed_limit,
        expert_errors={
            name: run.facts.get(f"{level}_standard_error")  # earlier versions do not say
            for name, level in (("episode_return", "expert_return"), ("episode_cost", "expert_cost"))
        },
        **({"iteration": "passes over the demonstrations"} if "bc_epochs" in run.gone else {}),
    )


def draw_run(folder: Path) -> Path:
    """Writes figures/curves.png (three panels) and one file per panel; returns the path of the first."""
    curve = read_curve(folder)
    task = run_folder.read_run(folder).facts["task"]
    target = folder / "figures"
    target.mkdir(exist_ok=True)
    for panel in panels_of([curve]):
        (target / f"{safe_name(panel.metric)}.png").write_bytes(png(draw_panels([curve], task, [panel.metric])))
    path = target / "curves.png"
    path.write_bytes(png(draw_panels([curve], task)))
    return path


@dataclasses.dataclass(frozen=True)
class Panel:
    """One metric, of the runs that have it and that count on the same axis."""

    metric: str
    title: str
    curves: Mapping[int, Curve]  # by their index among all curves, which decides on the colour
    cloning: bool  # whether the axis counts iterations of behaviour cloning; otherwise it counts environment steps


def panels_of(curves: Sequence[Curve]) -> list[Panel]:
    """The panels that at least one of the curves has something to show in.

    An agent of the user's own may report none of the usual metrics; then all that it reports is shown.
    """
    usual = PANELS + CLONING_PANELS
    strange = [c.metrics for c in curves if not any(metric in c.metrics for metric, _ in usual)]
    others = dict.fromkeys(name for metrics in strange for name in metrics if name != "env_steps")
    return _panels(dict(enumerate(curves)), [*usual, *((name, name) for name in others)])


def inner_panels_of(curves: Sequence[Curve]) -> list[Panel]:
    """The panels of INNER_PANELS, with the curves that are not zero all along, as without a multiplier."""

    def has(curve: Curve, metric: str) -> bool:
        return bool(np.nan_to_num(curve.metrics.get(metric, np.zeros(1))).any())

    panels = [_panels({i: c for i, c in enumerate(curves) if has(c, row[0])}, [row]) for row in INNER_PANELS]
    return [panel for found in panels for panel in found]


def _panels(curves: Mapping[int, Curve], titles: Sequence[tuple[str, str]]) -> list[Panel]:
    found = []
    for metric, title in titles:
        for cloning in (False, True):
            own = {i: c for i, c in curves.items() if metric in c.metrics and (c.steps_per_iteration == 0) is cloning}
            if own:
                found.append(Panel(metric, title, own, cloning))
    return found


def draw_panel(panel: Panel) -> Figure:
    """One panel without a legend, for pages that put panels beside or below each other and have one legend for all."""
    with mpl.rc_context(SMALL_STYLE):
        figure = Figure(figsize=SMALL, dpi=150, layout="constrained")
        _draw_panel(figure.subplots(), panel)
    return figure


def draw_panels(curves: Sequence[Curve], task: str, names: Sequence[str] | None = None) -> Figure:
    """One panel per metric that the runs have (or for each of `names`), all runs overlaid."""
    panels = [panel for panel in panels_of(curves) if names is None or panel.metric in names]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.1 * len(panels) + 0.3, 3.9), dpi=150, layout="constrained")
        # Matplotlib leaves labels with a leading underscore out of a legend, unless its entries are listed explicitly.
        entries: dict[str, Any] = {}
        for axes, panel in zip(np.atleast_1d(figure.subplots(1, len(panels))), panels, strict=True):
            entries = _draw_panel(axes, panel) | entries
        _decorate(figure, curves, task)
        order = sorted(entries, key=[*(c.label for c in curves), *_LEVEL_LABELS].index)
        figure.legend([entries[x] for x in order], [literal(x) for x in order], loc="outside lower center", ncols=6)
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


def binned(values: np.ndarray, window: int) -> np.ndarray:
    """Means over every `window` rows, the last over the remaining rows: [T, ...] -> [ceil(T / window), ...].

    A mean over rows with a NaN is NaN.
    """
    starts = np.arange(0, len(values), window)
    counts = np.diff([*starts, len(values)]).reshape(-1, *[1] * (values.ndim - 1))
    means: np.ndarray = np.add.reduceat(values, starts, axis=0, dtype=np.float64) / counts
    return means


def _draw_panel(axes: Axes, panel: Panel) -> dict[str, Any]:
    """Draws curves and levels; returns the entries of the legend by their labels."""
    steps = {curve.steps_per_iteration for curve in panel.curves.values()}
    entries = {
        curve.label: _draw_curve(axes, curve, panel.metric, COLORS[i % len(COLORS)], by_iteration=len(steps) == 1)
        for i, curve in panel.curves.items()
    }
    entries |= _draw_levels(axes, list(panel.curves.values()), panel.metric)
    if all(np.isnan(curve.metrics[panel.metric]).all() for curve in panel.curves.values()):
        axes.set_xticks([])
        axes.text(0.5, 0.2, "not known yet", transform=axes.transAxes, ha="center", color="#4a4f57")
    axes.set_title(literal(panel.title))
    if panel.cloning:
        axes.set_xlabel(" or ".join(dict.fromkeys(curve.iteration for curve in panel.curves.values())))
    else:
        axes.set_xlabel(f"iterations of {min(steps):,} steps" if len(steps) == 1 else "environment steps per seed")
    return entries


def _draw_curve(axes: Axes, curve: Curve, name: str, color: str, *, by_iteration: bool) -> Any:
    values = curve.metrics[name]  # [num_iterations, num_seeds]
    x = np.arange(1, len(values) + 1) if by_iteration else curve.metrics["env_steps"][:, 0]
    x, values = binned(x, curve.window), binned(values, curve.window)
    mean, deviation = known_mean(values, axis=1), known_deviation(values, axis=1)
    if values.shape[1] > 1:
        axes.plot(x, values, color=color, linewidth=0.7, alpha=0.35)
        axes.fill_between(x, mean - deviation, mean + deviation, color=color, alpha=0.18, linewidth=0)
    return axes.plot(x, mean, color=color, linewidth=2.0)[0]


def _draw_levels(axes: Axes, curves: Sequence[Curve], name: str) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    levels = {(c.expert_levels.get(name), c.expert_errors.get(name)) for c in curves}
    for level, error in levels:
        if level is None:
            continue
        line = axes.axhline(level, color="#22262b", linewidth=1.3, linestyle=(0, (5, 3)))
        entries.setdefault(_DEMONSTRATIONS, line)
        if error is not None:
            band = axes.axhspan(level - error, level + error, color="#22262b", alpha=0.13, linewidth=0)
            entries.setdefault(_ERROR, band)
    limits = {c.cost_limit for c in curves if c.cost_limit is not None} if name == "episode_cost" else ()
    for limit in limits:
        line = axes.axhline(limit, color="#a0281f", linewidth=1.3, linestyle=(0, (1, 2)))
        entries.setdefault(_LIMIT, line)
    if name in ("episode_cost", "cost_rate"):
        axes.set_ylim(bottom=0.0)  # costs are never negative, so that a band below zero would be misleading
    return entries


def _decorate(figure: Figure, curves: Sequence[Curve], task: str) -> None:
    counts = sorted({c.metrics["env_steps"].shape[1] for c in curves})
    seeds = " or ".join(map(str, counts))
    what = "one seed" if counts == [1] else f"mean and standard deviation over {seeds} seeds"
    windows = sorted({(c.window, "iterations" if c.steps_per_iteration else "passes") for c in curves if c.window > 1})
    points = f"; each point: {' or '.join(f'{count} {unit}' for count, unit in windows)}" if windows else ""
    figure.suptitle(
        literal(f"{task}: {what}{points}"),
        x=0.008,
        horizontalalignment="left",
        fontsize=10.5,
        color="#4a4f57",
    )
