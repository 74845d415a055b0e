"""The scores of a finished run, and their table in the terminal. docs/metrics.md says what the numbers mean."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from ccil_jax.demonstrations.trajectories import Demonstrations, standard_error
from experiments.cli.tables import BEYOND_ERROR, marked, number, show, with_error
from experiments.runs.intervals import MIN_SEEDS, bootstrap_interval

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
NO_INTERVAL = f"no interval below {MIN_SEEDS} seeds"
_MAX_RELATIVE_VIOLATION = 5.0  # caps the penalty, so that a single diverged seed does not decide the mean


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reference:
    """The levels that a run is compared with. None: not known (no demonstrations, no limit, or a single episode)."""

    expert_return: float | None  # R_E
    expert_cost: float | None  # J_E
    random_return: float  # R_0
    random_cost: float
    cost_limit: float | None  # the prescribed limit, where the method has one
    expert_return_standard_error: float | None = None
    expert_cost_standard_error: float | None = None
    random_return_standard_error: float | None = None
    random_cost_standard_error: float | None = None

    @property
    def allowed_cost(self) -> float | None:
        """The cost above which there is a violation: J_E, or the prescribed limit where there is no expert."""
        return self.cost_limit if self.expert_cost is None else self.expert_cost

    def recovered_return(self, episode_return: float) -> float | None:
        """100 (R - R_0) / (R_E - R_0), in per cent, for a return R; None where R_E is unknown or equals R_0."""
        if self.expert_return is None or self.expert_return == self.random_return:
            return None
        return 100 * (episode_return - self.random_return) / (self.expert_return - self.random_return)

    def violation_beyond_error(self, episode_cost: float) -> bool | None:
        """Whether a mean cost exceeds J_E by more than the standard error of J_E; None where there is no such error."""
        if self.cost_limit is not None or self.expert_cost is None or self.expert_cost_standard_error is None:
            return None
        return bool(episode_cost > self.expert_cost + self.expert_cost_standard_error)


def expert_levels(demonstrations: Demonstrations | None) -> dict[str, float | None]:
    """R_E, J_E and their standard errors, under their names in `Reference`, config.json and summary.json."""
    return {
        "expert_return": demonstrations.mean_episode_return if demonstrations else None,
        "expert_cost": demonstrations.mean_episode_cost if demonstrations else None,
        "expert_return_standard_error": demonstrations.return_standard_error if demonstrations else None,
        "expert_cost_standard_error": demonstrations.cost_standard_error if demonstrations else None,
    }


def levels_of(facts: Mapping[str, Any]) -> dict[str, float | None]:
    """As `expert_levels`, from a config.json or the metadata of policies; earlier versions wrote no standard errors."""
    return {name: facts.get(name) for name in expert_levels(None)}


def make_reference(levels: Mapping[str, float | None], random: Any, cost_limit: float | None) -> Reference:
    """The levels that a run is compared with.

    Args:
        levels: from `expert_levels` or `levels_of`.
        random: evaluation of the random policy, with arrays [1, num_episodes].
        cost_limit: the prescribed limit, where the method has one.
    """
    return Reference(
        **levels,
        random_return=float(np.mean(random.episode_return)),
        random_cost=float(np.mean(random.episode_cost)),
        random_return_standard_error=standard_error(random.episode_return[0]),
        random_cost_standard_error=standard_error(random.episode_cost[0]),
        cost_limit=cost_limit,
    )


def scores(episode_return: float, episode_cost: float, reference: Reference) -> dict[str, float | bool | None]:
    """The scores of one seed, from its mean return and cost; None where a level that a score needs is unknown."""
    violation = relative = penalized = None
    recovered = reference.recovered_return(episode_return)
    if reference.allowed_cost is not None:
        violation = max(0.0, episode_cost - reference.allowed_cost)
        relative = violation / max(reference.allowed_cost, 1.0)
    if recovered is not None and relative is not None:
        penalized = recovered - 100 * min(relative, _MAX_RELATIVE_VIOLATION)
    return {
        "episode_return": episode_return,
        "episode_cost": episode_cost,
        "recovered_return": recovered,
        "penalized_return": penalized,
        "cost_violation": violation,
        "relative_cost_violation": relative,
        "violation_beyond_error": reference.violation_beyond_error(episode_cost),
    }


def per_seed_scores(evaluation: Any, cost_rate: np.ndarray | None, reference: Reference) -> list[dict[str, Any]]:
    """One dictionary per seed of an evaluation with arrays [num_seeds, num_episodes]; `cost_rate` is [num_seeds]."""
    rows = []
    for seed in range(len(evaluation.episode_return)):
        returns, costs = evaluation.episode_return[seed], evaluation.episode_cost[seed]
        row: dict[str, Any] = {"seed": seed, **scores(float(np.mean(returns)), float(np.mean(costs)), reference)}
        row["episode_return_standard_error"] = standard_error(returns)
        row["episode_cost_standard_error"] = standard_error(costs)
        row["cost_rate"] = None if cost_rate is None else float(cost_rate[seed])
        row["episode_length"] = float(np.mean(evaluation.episode_length[seed]))
        rows.append(row)
    return rows


def aggregate_scores(rows: list[dict[str, Any]]) -> dict[str, dict[str, float | None] | None]:
    """Over seeds: interquartile mean with its 95% bootstrap interval, mean and standard deviation of every score.

    None in place of a score that a seed lacks, and of an interval or deviation for which there are too few seeds.
    """
    result: dict[str, dict[str, float | None] | None] = {}
    for name in SCORES:
        values = [row[name] for row in rows]
        if any(v is None or not np.isfinite(v) for v in values):
            result[name] = None
            continue
        interval = bootstrap_interval([np.array(values)])
        spread = {"mean": float(np.mean(values)), "std": float(np.std(values)) if len(values) > 1 else None}
        if (error := f"{name}_standard_error") in rows[0]:
            spread["standard_error"] = _of_mean([row[error] for row in rows])
        result[name] = {"iqm": interval.value, "low": interval.low, "high": interval.high, **spread}
    return result


def _of_mean(errors: list[float | None]) -> float | None:
    """The standard error of the mean over seeds, sqrt(sum e_s^2) / S, from those of the seeds; None if one is unknown.

    The episodes of different seeds are independent.
    """
    known = [error for error in errors if error is not None]
    return float(np.sqrt(np.sum(np.square(known)))) / len(known) if len(known) == len(errors) else None


def mean_violation_beyond_error(rows: list[dict[str, Any]], reference: Reference) -> bool | None:
    """Whether the mean cost over seeds is a violation beyond the error of the demonstrations."""
    return reference.violation_beyond_error(float(np.mean([row["episode_cost"] for row in rows])))


def print_table(title: str, rows: list[dict[str, Any]], aggregate: Mapping[str, Any], reference: Reference) -> None:
    """Prints a table of the seeds, their aggregate, the expert and the random policy.

    Means over episodes have their standard errors beside them.
    """
    from rich.table import Table

    # Cells without the usual blank on their left let the table fit a terminal of 80 columns.
    table = Table(title=title, title_justify="left", caption_justify="left", padding=(0, 1, 0, 0))
    columns = ("episode_return", "episode_cost", "recovered_return", "relative_cost_violation")
    for heading in ("", "return", "cost", "recovered %", "rel. violation"):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for row in rows:
        means = (with_error(row[name], row.get(f"{name}_standard_error")) for name in columns[:2])
        violation = marked(number(row[columns[3]]), row.get("violation_beyond_error"))
        table.add_row(f"seed {row['seed']}", *means, number(row[columns[2]]), violation)
    table.add_section()
    mean_is_beyond = mean_violation_beyond_error(rows, reference)
    iqm, mean = ([number(aggregate[c] and aggregate[c][key]) for c in columns] for key in ("iqm", "mean"))
    mean[:2] = (
        with_error(*(aggregate[c] and aggregate[c].get(key) for key in ("mean", "standard_error"))) for c in columns[:2]
    )
    table.add_row("IQM", *iqm)
    table.add_row("95% interval", *(_interval(aggregate[c]) for c in columns))
    table.add_row("mean", *mean[:3], marked(mean[3], mean_is_beyond))
    table.add_section()
    levels = dataclasses.asdict(reference)
    has_scale = reference.recovered_return(reference.random_return) is not None
    for name, text, recovered, violation in (("expert", "expert", "100", "0"), ("random", "random policy", "0", "")):
        pairs = [(levels[key], levels[f"{key}_standard_error"]) for key in (f"{name}_return", f"{name}_cost")]
        if any(mean is not None for mean, _ in pairs):
            table.add_row(text, *(with_error(*pair) for pair in pairs), recovered if has_scale else "-", violation)
    if reference.cost_limit is not None:
        table.add_row("cost limit", "", number(reference.cost_limit), "", "")
    is_marked = mean_is_beyond or any(row.get("violation_beyond_error") for row in rows)
    notes = ["+-: standard error over episodes", f"*: {BEYOND_ERROR}" if is_marked else ""]
    table.caption = "; ".join(filter(None, [*notes, f"-: {NO_INTERVAL}" if len(rows) < MIN_SEEDS else ""]))
    show(table)


def _interval(entry: Mapping[str, float | None] | None) -> str:
    return "-" if entry is None or entry["low"] is None else f"{number(entry['low'])} to {number(entry['high'])}"
