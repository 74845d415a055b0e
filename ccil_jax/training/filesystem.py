"""Files and folders: locks, digests, and the errors of a full disk."""

import contextlib
import errno
import fcntl
import hashlib
import os
import platform
from collections.abc import Iterator
from pathlib import Path

from ccil_jax.errors import LockedError

DISK_IS_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # also: a quota is used up, or a file may not be so large


def unfit_for_checkpoints(path: Path) -> str | None:
    """Why checkpoints cannot be kept in `path`; None if they can.

    Orbax takes a [ in a path as part of a pattern, and then reports a finished step whose arrays are not there.
    """
    if "[" not in str(path.resolve()):
        return None
    return "checkpoints cannot be kept below a folder with [ in its name; choose another"


@contextlib.contextmanager
def hold(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Locks the file `path` for this process while the context lasts. The file stays there afterwards, unlocked.

    The operating system frees the lock when the process ends, however it ends.

    Args:
        path: made if need be, with its folder.
        wait: wait until another process frees the lock, instead of raising an error.

    Raises:
        LockedError: another process holds the lock.
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


def content_sha256(path: Path) -> str | None:
    """What tells the content of a file or folder from another: for a file its SHA-256; None where nothing is there.

    For a folder it is the digest of the names and digests of all files in it, so it does not depend on where the folder
    is. Links are not followed.
    """
    if path.is_file():
        return file_sha256(path)
    if not path.is_dir():
        return None
    files = sorted(file for file in path.rglob("*") if file.is_file() and not file.is_symlink())
    lines = [f"{file_sha256(file)}  {file.relative_to(path).as_posix()}\n" for file in files]
    return hashlib.sha256("".join(lines).encode(errors="surrogateescape")).hexdigest()


def file_sha256(path: Path) -> str:
    """The SHA-256 digest of a file's bytes, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
