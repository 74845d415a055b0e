"""Demonstrations in other people's formats, recognised by content and turned into the arrays of our own.

| Format | Content | An episode ends |
|---|---|---|
| baselines, CCIL | `.npz` with `obs, acs`, `rews`, and `accucost` or per-step `costs` | with its array |
| DSRL | HDF5 with `observations, actions, rewards, costs, terminals, timeouts` | where either flag is set |
| Minari | a folder with `data/main_data.hdf5`, one group `episode_N` each; cost in `infos/cost` | with its group |

Nothing read here is trusted: `npz`, `legacy_npz` and `hdf5` bound what is read, and the caller checks every value.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax import hdf5, legacy_npz, npz
from ccil_jax.npz import ArchiveError

MAX_METADATA_BYTES = 1024**2
NO_COSTS = "holds no cost of each step; constrained methods need it (`convert --default-cost 0` for gail)"
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
    return _read_legacy if start[:2] == b"PK" and "acs" in npz.keys_of(path) else None


def _read_legacy(path: Path) -> Arrays:
    found = legacy_npz.read(path)
    for key, parts in found.items():
        if len(parts) != len(found["obs"]):
            raise ArchiveError(
                f"{path}: '{key}' has {len(parts)} trajectories, 'obs' has {len(found['obs'])}; they must be equal"
            )
    for key in legacy_npz.KEYS:
        for i, part in enumerate(found[key]):
            if part.ndim == 0:
                raise ArchiveError(f"{path}: '{key}' has shape () (trajectory {i}), must have one row a step")
    lengths = [len(part) for part in found["obs"]]
    rewards = _columns(found["rews"], lengths, "rews", path) if "rews" in found else None
    return {
        "obs": _join([_rows(part) for part in found["obs"]], "obs", path),
        "actions": _join([_rows(part) for part in found["acs"]], "acs", path),
        "rewards": None if rewards is None else _join(rewards, "rews", path),
        "costs": _legacy_costs(found, lengths, path),
        **_flags_at_ends(lengths),
        "metadata": {"format": "baselines"},
    }


def _legacy_costs(found: Mapping[str, Sequence[np.ndarray]], lengths: Sequence[int], path: Path) -> np.ndarray | None:
    """`accucost` is the running sum of an episode's costs; `costs` may be of each step or each episode's total."""
    if "accucost" in found:
        parts = []
        for i, sums in enumerate(_columns(found["accucost"], lengths, "accucost", path)):
            cost = np.diff(sums.astype(np.float64), prepend=0.0)
            if (cost < 0).any():
                raise ArchiveError(
                    f"{path}: 'accucost' decreases (trajectory {i}, row {int(np.argmax(cost < 0))}); "
                    "it must be the running sum of costs"
                )
            parts.append(cost)
        return _join(parts, "accucost", path)
    if "costs" not in found or all(part.ndim == 0 for part in found["costs"]):
        return None
    return _join(_columns(found["costs"], lengths, "costs", path), "costs", path)


def _read_hdf5(path: Path) -> Arrays:
    found = hdf5.read(path)
    if any(name.startswith("episode_") for name in found):
        return _minari(found, path)
    for key in ("observations", "actions", "terminals", "timeouts"):
        if key not in found:
            raise ArchiveError(f"{path}: key '{key}' is missing; DSRL and Minari files can be read")
    if found["observations"].ndim == 0:
        raise ArchiveError(f"{path}: 'observations' has shape (), must have one row a step")
    num_rows = len(found["observations"])
    for key, array in found.items():
        if array.ndim == 0 or len(array) != num_rows:
            raise ArchiveError(f"{path}: '{key}' has shape {array.shape}, must have {num_rows} rows as 'observations'")
    terminated, truncated = (_flags(found[key], key, path) for key in ("terminals", "timeouts"))
    ends = np.flatnonzero(terminated | truncated) + 1
    if len(ends) == 0:
        raise ArchiveError(f"{path}: neither 'terminals' nor 'timeouts' is ever true: no episode is complete")
    arrays = {
        "obs": found["observations"],
        "actions": found["actions"],
        "rewards": found.get("rewards"),
        "costs": found.get("costs"),
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
        facts = json.loads(path.read_text(encoding="utf-8"))
        return {key: str(facts[key])[:200] for key in ("dataset_id", "minari_version") if key in facts}
    except (OSError, ValueError, TypeError, RecursionError):
        raise ArchiveError(f"{path}: not a JSON object of at most {MAX_METADATA_BYTES} bytes; copy it again") from None


def _minari(found: Mapping[str, np.ndarray], path: Path) -> Arrays:
    names = sorted({name.partition("/")[0] for name in found if "/" in name}, key=lambda name: (len(name), name))
    episodes = [_episode(found, name, path) for name in names]
    if not episodes:
        raise ArchiveError(f"{path}: holds no episode; copy the dataset again")

    def column(key: str) -> np.ndarray | None:
        parts = [episode[key] for episode in episodes]
        return None if any(part is None for part in parts) else _join(parts, key, path)

    keys = ("obs", "actions", "rewards", "costs", "terminated", "truncated")
    ends = np.cumsum([len(episode["actions"]) for episode in episodes])
    return {**{key: column(key) for key in keys}, "episode_ends": ends, "metadata": {"format": "minari"}}


def _episode(found: Mapping[str, np.ndarray], name: str, path: Path) -> Arrays:
    """One episode of T steps. Observations have T + 1 rows; so may infos, as the reset has one too."""
    where = f"{path}: '{name}"
    for key in ("observations", "actions", "terminations", "truncations"):
        if found.get(f"{name}/{key}", np.zeros(())).ndim == 0:
            raise ArchiveError(f"{where}/{key}' is missing or no array; only plain arrays of steps can be used")
    num_steps = len(found[f"{name}/actions"])
    cost = next(
        (found[f"{name}/{key}"] for key in ("infos/cost", "infos/costs", "costs") if f"{name}/{key}" in found), None
    )
    if cost is not None and cost.ndim == 1 and len(cost) == num_steps + 1:
        cost = cost[1:]
    steps: Arrays = {
        "obs": found[f"{name}/observations"][:-1],
        "actions": found[f"{name}/actions"],
        "rewards": found.get(f"{name}/rewards"),
        "costs": cost,
        "terminated": _flags(found[f"{name}/terminations"], f"{name}/terminations", path),
        "truncated": _flags(found[f"{name}/truncations"], f"{name}/truncations", path),
    }
    for key, array in steps.items():
        if array is not None and (array.ndim == 0 or len(array) != num_steps):
            rows = "one row" if array.ndim == 0 else f"{len(array)} rows"
            raise ArchiveError(f"{where}': '{key}' has {rows}, must have {num_steps}, one for each action")
    return steps


def _flags_at_ends(lengths: Sequence[int]) -> Arrays:
    """Where the file does not say how episodes ended, neither flag is set."""
    unknown = np.zeros(sum(lengths), np.bool_)
    return {"terminated": unknown, "truncated": unknown, "episode_ends": np.cumsum(lengths, dtype=np.int64)}


def _rows(part: np.ndarray) -> np.ndarray:
    """[T, ...] as [T, columns]; a vector is one column."""
    return part.reshape(len(part), -1) if len(part) else part


def _columns(parts: Sequence[np.ndarray], lengths: Sequence[int], key: str, path: Path) -> list[np.ndarray]:
    """Each part as [T]; [T, 1] is taken too."""
    for i, (part, length) in enumerate(zip(parts, lengths, strict=True)):
        if part.ndim == 0 or len(part) != length or part.size != length:
            raise ArchiveError(f"{path}: '{key}' has shape {part.shape}, 'obs' has {length} rows (trajectory {i})")
    return [part.reshape(-1) for part in parts]


def _join(parts: Sequence[np.ndarray], key: str, path: Path) -> np.ndarray:
    """The parts end to end."""
    for i, part in enumerate(parts):
        if part.dtype.kind not in "biuf":
            raise ArchiveError(f"{path}: '{key}' has dtype {part.dtype}, must be number (trajectory {i}); convert it")
        if part.ndim == 0 or part.shape[1:] != parts[0].shape[1:]:
            raise ArchiveError(
                f"{path}: '{key}' has shape {part.shape}, trajectory 0 has {parts[0].shape} (trajectory {i}); "
                "only their lengths may differ"
            )
    return np.concatenate(parts) if parts else np.zeros(0)


def _flags(array: np.ndarray, key: str, path: Path) -> np.ndarray:
    """Booleans, also where they were stored as the numbers 0 and 1."""
    if array.dtype.kind not in "biuf" or array.ndim != 1 or not np.isin(array, (0, 1)).all():
        raise ArchiveError(f"{path}: '{key}' is not a row of flags; it may hold 0 and 1 only")
    return array.astype(np.bool_)
