"""A process that reads one HDF5 file and writes its known datasets as `.npz` to an open file descriptor.

Arguments: the file, the descriptor, and how many bytes the datasets may have.

The HDF5 library is written in C. A damaged file can make it crash, loop without end or allocate huge amounts of memory.
In a process of its own this does no harm: its limits end it, and the parent reports a damaged file. Links, external
storage and virtual datasets are refused, because with them one file makes the library read another.
"""

import contextlib
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

REFUSED, NOT_WRITTEN = 3, 4  # exit statuses; one line on standard error says why
COST_KEYS = ("infos/cost", "infos/costs", "costs")  # where an episode of Minari may have its costs
CPU_SECONDS = 120
MAX_ENTRIES = 100_000
_NAME = re.compile(
    r"(episode_\d{1,9}/)?(observations|next_observations|actions|rewards|costs|terminals|timeouts|terminations|truncations|infos/costs?)"
)
_FILTERS = {1, 2, 3, 32000}  # those that h5py has built in: deflate, shuffle, Fletcher's checksum, LZF


class RefusedError(Exception):
    """The file is refused. The message is one line: the entry and what is wrong with it."""


def extract(path: Path, max_bytes: int) -> dict[str, np.ndarray]:
    """The datasets of `path` whose names are known, `max_bytes` in all at most. Raises `RefusedError`."""
    import h5py

    with h5py.File(path, "r", locking=False) as file:
        datasets = _datasets(file)
        total = 0
        for name, dataset in datasets.items():
            _check(name, dataset, max_bytes)
            total += dataset.size * dataset.dtype.itemsize
        if total > max_bytes:
            raise RefusedError(f"holds {total} bytes, limit {max_bytes}; use fewer episodes")
        return {name: dataset[()] for name, dataset in datasets.items()}


def _datasets(file: Any) -> dict[str, Any]:
    """The datasets whose names are known.

    An entry that has a name of costs but is no array of numbers is left aside where its episode has other costs.
    """
    entries = dict(_entries(file))
    complaints = {name: complaint for name, entry in entries.items() if (complaint := _no_array(entry))}
    arrays = {name: entry for name, entry in entries.items() if name not in complaints}
    for name, complaint in complaints.items():
        episode, _, key = name.partition("/")
        if key not in COST_KEYS or not any(f"{episode}/{other}" in arrays for other in COST_KEYS):
            raise RefusedError(f"'{name}' {complaint}")
    return arrays


def _no_array(entry: Any) -> str | None:
    """Why `entry` is no array of numbers; None if it is one."""
    import h5py

    if not isinstance(entry, h5py.Dataset):
        return "is not an array but a group; only plain arrays can be used"
    if entry.shape is None or entry.dtype.kind not in "biuf" or entry.dtype.itemsize > 16:
        return f"has dtype {str(entry.dtype)[:60]}, must be a number; convert it and save again"
    return None


def _entries(file: Any) -> Iterator[tuple[str, Any]]:
    """The entries whose names are known, by full name. A link is checked before it is followed."""
    for group in _groups(file):
        for name in group:
            full = f"{group.name}/{name}".strip("/")
            if _NAME.fullmatch(full):
                _check_link(group, name, full)
                yield full, group[name]


def _groups(file: Any) -> Iterator[Any]:
    """The groups in which datasets are looked for: the root, the episodes and their `infos`."""
    import h5py

    if len(file) > MAX_ENTRIES:
        raise RefusedError(f"holds {len(file)} entries, limit {MAX_ENTRIES}")
    yield file
    for name in file:
        if re.fullmatch(r"episode_\d{1,9}", name):
            _check_link(file, name, name)
            episode = file[name]
            if not isinstance(episode, h5py.Group):
                raise RefusedError(f"'{name}' is not a group; an episode holds several arrays")
            yield episode
            if "infos" in episode:
                _check_link(episode, "infos", f"{name}/infos")
                if isinstance(episode["infos"], h5py.Group):
                    yield episode["infos"]


def _check_link(group: Any, name: str, full: str) -> None:
    import h5py

    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise RefusedError(f"'{full}' is a link, refused because it can lead to another file; copy the data in")


def _check(name: str, dataset: Any, max_bytes: int) -> None:
    """Raises `RefusedError` for what can be seen to be wrong with a dataset before its data are read."""
    layout = dataset.id.get_create_plist()
    if dataset.is_virtual or layout.get_external_count():
        raise RefusedError(f"'{name}' is kept in other files, refused; copy the data in")
    filters = {layout.get_filter(i)[0] for i in range(layout.get_nfilters())}
    if not filters <= _FILTERS:
        raise RefusedError(
            f"'{name}' has filter {min(filters - _FILTERS)}, only gzip and lzf are read; save it with those"
        )
    if dataset.dtype.itemsize * max(dataset.size, _size(dataset.chunks or ())) > max_bytes:
        raise RefusedError(f"'{name}' declares shape {dataset.shape}, more than the limit of {max_bytes} bytes")
    if dataset.size and not dataset.id.get_storage_size():
        raise RefusedError(f"'{name}' declares shape {dataset.shape} and holds no data; record it again")


def _size(shape: Sequence[int]) -> int:
    size = 1
    for length in shape:
        size *= int(length)
    return size


def limit_resources(max_bytes: int) -> None:
    """Limits this process's memory, processor time and size of files, so that a damaged file can only end it."""
    import resource

    for kind, amount in (
        (resource.RLIMIT_AS, 3 * max_bytes + 1024**3),
        (resource.RLIMIT_CPU, CPU_SECONDS),
        (resource.RLIMIT_FSIZE, max_bytes + 64 * 1024**2),
        (resource.RLIMIT_CORE, 0),
    ):
        with contextlib.suppress(ValueError, OSError):  # systems differ in what they can limit
            resource.setrlimit(kind, (amount, amount))


def main(arguments: Sequence[str]) -> int:
    """Reads the file `arguments[0]` and writes its datasets to the descriptor `arguments[1]`.

    `arguments[2]` is how many bytes they may have. Returns the exit status.
    """
    file, descriptor_text, limit_text = arguments
    path, descriptor, max_bytes = Path(file), int(descriptor_text), int(limit_text)
    limit_resources(max_bytes)
    try:
        arrays = extract(path, max_bytes)
    except RefusedError as error:
        print(error, file=sys.stderr)
        return REFUSED
    except MemoryError:
        print("needs more memory than the limit; use fewer episodes", file=sys.stderr)
        return REFUSED
    except Exception:  # noqa: BLE001  (h5py turns the library's complaints into many types)
        print("truncated or damaged HDF5 file; copy or record it again", file=sys.stderr)
        return REFUSED
    try:
        with open(descriptor, "wb", closefd=False) as out:
            np.savez(out, allow_pickle=False, **arrays)
    except (OSError, MemoryError) as error:
        print(getattr(error, "strerror", None) or "out of memory", file=sys.stderr)
        return NOT_WRITTEN
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
