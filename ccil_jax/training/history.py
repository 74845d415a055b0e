"""Metrics of a training as NumPy arrays, one row for each iteration, and which of them are known."""

from collections.abc import Mapping

import numpy as np

EPISODE_ESTIMATES = ("episode_return", "episode_cost", "episode_length")  # metrics of whole, finished episodes


def without_unknown(history: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The metrics with NaN for the estimates of episodes until a run's first whole episode has ended.

    Before that, an estimate of the learner is only its initial value, which was not measured. Episodes of an iteration
    that was taken back do not count. Metrics of a method that does not act are returned as they are.

    Args:
        history: metrics [iterations, num_runs], by name.
    """
    if "episodes_finished" not in history:
        return dict(history)
    finished = history["episodes_finished"]
    if "skipped_updates" in history:
        finished = np.where(np.diff(history["skipped_updates"], axis=0, prepend=0) > 0, 0, finished)
    known = np.cumsum(finished, axis=0) > 0
    return {
        name: np.where(known, values, np.nan) if name in EPISODE_ESTIMATES else values
        for name, values in history.items()
    }
