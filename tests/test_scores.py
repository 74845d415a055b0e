"""Metrics and their aggregates over seeds, against values worked out by hand."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from ccil_jax.demonstrations.trajectories import Demonstrations
from experiments.runs import summary
from experiments.runs.intervals import Interval, bootstrap_interval, interquartile_mean, known_deviation, known_mean
from experiments.runs.summary import Reference, aggregate_scores, per_seed_scores, scores

REFERENCE = Reference(expert_return=110.0, expert_cost=40.0, random_return=10.0, random_cost=3.0, cost_limit=None)
WITH_ERROR = dataclasses.replace(REFERENCE, expert_return_standard_error=6.5, expert_cost_standard_error=2.5)


@dataclasses.dataclass
class Episodes:
    """Stands in for `ccil_jax.acting.evaluation.Evaluation`."""

    episode_return: np.ndarray
    episode_cost: np.ndarray
    episode_length: np.ndarray


@pytest.mark.parametrize(
    ("values", "expected"),
    [([7], 7), ([0, 10, 20], 10), ([100, 3, 2, 1, 0], 2), ([8, 1, 7, 2, 6, 3, 5, 4], 4.5), ([4, 1, 2, 3], 2.5)],
)
def test_interquartile_mean_drops_a_quarter_at_each_end(values: list[float], expected: float) -> None:
    assert interquartile_mean(np.array(values)) == expected


def test_bootstrap_interval_of_known_distributions() -> None:
    constant = bootstrap_interval([np.full(5, 3.0)])
    assert (constant.value, constant.low, constant.high) == (3.0, 3.0, 3.0)
    # Three values: a resample's mean is 0, 1, 2 or 3 with probability 8/27, 12/27, 6/27, 1/27.
    coin = [np.array([0.0, 0.0, 3.0])]
    wide = bootstrap_interval(coin, np.mean)
    assert (wide.value, wide.low, wide.high) == (1.0, 0.0, 3.0)
    narrow = bootstrap_interval(coin, np.mean, confidence=0.2)
    assert (narrow.low, narrow.high) == (1.0, 1.0)


@pytest.mark.parametrize("strata", [[[5.0]], [[4.0, 6.0]], [[4.0, 5.0, 6.0], [5.0, 5.0]]])
def test_one_or_two_seeds_have_no_interval(strata: list[list[float]]) -> None:
    interval = bootstrap_interval([np.array(values) for values in strata])
    assert interval == Interval(5.0, None, None)


def test_bootstrap_interval_resamples_within_strata() -> None:
    stratified = bootstrap_interval([np.zeros(3), np.ones(3)])
    assert (stratified.low, stratified.high) == (0.5, 0.5)
    pooled = bootstrap_interval([np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])])
    assert pooled.low is not None and pooled.high is not None
    assert pooled.low < 0.5 < pooled.high


def test_bootstrap_interval_covers_the_mean_of_a_normal_sample() -> None:
    sample = np.random.default_rng(1).normal(5.0, 2.0, 400)
    interval = bootstrap_interval([sample], np.mean)
    half = 1.96 * sample.std() / 20
    np.testing.assert_allclose([interval.low, interval.high], [sample.mean() - half, sample.mean() + half], atol=0.03)
    assert bootstrap_interval([sample]) == bootstrap_interval([sample])


@pytest.mark.parametrize("strata", [[], [np.array([])], [np.array([1.0, np.nan])]])
def test_bootstrap_interval_refuses_what_has_none(strata: list[np.ndarray]) -> None:
    with pytest.raises(ValueError, match="value"):
        bootstrap_interval(strata)


def test_scores_are_those_of_the_specification() -> None:
    row = scores(60.0, 50.0, REFERENCE)
    assert row["recovered_return"] == 50.0  # (60 - 10) / (110 - 10)
    assert row["cost_violation"] == 10.0
    assert row["relative_cost_violation"] == 0.25
    assert row["penalized_return"] == 25.0
    assert scores(110.0, 30.0, REFERENCE)["penalized_return"] == 100.0  # no credit for staying below
    assert scores(110.0, 4000.0, REFERENCE)["penalized_return"] == -400.0  # relative violation capped at 5
    free = dataclasses.replace(REFERENCE, expert_cost=0.25)
    assert scores(0.0, 1.0, free)["relative_cost_violation"] == 0.75  # divided by at least 1


def test_scores_without_an_expert_use_the_prescribed_limit() -> None:
    reference = Reference(expert_return=None, expert_cost=None, random_return=0.0, random_cost=0.0, cost_limit=20.0)
    row = scores(60.0, 30.0, reference)
    assert row["cost_violation"] == 10.0
    assert row["recovered_return"] is None
    assert row["penalized_return"] is None


def test_seeds_are_aggregated_by_interquartile_mean() -> None:
    returns = np.array([[0.0, 20.0], [20.0, 20.0], [30.0, 30.0], [1000.0, 1000.0]])
    rows = per_seed_scores(Episodes(returns, 0 * returns, 0 * returns + 7), np.array([0.1, 0.2, 0.3, 0.4]), REFERENCE)
    assert [row["episode_return"] for row in rows] == [10.0, 20.0, 30.0, 1000.0]
    aggregate = aggregate_scores(rows)
    assert aggregate["episode_return"] is not None
    assert aggregate["episode_return"]["iqm"] == 25.0
    assert aggregate["episode_return"]["mean"] == 265.0
    assert aggregate["episode_length"] == {"iqm": 7.0, "low": 7.0, "high": 7.0, "mean": 7.0, "std": 0.0}
    rows[0]["recovered_return"] = None
    assert aggregate_scores(rows)["recovered_return"] is None


def test_what_is_unknown_has_no_part_in_a_mean() -> None:
    nan = np.nan
    values = np.array([[1.0, 3.0, 8.0], [nan, 2.0, 4.0], [nan, nan, 7.0], [nan, nan, nan]])
    np.testing.assert_array_equal(known_mean(values, axis=1), [4.0, 3.0, 7.0, nan])
    np.testing.assert_allclose(known_deviation(values, axis=1), [np.sqrt(26 / 3), 1.0, nan, nan])
    assert np.isnan(known_mean(np.array([nan, nan]), axis=0))
    assert known_mean(np.array([nan, 5.0]), axis=0) == 5.0


def test_intervals_and_deviations_of_few_seeds_are_null() -> None:
    returns = np.array([[10.0, 20.0], [30.0, 40.0]])
    rows = per_seed_scores(Episodes(returns, returns, returns), None, REFERENCE)
    entry: Any = aggregate_scores(rows)["episode_return"]
    error = entry.pop("standard_error")
    assert error == pytest.approx(math.sqrt(5.0**2 + 5.0**2) / 2)  # each seed's is sqrt(50) / sqrt(2)
    assert entry == {"iqm": 25.0, "low": None, "high": None, "mean": 25.0, "std": 10.0}
    entry = aggregate_scores(rows[:1])["episode_return"]
    assert entry == {"iqm": 15.0, "low": None, "high": None, "mean": 15.0, "std": None, "standard_error": 5.0}


def demonstrations(costs: list[float], rewards: list[float] | None) -> Demonstrations:
    """Episodes of one step."""
    n = len(costs)
    return Demonstrations(
        obs=np.zeros((n, 1), np.float32),
        actions=np.zeros((n, 1), np.float32),
        rewards=None if rewards is None else np.array(rewards, np.float32),
        costs=np.array(costs, np.float32),
        terminated=np.ones(n, bool),
        truncated=np.zeros(n, bool),
        episode_ends=np.arange(1, n + 1),
    )


def test_levels_of_the_demonstrations_have_standard_errors() -> None:
    assert summary.expert_levels(demonstrations([1.0, 3.0, 5.0, 7.0], [2.0, 2.0, 2.0, 6.0])) == {
        "expert_return": 3.0,
        "expert_cost": 4.0,
        "expert_return_standard_error": 1.0,  # deviation 2, of 4
        "expert_cost_standard_error": pytest.approx(np.sqrt(20 / 3) / 2),
    }
    single = summary.expert_levels(demonstrations([1.0], None))
    assert list(single.values()) == [None, 1.0, None, None]
    assert set(summary.expert_levels(None).values()) == {None}


def test_every_evaluated_mean_has_its_standard_error() -> None:
    costs = np.array([[1.0, 3.0, 5.0, 7.0]])
    (row,) = per_seed_scores(Episodes(2 * costs, costs, costs), None, REFERENCE)
    assert row["episode_cost_standard_error"] == pytest.approx(np.sqrt(20 / 3) / 2)
    assert row["episode_return_standard_error"] == pytest.approx(np.sqrt(20 / 3))
    (row,) = per_seed_scores(Episodes(costs[:, :1], costs[:, :1], costs[:, :1]), None, REFERENCE)
    assert row["episode_cost_standard_error"] is row["episode_return_standard_error"] is None
    old = {"expert_return": 9.0, "expert_cost": 4.0}  # a config.json of an earlier version
    reference = summary.make_reference(old, Episodes(2 * costs, costs, costs), cost_limit=None)
    assert (reference.random_return, reference.random_cost, reference.expert_cost) == (8.0, 4.0, 4.0)
    assert reference.random_return_standard_error == pytest.approx(np.sqrt(20 / 3))
    assert reference.random_cost_standard_error == pytest.approx(np.sqrt(20 / 3) / 2)
    assert reference.expert_cost_standard_error is None


def test_a_violation_is_marked_beyond_the_demonstrations_error() -> None:
    assert scores(60.0, 42.5, WITH_ERROR)["violation_beyond_error"] is False
    assert scores(60.0, 42.6, WITH_ERROR)["violation_beyond_error"] is True
    assert scores(60.0, 42.5, WITH_ERROR)["cost_violation"] == 2.5  # a violation, but not marked
    assert scores(60.0, 99.0, REFERENCE)["violation_beyond_error"] is None  # a single demonstration
    prescribed = dataclasses.replace(WITH_ERROR, cost_limit=20.0)
    assert scores(60.0, 99.0, prescribed)["violation_beyond_error"] is None
    alone = Reference(expert_return=None, expert_cost=None, random_return=0.0, random_cost=0.0, cost_limit=20.0)
    assert scores(60.0, 99.0, alone)["violation_beyond_error"] is None
    rows = [scores(60.0, cost, WITH_ERROR) for cost in (30.0, 40.0, 60.0)]
    assert summary.mean_violation_beyond_error(rows, WITH_ERROR) is True  # 43.3, though only one seed is marked


def lines_of(printed: str) -> dict[str, list[str]]:
    """The cells of a printed table by the first cell of their line."""
    split = [[cell.strip() for cell in line.split("│")[1:-1]] for line in printed.splitlines() if "│" in line]
    return {cells[0]: cells[1:] for cells in split}


def test_the_table_shows_errors_marks_and_no_interval_of_two_seeds(capsys: pytest.CaptureFixture[str]) -> None:
    costs = np.array([[40.0, 42.0], [50.0, 54.0]])
    rows = per_seed_scores(Episodes(0 * costs + 60.0, costs, costs), None, WITH_ERROR)
    summary.print_table("[red]a_b :smile:[/red]", rows, aggregate_scores(rows), WITH_ERROR)
    printed = capsys.readouterr().out
    assert printed.startswith("[red]a_b :smile:[/red]")
    lines = lines_of(printed)
    assert lines["seed 0"] == ["60.00 +- 0.00", "41.00 +- 1.00", "50.00", "0.03"]
    assert lines["seed 1"] == ["60.00 +- 0.00", "52.00 +- 2.00", "50.00", "0.30 *"]
    assert lines["mean"] == ["60.00 +- 0.00", "46.50 +- 1.12", "50.00", "0.16 *"]  # sqrt(1 + 4) / 2
    assert lines["95% interval"] == ["-", "-", "-", "-"]
    assert lines["expert"] == ["110.0 +- 6.50", "40.00 +- 2.50", "100", "0"]
    assert lines["random policy"] == ["10.00 +- -", "3.00 +- -", "0", ""]
    assert "*: beyond the demonstrations' error" in printed
    assert "no interval below 3 seeds" in printed
    three = [rows[0]] * 3
    summary.print_table("t", three, aggregate_scores(three), WITH_ERROR)
    printed = capsys.readouterr().out
    assert lines_of(printed)["95% interval"][1] == "41.00 to 41.00"
    assert "beyond" not in printed and "no interval" not in printed
    alone = Reference(expert_return=None, expert_cost=None, random_return=1.0, random_cost=2.0, cost_limit=20.0)
    rows = per_seed_scores(Episodes(costs, costs, costs), None, alone)
    summary.print_table("t", rows, aggregate_scores(rows), alone)
    lines = lines_of(capsys.readouterr().out)
    assert "expert" not in lines
    assert lines["random policy"] == ["1.00 +- -", "2.00 +- -", "-", ""]  # without an expert there is no scale
    assert lines["cost limit"] == ["", "20.00", "", ""]
    assert lines["seed 1"][2:] == ["-", "1.60"]
