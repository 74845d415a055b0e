"""Files and folders: who writes, what was written, and that the disk is full."""

import contextlib
import errno
import fcntl
import hashlib
import os
import platform
from collections.abc import Iterator
from pathlib import Path

from ccil_jax.errors import LockedError

DISK_IS_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # or a quota, or the largest file that may be


def unfit_for_checkpoints(path: Path) -> str | None:
    """What is wrong with a folder below which checkpoints are to be kept; None if nothing is.

    Orbax takes a path with [ for a pattern, and commits a step whose arrays are not there.
    """
    if "[" not in str(path.resolve()):
        return None
    return "checkpoints cannot be kept below a folder with [ in its name; choose another"


@contextlib.contextmanager
def hold(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Holds the lock file `path`, which stays behind, unlocked. If it is held, raises `LockedError` at once, or waits.

    The operating system frees the lock when the process ends, however it ends.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip() or "another process"
            raise LockedError(
                f"{path.parent}: in use by {holder}; wait for it, end it, or choose another folder"
            ) from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {platform.node()}")
        file.flush()
        yield


def file_sha256(path: Path) -> str:
    """Digest of a file's bytes, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
