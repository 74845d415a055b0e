"""The figure of the launcher `theorem1`, with six panels."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.runs import figures
from experiments.theory import tabular
from experiments.theory.tabular import Array, Solution
from experiments.theory.theorem1_checks import BETAS, BOUNDS
from experiments.theory.theorem1_methods import NUM_ROUNDS, Run
from experiments.theory.theorem1_problem import BETA, Problem

BLUE, RED, GREEN = figures.COLORS[:3]
DARK: Any = {"color": "#22262b", "linewidth": 1.2, "linestyle": (0, (5, 3))}


def draw(
    path: Path,
    problem: Problem,
    learners: Sequence[Solution],
    small: Array,
    ccil: Run,
    cvag: Run,
    settled: Solution,
) -> None:
    """Writes the PNG file."""
    with mpl.rc_context(figures.STYLE):
        figure = Figure(figsize=(13.2, 7.4), dpi=130, layout="constrained")
        axes = figure.subplots(2, 3).ravel()
        _dual_functions(axes[0], problem)
        _bounds(axes[1], problem, learners)
        _small_entropy(axes[2], small)
        _convergence(axes[3], ccil, cvag)
        _costs(axes[4], problem, ccil, cvag)
        _multipliers(axes[5], problem, ccil, cvag, settled)
        path.write_bytes(figures.png(figure))


def _dual_functions(axes: Axes, problem: Problem) -> None:
    grid = np.linspace(0, 2 * problem.bound_by_cheap.multiplier, 41)
    for name, expert, solution, color in (
        ("cheap expert", problem.cheap, problem.bound_by_cheap, BLUE),
        ("costly expert", problem.costly, problem.bound_by_costly, RED),
    ):
        values = [tabular.learner(problem.process, expert, BETA, x).value - solution.value for x in grid]
        axes.plot(grid, values, color=color, linewidth=2, label=name)
        axes.plot(solution.multiplier, 0, "o", color=color, clip_on=False)
    axes.set_title("The dual function, less its maximum")
    axes.set_xlabel("multiplier (dots: lambda*)")
    axes.legend()


def _bounds(axes: Axes, problem: Problem, learners: Sequence[Solution]) -> None:
    expert = problem.process.episode_cost(problem.cheap)
    axes.semilogx(BOUNDS, [problem.process.episode_cost(x.rho) for x in learners], color=BLUE, linewidth=2)
    axes.axhline(expert, **DARK, label="cheap expert")
    axes.axvline(problem.bound_by_cheap.multiplier, color=RED, linewidth=1.2, linestyle=(0, (1, 2)), label="lambda*")
    axes.set_title("Cost, the multiplier bounded by L")
    axes.set_xlabel("L")
    axes.legend()


def _small_entropy(axes: Axes, small: Array) -> None:
    axes.loglog(BETAS, small, "o-", color=BLUE, linewidth=2, label="learner")
    axes.loglog(BETAS, small[-1] * BETAS / BETAS[-1], **DARK, label="slope 1")
    axes.set_title("Distance from the expert as beta vanishes")
    axes.set_xlabel("beta")
    axes.legend()


def _convergence(axes: Axes, ccil: Run, cvag: Run) -> None:
    for name, run, color in (("CCIL", ccil, BLUE), ("CVAG", cvag, GREEN)):
        axes.semilogy(np.maximum(run.distance, 1e-16), color=color, linewidth=1.6, label=name)
    axes.set_title("Distance from the saddle point")
    axes.set_xlabel("round")
    axes.legend()


def _costs(axes: Axes, problem: Problem, ccil: Run, cvag: Run) -> None:
    axes.plot(ccil.cost, color=BLUE, linewidth=1.6, label="CCIL")
    axes.plot(cvag.cost, color=GREEN, linewidth=1.6, label="CVAG")
    axes.axhline(problem.process.episode_cost(problem.cheap), **DARK, label="cheap expert")
    axes.set_xlim(0, NUM_ROUNDS // 4)
    axes.set_title("Cost, the first quarter")
    axes.set_xlabel("round")
    axes.legend()


def _multipliers(axes: Axes, problem: Problem, ccil: Run, cvag: Run, settled: Solution) -> None:
    axes.plot(ccil.multiplier, color=BLUE, linewidth=1.6, label="CCIL")
    shown = np.where(np.isfinite(cvag.multiplier), cvag.multiplier, np.nan)
    axes.plot(shown, color=GREEN, linewidth=1.6, label="CVAG: (1 - a) / a of 200 rounds")
    for multiplier in (problem.bound_by_cheap.multiplier, settled.multiplier):
        axes.axhline(multiplier, **DARK)
    axes.set_ylim(0, 2.5 * max(problem.bound_by_cheap.multiplier, settled.multiplier))
    axes.set_title("Multipliers (dashed: those of saddles)")
    axes.set_xlabel("round")
    axes.legend()
