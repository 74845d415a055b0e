"""Metrics and their aggregates over seeds, against values worked out by hand."""

import dataclasses

import numpy as np
import pytest

from experiments.statistics import bootstrap_interval, interquartile_mean
from experiments.summary import Reference, aggregate_scores, per_seed_scores, scores

REFERENCE = Reference(expert_return=110.0, expert_cost=40.0, random_return=10.0, random_cost=3.0, cost_limit=None)


@dataclasses.dataclass
class Episodes:
    """Stands in for `ccil_jax.evaluation.Evaluation`."""

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
    # Two values: a resample's mean is 0, 1/2 or 1 with probability 1/4, 1/2, 1/4.
    coin = [np.array([0.0, 1.0])]
    wide = bootstrap_interval(coin, np.mean)
    assert (wide.value, wide.low, wide.high) == (0.5, 0.0, 1.0)
    narrow = bootstrap_interval(coin, np.mean, confidence=0.4)
    assert (narrow.low, narrow.high) == (0.5, 0.5)


def test_bootstrap_interval_resamples_within_strata() -> None:
    stratified = bootstrap_interval([np.zeros(2), np.ones(2)])
    assert (stratified.low, stratified.high) == (0.5, 0.5)
    pooled = bootstrap_interval([np.array([0.0, 0.0, 1.0, 1.0])])
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
