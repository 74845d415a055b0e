"""Demonstrations of Minari: a folder with `data/main_data.hdf5`, in which each episode is a group `episode_N`.

Datasets of a group: `observations` (one row more than there are steps), `actions`, `terminations`, `truncations`,
`rewards` (optional), and the costs in `infos/cost`, `infos/costs` or `costs` (optional).
"""

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.demonstrations import columns, hdf5, hdf5_child, npz
from ccil_jax.demonstrations.npz import ArchiveError

_DATA = Path("data") / "main_data.hdf5"


def recognizes(path: Path) -> bool:
    """Whether it is a folder that holds a dataset of Minari in HDF5."""
    return path.is_dir() and (path / _DATA).exists()


def read(path: Path) -> dict[str, Any]:
    """The arrays of a dataset; `rewards` and `costs` are None where it has none. Raises `ArchiveError`."""
    for part in (path / "data", path / _DATA, path / "data" / "metadata.json"):
        if part.is_symlink():
            raise ArchiveError(f"{part}: a link, refused because it can lead to another file; copy the data in")
    if not (path / _DATA).is_file():
        raise ArchiveError(f"{path / _DATA}: not a file; copy the dataset again")
    facts = _facts(path / "data" / "metadata.json")
    arrays = arrays_of(hdf5.read(path / _DATA), path)
    return {**arrays, "metadata": {**arrays["metadata"], **facts}}


def _facts(path: Path) -> dict[str, str]:
    """Name and version of the dataset, and the `environment` that it was recorded in, where the folder has them."""
    if not path.exists():
        return {}
    try:
        if not path.is_file() or path.stat().st_size > npz.MAX_METADATA_BYTES:
            raise ValueError("not a small file")
        facts = json.loads(path.read_text(encoding="utf-8-sig"))
        if not isinstance(facts, dict):
            raise TypeError("not an object")
        named = {key: facts[key] for key in ("dataset_id", "minari_version") if key in facts}
        return {key: str(value)[:200] for key, value in (named | _environment(facts.get("env_spec"))).items()}
    except (OSError, ValueError, TypeError, RecursionError):
        raise ArchiveError(
            f"{path}: not a JSON object of at most {npz.MAX_METADATA_BYTES} bytes; copy it again"
        ) from None


def _environment(spec: Any) -> dict[str, Any]:
    """The name of the environment in gymnasium's description of it, a JSON text; nothing where there is none."""
    try:
        return {"environment": json.loads(spec)["id"]}
    except (ValueError, TypeError, LookupError, RecursionError):
        return {}


def holds_episodes(found: Mapping[str, np.ndarray]) -> bool:
    """Whether an HDF5 file with these datasets has groups of episodes, as Minari's files have."""
    return any(name.startswith("episode_") for name in found)


def arrays_of(found: Mapping[str, np.ndarray], path: Path) -> dict[str, Any]:
    """Our arrays, from the HDF5 file's datasets `found`; `rewards` and `costs` are None where no episode has any.

    Raises:
        ArchiveError: datasets are missing, or do not fit together.
    """
    names = sorted({name.partition("/")[0] for name in found if "/" in name}, key=lambda name: (len(name), name))
    episodes = [_episode(found, name, path) for name in names]
    if not episodes:
        raise ArchiveError(f"{path}: holds no episode; copy the dataset again")

    def joined(key: str) -> np.ndarray | None:
        parts = [episode[key] for episode in episodes]
        without = [name for name, part in zip(names, parts, strict=True) if part is None]
        if 0 < len(without) < len(names):
            raise ArchiveError(f"{path}: '{without[0]}' has no {key}, other episodes have; record it again")
        return None if without else columns.joined(parts, lambda i: f"{path}: '{key}' of trajectory {i}")

    keys = ("obs", "actions", "rewards", "costs", "terminated", "truncated", "final_obs")
    ends = np.cumsum([len(episode["actions"]) for episode in episodes])
    return {**{key: joined(key) for key in keys}, "episode_ends": ends, "metadata": {"format": "minari"}}


def _episode(found: Mapping[str, np.ndarray], name: str, path: Path) -> dict[str, Any]:
    """One episode of T steps. Observations have T + 1 rows, with that of the reset; so may infos."""

    def where(key: str) -> str:
        return f"{path}: '{name}/{key}'"

    for key in ("observations", "actions", "terminations", "truncations"):
        if f"{name}/{key}" not in found:
            raise ArchiveError(f"{where(key)} is missing; only plain arrays of steps can be used")
    actions = columns.rows(found[f"{name}/actions"], where("actions"))
    length = len(actions)
    if length == 0:
        raise ArchiveError(f"{where('actions')} has no rows: an episode without steps; remove that episode")
    obs = columns.rows(found[f"{name}/observations"], where("observations"), length + 1)
    rewards = found.get(f"{name}/rewards")
    return {
        "obs": obs[:-1],
        "final_obs": obs[-1:],
        "actions": actions,
        "rewards": None if rewards is None else columns.per_step(rewards, where("rewards"), (length,)),
        "costs": _episode_costs(found, name, length, path),
        "terminated": columns.flags(found[f"{name}/terminations"], where("terminations"), (length,)),
        "truncated": columns.flags(found[f"{name}/truncations"], where("truncations"), (length,)),
    }


def _episode_costs(found: Mapping[str, np.ndarray], name: str, length: int, path: Path) -> np.ndarray | None:
    """The costs of an episode's steps, without that of the reset. Several arrays may hold them, if they agree.

    An array with several numbers for each step, such as the terms of a cost, is left aside where there is another with
    one number for each step.
    """
    present = {f"{name}/{key}": found[f"{name}/{key}"] for key in hdf5_child.COST_KEYS if f"{name}/{key}" in found}
    single = {key: array for key, array in present.items() if array.ndim and array.size == len(array)}
    costs = {
        key: columns.per_step(array, f"{path}: '{key}'", (length, length + 1))
        for key, array in (single or present).items()
    }
    steps = {key: column[len(column) - length :] for key, column in costs.items()}
    for (first, ours), (second, theirs) in itertools.pairwise(steps.items()):
        if not np.array_equal(ours, theirs):
            raise columns.contradiction(f"{path}: '{first}'", second)
    return next(iter(steps.values()), None)
