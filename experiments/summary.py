"""A finished run in numbers (metrics of the methods' specification, section 7) and as a terminal table."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.statistics import bootstrap_interval

SCORES = (
    "episode_return",
    "episode_cost",
    "recovered_return",
    "penalized_return",
    "cost_violation",
    "relative_cost_violation",
    "cost_rate",
    "episode_length",
)
_MAX_RELATIVE_VIOLATION = 5.0  # caps the penalty: one diverged seed must not decide a mean


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reference:
    """What a run is measured against. None where it is not known (no demonstrations, no limit)."""

    expert_return: float | None  # R_E
    expert_cost: float | None  # J_E
    random_return: float  # R_0
    random_cost: float
    cost_limit: float | None  # the prescribed limit, where the method has one

    @property
    def allowed_cost(self) -> float | None:
        """The level that violations are counted from: J_E, or the prescribed limit where there is no expert."""
        return self.cost_limit if self.expert_cost is None else self.expert_cost


def scores(episode_return: float, episode_cost: float, reference: Reference) -> dict[str, float | None]:
    """The derived metrics of one seed's mean return and cost; None where the reference lacks a level."""
    violation = relative = recovered = penalized = None
    if reference.allowed_cost is not None:
        violation = max(0.0, episode_cost - reference.allowed_cost)
        relative = violation / max(reference.allowed_cost, 1.0)
    if reference.expert_return is not None and reference.expert_return != reference.random_return:
        span = reference.expert_return - reference.random_return
        recovered = 100 * (episode_return - reference.random_return) / span
        if relative is not None:
            penalized = recovered - 100 * min(relative, _MAX_RELATIVE_VIOLATION)
    return {
        "episode_return": episode_return,
        "episode_cost": episode_cost,
        "recovered_return": recovered,
        "penalized_return": penalized,
        "cost_violation": violation,
        "relative_cost_violation": relative,
    }


def per_seed_scores(evaluation: Any, cost_rate: np.ndarray | None, reference: Reference) -> list[dict[str, Any]]:
    """One dictionary per seed of an evaluation with arrays [num_seeds, num_episodes]; `cost_rate` is [num_seeds]."""
    rows = []
    for seed in range(len(evaluation.episode_return)):
        means = [float(np.mean(getattr(evaluation, name)[seed])) for name in ("episode_return", "episode_cost")]
        row: dict[str, Any] = {"seed": seed, **scores(means[0], means[1], reference)}
        row["cost_rate"] = None if cost_rate is None else float(cost_rate[seed])
        row["episode_length"] = float(np.mean(evaluation.episode_length[seed]))
        rows.append(row)
    return rows


def aggregate_scores(rows: list[dict[str, Any]]) -> dict[str, dict[str, float] | None]:
    """Over seeds: interquartile mean with its 95% bootstrap interval, mean and standard deviation of every score."""
    result: dict[str, dict[str, float] | None] = {}
    for name in SCORES:
        values = [row[name] for row in rows]
        if any(v is None or not np.isfinite(v) for v in values):
            result[name] = None
            continue
        interval = bootstrap_interval([np.array(values)])
        spread = {"mean": float(np.mean(values)), "std": float(np.std(values))}
        result[name] = {"iqm": interval.value, "low": interval.low, "high": interval.high, **spread}
    return result


def print_table(title: str, rows: list[dict[str, Any]], aggregate: Mapping[str, Any], reference: Reference) -> None:
    """Prints seeds, aggregate, expert and random policy as one table."""
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    columns = ("episode_return", "episode_cost", "recovered_return", "relative_cost_violation")
    for heading in ("", "return", "cost", "recovered %", "violation"):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for row in rows:
        table.add_row(f"seed {row['seed']}", *(number(row.get(c)) for c in columns))
    table.add_section()
    table.add_row("IQM", *(number(None if aggregate[c] is None else aggregate[c]["iqm"]) for c in columns))
    table.add_row("95% interval", *(_interval(aggregate[c]) for c in columns))
    table.add_section()
    if reference.expert_return is not None or reference.expert_cost is not None:
        table.add_row("expert", number(reference.expert_return), number(reference.expert_cost), "100", "0")
    if reference.cost_limit is not None:
        table.add_row("cost limit", "", number(reference.cost_limit), "", "")
    table.add_row("random policy", number(reference.random_return), number(reference.random_cost), "0", "")
    show(table)


def show(table: Any) -> None:
    """Prints a rich table, in a pipe or log at the width that it needs."""
    from rich.console import Console

    console = Console()
    (console if console.is_terminal else Console(width=160)).print(table)


def number(value: float | None) -> str:
    """Three or four significant digits, never in exponent form; a dash for None."""
    if value is None:
        return "-"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.1f}" if abs(value) >= 100 else f"{value:.2f}"


def _interval(entry: Mapping[str, float] | None) -> str:
    return "-" if entry is None else f"{number(entry['low'])} to {number(entry['high'])}"
