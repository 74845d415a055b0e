"""The plots of a page: one image for each panel, so that narrow screens stack them, and one legend for all of them."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from ccil_jax.demonstrations.trajectories import standard_error
from experiments.page.entries import Entry
from experiments.page.player import legend
from experiments.policies.policy_file import PolicyFile
from experiments.runs import figures
from experiments.runs.figures import COLORS, Curve, Panel
from experiments.runs.labels import literal

_INK, _LIMIT = "#22262b", "#a0281f"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Results:
    """What the policies of one training reach: means over episodes of each of S seeds, and the levels beside them."""

    label: str
    returns: np.ndarray  # [S]
    costs: np.ndarray  # [S]
    return_errors: np.ndarray  # [S] standard errors over episodes; NaN where they are not known
    cost_errors: np.ndarray  # [S]
    levels: Mapping[str, float | None]  # `summary.levels_of`
    cost_limit: float | None  # a limit that was prescribed

    @property
    def allowed_cost(self) -> float | None:
        """The cost above which there is a violation, as in `summary.Reference`."""
        expert_cost = self.levels.get("expert_cost")
        return self.cost_limit if expert_cost is None else expert_cost


def of_run(entry: Entry) -> Results:
    """The results of a run, from its summary."""

    def column(name: str) -> np.ndarray:
        return np.array([row.get(name) for row in entry.summary["per_seed"]], np.float64)  # NaN for None

    return Results(
        label=entry.label,
        returns=column("episode_return"),
        costs=column("episode_cost"),
        return_errors=column("episode_return_standard_error"),
        cost_errors=column("episode_cost_standard_error"),
        levels=entry.summary,
        cost_limit=entry.summary.get("cost_limit"),
    )


def of_file(file: PolicyFile, label: str) -> Results | None:
    """The results of policies, from the episodes in their file; None where it holds none."""
    if {"episode_return", "episode_cost"} - file.episodes.keys():
        return None
    returns, costs = (file.episodes[name] for name in ("episode_return", "episode_cost"))
    errors = (np.array([standard_error(row) for row in rows], np.float64) for rows in (returns, costs))
    return_errors, cost_errors = errors
    return Results(
        label=label,
        returns=returns.mean(axis=1),
        costs=costs.mean(axis=1),
        return_errors=return_errors,
        cost_errors=cost_errors,
        levels=file.metadata["levels"],
        cost_limit=file.training["cost_limit"],
    )


def of_curves(entries: Sequence[Entry]) -> str:
    """The HTML of the learning curves of runs of a task, of return against cost, and of what goes on inside methods.

    The last are shown on demand.
    """
    curves = [figures.read_curve(e.run.folder, e.label) for e in entries]
    results = [of_run(e) for e in entries]
    images = [*_panels(figures.panels_of(curves)), _scatter(results)]
    inner = _panels(figures.inner_panels_of(curves))
    several = any(c.metrics["env_steps"].shape[1] > 1 for c in curves)
    seeds = "Thick: mean over seeds. Band: standard deviation. Thin: every seed. " if several else ""
    note = (
        f"{seeds}{_points(curves)}Dashed: mean of the demonstrations, with its standard error where that is known. In "
        "return against cost, a small dot is a seed, a large one the mean over seeds, and the star the expert, with "
        "standard errors over episodes; to the right of the line costs are above the limit."
    )
    more = (
        f"<details><summary>Inside the methods: multiplier, meta-gradient, discriminator</summary>{_grid(inner)}"
        "</details>"
        if inner
        else ""
    )
    return f"{_legend(results)}<figure>{_grid(images)}<figcaption>{note}</figcaption></figure>{more}"


def of_policies(by_task: Mapping[str, Sequence[Results]]) -> str:
    """The HTML of return against cost of policies, a plot for each task."""
    plots = (
        f"<div>{_legend(results)}{_scatter(results, f'{task}: return against cost')}</div>"
        for task, results in by_task.items()
    )
    note = "Means with standard errors over episodes. The line is the cost limit; a star, if there is one, the expert."
    return f"<figure>{_grid([*plots])}<figcaption>{note}</figcaption></figure>"


def _points(curves: Sequence[Curve]) -> str:
    windows = sorted({c.window for c in curves if c.window > 1})
    return f"A point is a mean over {' or '.join(map(str, windows))} iterations. " if windows else ""


def _legend(results: Sequence[Results]) -> str:
    rows = [(COLORS[i % len(COLORS)], found.label) for i, found in enumerate(results)]
    has_expert = any(found.levels.get("expert_return") is not None for found in results)
    return legend([*rows, *([(_INK, "expert")] * has_expert)])


def _panels(panels: Sequence[Panel]) -> list[str]:
    return [figures.html_image(figures.png(figures.draw_panel(panel)), panel.title) for panel in panels]


def _grid(images: Sequence[str]) -> str:
    return f"<div class=panels>{''.join(images)}</div>"


def _scatter(results: Sequence[Results], title: str = "Return against cost") -> str:
    return figures.html_image(figures.png(draw_return_against_cost(results, title)), title)


def draw_return_against_cost(results: Sequence[Results], title: str) -> Figure:
    """Every seed, the mean over the seeds of each training with its error over episodes, the expert and the limit."""
    with mpl.rc_context(figures.SMALL_STYLE):
        figure = Figure(figsize=figures.SMALL, dpi=150, layout="constrained")
        axes = figure.subplots()
        for i, found in enumerate(results):
            color, count = COLORS[i % len(COLORS)], len(found.returns)
            errors: Any = [np.sqrt(np.square(e).sum()) / count for e in (found.cost_errors, found.return_errors)]
            x_error, y_error = (None if np.isnan(error) else error for error in errors)
            if count > 1:
                axes.plot(found.costs, found.returns, "o", color=color, markersize=3.5, alpha=0.5)
            middle = found.costs.mean(), found.returns.mean()
            axes.errorbar(*middle, y_error, x_error, fmt="o", color=color, markersize=8, capsize=3, zorder=3)
        _draw_levels(axes, results)
        axes.set_title(literal(title))
        axes.set_xlabel("cost per episode")
        axes.set_ylabel("return")
        axes.margins(0.12)
    return figure


def _draw_levels(axes: Any, results: Sequence[Results]) -> None:
    names = ("expert_cost", "expert_return", "expert_cost_standard_error", "expert_return_standard_error")
    for cost, level, cost_error, level_error in {tuple(map(found.levels.get, names)) for found in results}:
        if cost is not None and level is not None:
            style: Any = {"fmt": "*", "color": _INK, "markersize": 12, "capsize": 3, "zorder": 4}
            axes.errorbar(cost, level, level_error, cost_error, **style)
    for limit in {found.allowed_cost for found in results} - {None}:
        axes.axvline(limit, color=_LIMIT, linewidth=1.2, linestyle=(0, (1, 2)))
