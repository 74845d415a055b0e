"""Aggregates over seeds: interquartile mean with a stratified bootstrap interval (Agarwal et al. 2021). NumPy only.

These lines are our own because rliable does not work with pandas 3. docs/metrics.md says what the numbers mean.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

MIN_SEEDS = 3  # of an interval: resamples of one or two values say almost nothing about further seeds


@dataclasses.dataclass(frozen=True)
class Interval:
    """A statistic and the percentile interval of its bootstrap distribution; None where there are too few values."""

    value: float
    low: float | None
    high: float | None


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of the sorted `values [n]`, n >= 1, without the floor(n / 4) smallest and the floor(n / 4) largest."""
    ordered = np.sort(np.asarray(values, np.float64), axis=None)
    cut = len(ordered) // 4
    return float(np.mean(ordered[cut : len(ordered) - cut]))


def bootstrap_interval(
    strata: Sequence[np.ndarray],
    statistic: Callable[[np.ndarray], float] = interquartile_mean,
    *,
    confidence: float = 0.95,
    num_resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """A statistic of all values and its percentile bootstrap interval.

    Args:
        strata: an array of values (one per seed) for each task. Values are resampled within each of these strata.
        statistic: of an array [n].
        confidence: of the interval.
        num_resamples: of the bootstrap.
        seed: of the resampling, so that the same values have the same interval.

    Returns:
        The value and its interval; without an interval if a stratum has fewer than `MIN_SEEDS` values.

    Raises:
        ValueError: a stratum is empty, or a value is not finite.
    """
    arrays = [np.asarray(stratum, np.float64).ravel() for stratum in strata]
    if not arrays or any(a.size == 0 for a in arrays):
        raise ValueError("every stratum needs at least one value")
    if not all(np.isfinite(a).all() for a in arrays):
        raise ValueError("values must be finite")
    value = statistic(np.concatenate(arrays))
    if min(a.size for a in arrays) < MIN_SEEDS:
        return Interval(value, None, None)
    random = np.random.default_rng(seed)
    draws = [a[random.integers(0, a.size, (num_resamples, a.size))] for a in arrays]
    resampled = np.concatenate(draws, axis=1)
    estimates = np.array([statistic(row) for row in resampled])
    tail = 100 * (1 - confidence) / 2
    low, high = np.percentile(estimates, [tail, 100 - tail])
    return Interval(value, float(low), float(high))


def known_mean(values: np.ndarray, axis: int) -> np.ndarray:
    """Mean over an axis of the values that are known (not NaN); NaN where none is."""
    return np.asarray(np.ma.filled(_known(values).mean(axis=axis), np.nan))


def known_deviation(values: np.ndarray, axis: int) -> np.ndarray:
    """Standard deviation over an axis of the values that are known (not NaN); NaN where fewer than two are."""
    deviation = np.ma.filled(_known(values).std(axis=axis), np.nan)
    return np.where((~np.isnan(values)).sum(axis=axis) > 1, deviation, np.nan)


def _known(values: np.ndarray) -> np.ma.MaskedArray[Any, Any]:
    return np.ma.masked_array(values, np.isnan(values))
