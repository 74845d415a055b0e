"""The process that reads one HDF5 file (argument 1) and writes what it holds as `.npz` to a descriptor (argument 2).

The HDF5 library is C and meets damaged files with crashes, endless loops and huge allocations; here they end a process
that has nothing to lose. Links, external storage and virtual datasets, which make one file read another, are refused.
"""

import contextlib
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

REFUSED, NOT_WRITTEN = 3, 4  # exit status: stderr holds one line that says why
COST_KEYS = ("infos/cost", "infos/costs", "costs")  # where an episode of Minari may have its costs
CPU_SECONDS = 120
MAX_ENTRIES = 100_000
_NAME = re.compile(
    r"(episode_\d{1,9}/)?(observations|actions|rewards|costs|terminals|timeouts|terminations|truncations|infos/costs?)"
)
_FILTERS = {1, 2, 3, 32000}  # deflate, shuffle, Fletcher's checksum, LZF: what h5py brings along


class RefusedError(Exception):
    """One line: the entry and what is wrong with it."""


def extract(path: Path, max_bytes: int) -> dict[str, np.ndarray]:
    """The known datasets of `path`, `max_bytes` of them at most. Raises `RefusedError`."""
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
    """The datasets whose names we know. What only shares the name of costs does not matter beside them."""
    entries = dict(_entries(file))
    complaints = {name: complaint for name, entry in entries.items() if (complaint := _no_array(entry))}
    arrays = {name: entry for name, entry in entries.items() if name not in complaints}
    for name, complaint in complaints.items():
        episode, _, key = name.partition("/")
        if key not in COST_KEYS or not any(f"{episode}/{other}" in arrays for other in COST_KEYS):
            raise RefusedError(f"'{name}' {complaint}")
    return arrays


def _no_array(entry: Any) -> str | None:
    """What keeps `entry` from being an array of numbers."""
    import h5py

    if not isinstance(entry, h5py.Dataset):
        return "is not an array but a group; only plain arrays can be used"
    if entry.shape is None or entry.dtype.kind not in "biuf" or entry.dtype.itemsize > 16:
        return f"has dtype {str(entry.dtype)[:60]}, must be a number; convert it and save again"
    return None


def _entries(file: Any) -> Iterator[tuple[str, Any]]:
    """What has a name that we know. Looks at a link before it follows it."""
    for group in _groups(file):
        for name in group:
            full = f"{group.name}/{name}".strip("/")
            if _NAME.fullmatch(full):
                _check_link(group, name, full)
                yield full, group[name]


def _groups(file: Any) -> Iterator[Any]:
    """The root, the episodes and their `infos`."""
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
    """Everything that can be known of a dataset without reading its data."""
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
    """Memory, processor time and file size, so that the worst ends this process alone."""
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
    """Reads file 0, writes to the open descriptor 1, argument 2 is the limit in bytes; returns the exit status."""
    path, descriptor, max_bytes = Path(arguments[0]), int(arguments[1]), int(arguments[2])
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
