"""Demonstrations of DSRL: an HDF5 file with one dataset for each quantity, all episodes one after the other.

Datasets: `observations`, `actions`, `terminals`, `timeouts`, `next_observations` (optional), `rewards` (optional) and
`costs` (optional). An episode ends where one of the two flags `terminals` and `timeouts` is set.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.demonstrations import columns, npz
from ccil_jax.demonstrations.npz import ArchiveError
from ccil_jax.errors import DemonstrationsError

SUFFIXES = (".hdf5", ".h5")  # of the files that are written
_LONGEST_ATTRIBUTE = 60_000  # bytes; HDF5 keeps an attribute in a header of 64 KiB


def arrays_of(found: Mapping[str, np.ndarray], path: Path) -> dict[str, Any]:
    """Our arrays, from the file's datasets `found`; those that it lacks are None.

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
    following = found.get("next_observations")
    if following is not None:
        following = columns.rows(following, f"{path}: 'next_observations'", len(obs))[ends - 1]
    arrays = {
        "obs": obs,
        "actions": columns.rows(found["actions"], f"{path}: 'actions'", len(obs)),
        "rewards": rewards,
        "costs": costs,
        "terminated": terminated,
        "truncated": truncated,
    }
    complete: dict[str, Any] = {key: None if array is None else array[: ends[-1]] for key, array in arrays.items()}
    return {**complete, "episode_ends": ends, "final_obs": following, "metadata": {"format": "dsrl"}}


def write(path: Path, arrays: Mapping[str, Any], metadata: Mapping[str, Any]) -> None:
    """Writes an HDF5 file with all datasets of DSRL, whole or not at all; an existing file is replaced.

    Args:
        path: of the file.
        arrays: those of `Demonstrations`, checked, none missing.
        metadata: a JSON object, which becomes the file's attribute `metadata`, as text.

    Raises:
        DemonstrationsError: DSRL's datasets cannot say what the demonstrations say.
        OSError: the disk is full or cannot be written to.
    """
    import h5py

    last = arrays["episode_ends"] - 1
    unmarked = np.flatnonzero(~(arrays["terminated"] | arrays["truncated"])[last])
    if len(unmarked):
        raise DemonstrationsError(
            f"{path}: trajectory {unmarked[0]} neither terminates nor is truncated at its end, and DSRL marks the end "
            "of an episode by these flags alone; write .npz or a Minari dataset"
        )
    text = json.dumps(metadata, sort_keys=True)
    if len(text) > _LONGEST_ATTRIBUTE:
        raise DemonstrationsError(f"{path}: the metadata are longer than {_LONGEST_ATTRIBUTE} characters; shorten them")
    following = np.concatenate([arrays["obs"][1:], arrays["obs"][:1]])
    following[last] = arrays["final_obs"]
    datasets = {
        "observations": arrays["obs"],
        "next_observations": following,
        "actions": arrays["actions"],
        "rewards": arrays["rewards"],
        "costs": arrays["costs"],
        "terminals": arrays["terminated"],
        "timeouts": arrays["truncated"],
    }
    with npz.whole(path) as temporary, h5py.File(temporary, "w") as file:
        for name, array in datasets.items():
            file.create_dataset(name, data=array, compression="gzip")
        file.attrs["metadata"] = text
