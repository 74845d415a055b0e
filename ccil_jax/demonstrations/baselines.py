"""Demonstrations of OpenAI's baselines and of CCIL: an `.npz` file with one array for each trajectory.

Keys: `obs`, `acs`, `rews` (optional), and `accucost` or `costs` (optional). An episode ends with its array. The arrays
of different lengths are stored as pickled objects, which `pickled_npz` reads without running any code in them.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.demonstrations import columns, npz, pickled_npz
from ccil_jax.demonstrations.npz import ArchiveError


def recognizes(path: Path) -> bool:
    """Whether the file is an archive with `acs` but without `episode_ends`, which only our own format has."""
    keys = npz.keys_of(path) if npz.starts_with(path, npz.SIGNATURE) else frozenset()
    return "acs" in keys and "episode_ends" not in keys


def read(path: Path) -> dict[str, Any]:
    """The arrays of the file; `rewards` and `costs` are None where it has none. Raises `ArchiveError`."""
    found = pickled_npz.read(path)
    for key, parts in found.items():
        if len(parts) != len(found["obs"]):
            raise ArchiveError(
                f"{path}: '{key}' has {len(parts)} trajectories, 'obs' has {len(found['obs'])}; they must be equal"
            )
    obs, actions = ([_flat(part, _of(path, key, i)) for i, part in enumerate(found[key])] for key in pickled_npz.KEYS)
    lengths = [len(part) for part in obs]
    rewards = _per_trajectory(found, "rews", lengths, path)
    return {
        "obs": _join(obs, "obs", path),
        "actions": _join(actions, "acs", path),
        "rewards": None if rewards is None else _join(rewards, "rews", path),
        "costs": _costs(found, lengths, path),
        **_flags_at_ends(lengths),
        "metadata": {"format": "baselines"},
    }


def _costs(found: Mapping[str, Sequence[np.ndarray]], lengths: Sequence[int], path: Path) -> np.ndarray | None:
    """The costs of all steps, from either of two keys or both, which then must agree.

    `accucost` is the running sum of an episode's costs. `costs` holds the cost of each step, or each episode's total,
    which says nothing about steps and is left aside.
    """
    given = found.get("costs", ())
    totals = all(part.ndim == 0 for part in given) or (
        all(part.size == 1 for part in given) and any(length != 1 for length in lengths)
    )
    costs = None if totals else _per_trajectory(found, "costs", lengths, path)
    sums = _per_trajectory(found, "accucost", lengths, path)
    if sums is None:
        return None if costs is None else _join(costs, "costs", path)
    with np.errstate(invalid="ignore"):  # NaN and infinity are complained of later
        steps = [np.diff(part.astype(np.float64), prepend=0.0) for part in sums]
    for i, step in enumerate(steps):
        if (step < 0).any():
            raise ArchiveError(
                f"{_of(path, 'accucost', i)} decreases (row {int(np.argmax(step < 0))}); it must be the running sum of "
                "costs"
            )
        if costs is not None and not np.allclose(np.cumsum(costs[i], dtype=np.float64), sums[i], rtol=1e-3):
            raise columns.contradiction(_of(path, "accucost", i), "costs")
    return _join(steps, "accucost", path)


def _flags_at_ends(lengths: Sequence[int]) -> dict[str, Any]:
    """Where the file does not say how episodes ended, neither flag is set."""
    unknown = np.zeros(sum(lengths), np.bool_)
    return {"terminated": unknown, "truncated": unknown, "episode_ends": np.cumsum(lengths, dtype=np.int64)}


def _of(path: Path, key: str, trajectory: int) -> str:
    return f"{path}: '{key}' of trajectory {trajectory}"


def _flat(part: np.ndarray, where: str) -> np.ndarray:
    """[T, ...] as [T, k], as these projects' own readers do it; a vector [T] becomes [T, 1]."""
    return columns.rows(part.reshape(len(part), -1) if part.ndim > 2 and part.size else part, where)


def _per_trajectory(
    found: Mapping[str, Sequence[np.ndarray]], key: str, lengths: Sequence[int], path: Path
) -> list[np.ndarray] | None:
    """One array [T] for each trajectory; None where the file has no such key."""
    if key not in found:
        return None
    parts = zip(found[key], lengths, strict=True)
    return [columns.per_step(part, _of(path, key, i), (length,)) for i, (part, length) in enumerate(parts)]


def _join(parts: Sequence[np.ndarray], key: str, path: Path) -> np.ndarray:
    return columns.joined(parts, lambda i: _of(path, key, i))
