"""Demonstrations of DSRL: an HDF5 file with one dataset for each quantity, all episodes one after the other.

Datasets: `observations`, `actions`, `terminals`, `timeouts`, `rewards` (optional) and `costs` (optional). An episode
ends where one of the two flags `terminals` and `timeouts` is set.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.demonstrations import columns
from ccil_jax.demonstrations.npz import ArchiveError


def arrays_of(found: Mapping[str, np.ndarray], path: Path) -> dict[str, Any]:
    """Our arrays, from the file's datasets `found`; `rewards` and `costs` are None where it has none.

    Steps after the last episode's end belong to an episode that is not complete, and are left out.

    Raises:
        ArchiveError: datasets are missing, or do not fit together.
    """
    for key in ("observations", "actions", "terminals", "timeouts"):
        if key not in found:
            raise ArchiveError(f"{path}: key '{key}' is missing; DSRL and Minari files can be read")
    obs = columns.rows(found["observations"], f"{path}: 'observations'")
    terminated, truncated = (
        columns.flags(found[key], f"{path}: '{key}'", (len(obs),)) for key in ("terminals", "timeouts")
    )
    ends = np.flatnonzero(terminated | truncated) + 1
    if len(ends) == 0:
        raise ArchiveError(f"{path}: neither 'terminals' nor 'timeouts' is ever true: no episode is complete")
    rewards, costs = (
        columns.per_step(found[key], f"{path}: '{key}'", (len(obs),)) if key in found else None
        for key in ("rewards", "costs")
    )
    arrays = {
        "obs": obs,
        "actions": columns.rows(found["actions"], f"{path}: 'actions'", len(obs)),
        "rewards": rewards,
        "costs": costs,
        "terminated": terminated,
        "truncated": truncated,
    }
    complete: dict[str, Any] = {key: None if array is None else array[: ends[-1]] for key, array in arrays.items()}
    return {**complete, "episode_ends": ends, "metadata": {"format": "dsrl"}}
