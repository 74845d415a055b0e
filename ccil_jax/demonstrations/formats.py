"""Demonstrations in other people's formats, recognised by content and turned into the arrays of our own.

| Format | Content | An episode ends |
|---|---|---|
| baselines, CCIL | `.npz` with `obs, acs`, `rews`, and `accucost` or per-step `costs` | with its array |
| DSRL | HDF5 with `observations, actions, rewards, costs, terminals, timeouts` | where either flag is set |
| Minari | a folder with `data/main_data.hdf5`, one group `episode_N` each; cost in `infos/cost` | with its group |

Nothing read here is trusted: `npz`, `legacy_npz` and `hdf5` bound what is read, and the caller checks every value.
"""

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.demonstrations import columns, hdf5, hdf5_child, npz, pickled_npz
from ccil_jax.demonstrations.npz import ArchiveError

MAX_METADATA_BYTES = 1024**2
NO_COSTS = (
    "holds no cost of each step ('costs' in DSRL, 'infos/cost' in Minari, 'accucost' or 'costs' in baselines and CCIL "
    "files); constrained methods need it (`convert --default-cost 0` for gail)"
)
_MINARI_DATA = Path("data") / "main_data.hdf5"

Arrays = dict[str, Any]


def reader_of(path: Path) -> Callable[[Path], Arrays] | None:
    """What reads `path` into our arrays; None for our own format and for what is none of these.

    The reader raises `ArchiveError`. `costs` and `rewards` are None where the file has none.
    """
    if path.is_dir():
        return _read_minari_folder if (path / _MINARI_DATA).exists() else None
    if not path.is_file():
        return None
    try:
        with path.open("rb") as file:
            start = file.read(len(hdf5.SIGNATURE))
    except OSError:
        return None  # the reader of our own format says why
    if start == hdf5.SIGNATURE:
        return _read_hdf5
    keys = npz.keys_of(path) if start[:2] == b"PK" else frozenset()
    return _read_legacy if "acs" in keys and "episode_ends" not in keys else None  # the latter is ours alone


def _read_legacy(path: Path) -> Arrays:
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
        "costs": _legacy_costs(found, lengths, path),
        **_flags_at_ends(lengths),
        "metadata": {"format": "baselines"},
    }


def _legacy_costs(found: Mapping[str, Sequence[np.ndarray]], lengths: Sequence[int], path: Path) -> np.ndarray | None:
    """`accucost` is the running sum of an episode's costs; `costs` may be of each step or each episode's total."""
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
            raise ArchiveError(_contradiction(_of(path, "accucost", i), "costs"))
    return _join(steps, "accucost", path)


def _read_hdf5(path: Path) -> Arrays:
    found = hdf5.read(path)
    return _minari(found, path) if any(name.startswith("episode_") for name in found) else _dsrl(found, path)


def _dsrl(found: Mapping[str, np.ndarray], path: Path) -> Arrays:
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
    complete: Arrays = {key: None if array is None else array[: ends[-1]] for key, array in arrays.items()}
    return {**complete, "episode_ends": ends, "metadata": {"format": "dsrl"}}


def _read_minari_folder(path: Path) -> Arrays:
    for part in (path / "data", path / _MINARI_DATA, path / "data" / "metadata.json"):
        if part.is_symlink():
            raise ArchiveError(f"{part}: a link, refused because it can lead to another file; copy the data in")
    if not (path / _MINARI_DATA).is_file():
        raise ArchiveError(f"{path / _MINARI_DATA}: not a file; copy the dataset again")
    facts = _minari_facts(path / "data" / "metadata.json")
    arrays = _minari(hdf5.read(path / _MINARI_DATA), path)
    return {**arrays, "metadata": {**arrays["metadata"], **facts}}


def _minari_facts(path: Path) -> dict[str, str]:
    """The dataset's name, where the folder tells it."""
    if not path.exists():
        return {}
    try:
        if not path.is_file() or path.stat().st_size > MAX_METADATA_BYTES:
            raise ValueError("not a small file")
        facts = json.loads(path.read_text(encoding="utf-8-sig"))
        if not isinstance(facts, dict):
            raise TypeError("not an object")
        return {key: str(facts[key])[:200] for key in ("dataset_id", "minari_version") if key in facts}
    except (OSError, ValueError, TypeError, RecursionError):
        raise ArchiveError(f"{path}: not a JSON object of at most {MAX_METADATA_BYTES} bytes; copy it again") from None


def _minari(found: Mapping[str, np.ndarray], path: Path) -> Arrays:
    names = sorted({name.partition("/")[0] for name in found if "/" in name}, key=lambda name: (len(name), name))
    episodes = [_episode(found, name, path) for name in names]
    if not episodes:
        raise ArchiveError(f"{path}: holds no episode; copy the dataset again")

    def joined(key: str) -> np.ndarray | None:
        parts = [episode[key] for episode in episodes]
        without = [name for name, part in zip(names, parts, strict=True) if part is None]
        if 0 < len(without) < len(names):
            raise ArchiveError(f"{path}: '{without[0]}' has no {key}, other episodes have; record it again")
        return None if without else _join(parts, key, path)

    keys = ("obs", "actions", "rewards", "costs", "terminated", "truncated")
    ends = np.cumsum([len(episode["actions"]) for episode in episodes])
    return {**{key: joined(key) for key in keys}, "episode_ends": ends, "metadata": {"format": "minari"}}


def _episode(found: Mapping[str, np.ndarray], name: str, path: Path) -> Arrays:
    """One episode of T steps. Observations have T + 1 rows; so may infos, as the reset has one too."""

    def where(key: str) -> str:
        return f"{path}: '{name}/{key}'"

    for key in ("observations", "actions", "terminations", "truncations"):
        if f"{name}/{key}" not in found:
            raise ArchiveError(f"{where(key)} is missing; only plain arrays of steps can be used")
    actions = columns.rows(found[f"{name}/actions"], where("actions"))
    length = len(actions)
    if length == 0:
        raise ArchiveError(f"{where('actions')} has no rows: an episode without steps; remove that episode")
    rewards = found.get(f"{name}/rewards")
    return {
        "obs": columns.rows(found[f"{name}/observations"], where("observations"), length + 1)[:-1],
        "actions": actions,
        "rewards": None if rewards is None else columns.per_step(rewards, where("rewards"), (length,)),
        "costs": _episode_costs(found, name, length, path),
        "terminated": columns.flags(found[f"{name}/terminations"], where("terminations"), (length,)),
        "truncated": columns.flags(found[f"{name}/truncations"], where("truncations"), (length,)),
    }


def _episode_costs(found: Mapping[str, np.ndarray], name: str, length: int, path: Path) -> np.ndarray | None:
    """The costs of an episode's steps, without the reset's. Several arrays may hold them if they agree.

    An array of several numbers a step, such as the terms of a cost, is no candidate beside one of one number a step.
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
            raise ArchiveError(_contradiction(f"{path}: '{first}'", second))
    return next(iter(steps.values()), None)


def _contradiction(first: str, second: str) -> str:
    return f"{first} and '{second}' hold different costs of the same steps; remove the one that is not the task's cost"


def _flags_at_ends(lengths: Sequence[int]) -> Arrays:
    """Where the file does not say how episodes ended, neither flag is set."""
    unknown = np.zeros(sum(lengths), np.bool_)
    return {"terminated": unknown, "truncated": unknown, "episode_ends": np.cumsum(lengths, dtype=np.int64)}


def _of(path: Path, key: str, trajectory: int) -> str:
    return f"{path}: '{key}' of trajectory {trajectory}"


def _flat(part: np.ndarray, where: str) -> np.ndarray:
    """[T, ...] as [T, columns], as the readers of those projects have it; a vector is one column."""
    return columns.rows(part.reshape(len(part), -1) if part.ndim > 2 and part.size else part, where)


def _per_trajectory(
    found: Mapping[str, Sequence[np.ndarray]], key: str, lengths: Sequence[int], path: Path
) -> list[np.ndarray] | None:
    """[T] of each trajectory; None without that key."""
    if key not in found:
        return None
    parts = zip(found[key], lengths, strict=True)
    return [columns.per_step(part, _of(path, key, i), (length,)) for i, (part, length) in enumerate(parts)]


def _join(parts: Sequence[np.ndarray], key: str, path: Path) -> np.ndarray:
    """The parts end to end."""
    for i, part in enumerate(parts):
        if part.shape[1:] != parts[0].shape[1:]:
            raise ArchiveError(
                f"{_of(path, key, i)} has shape {part.shape}, trajectory 0 has {parts[0].shape}; "
                "only their lengths may differ"
            )
    return np.concatenate(parts) if parts else np.zeros(0)
