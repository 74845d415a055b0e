"""Aggregates over seeds: interquartile mean with a stratified bootstrap interval (Agarwal et al. 2021). NumPy only.

Our own sixty lines because rliable cannot be imported beside pandas 3.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np


@dataclasses.dataclass(frozen=True)
class Interval:
    """A statistic and the percentile interval of its bootstrap distribution."""

    value: float
    low: float
    high: float


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of what is left after dropping floor(n / 4) values at each end of the sorted `values [n]`, n >= 1."""
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
    """`statistic` of all values and its percentile interval; values are resampled within each stratum (task).

    `strata` is one array of values (one per seed) per task. The seed is fixed, so a report can be made again.
    Raises `ValueError` for an empty stratum or a value that is not finite.
    """
    arrays = [np.asarray(stratum, np.float64).ravel() for stratum in strata]
    if not arrays or any(a.size == 0 for a in arrays):
        raise ValueError("every stratum needs at least one value")
    if not all(np.isfinite(a).all() for a in arrays):
        raise ValueError("values must be finite")
    random = np.random.default_rng(seed)
    draws = [a[random.integers(0, a.size, (num_resamples, a.size))] for a in arrays]
    resampled = np.concatenate(draws, axis=1)
    estimates = np.array([statistic(row) for row in resampled])
    tail = 100 * (1 - confidence) / 2
    low, high = np.percentile(estimates, [tail, 100 - tail])
    return Interval(statistic(np.concatenate(arrays)), float(low), float(high))
