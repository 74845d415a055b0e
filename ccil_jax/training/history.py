"""Metrics of a run, iteration by iteration, as NumPy arrays: what of them is known."""

from collections.abc import Mapping

import numpy as np

EPISODE_ESTIMATES = ("episode_return", "episode_cost", "episode_length")  # metrics of whole episodes


def without_unknown(history: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The metrics [iterations, runs], with NaN for what is said of episodes before a run's first episode has ended.

    The learner's own estimates then stand at a start value, which nobody has measured. An iteration that was taken back
    ends no episode. Metrics of a method that does not act are returned as they are.
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
