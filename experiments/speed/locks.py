"""Lets several processes compile at the same time, but only one of them measure, by locks on a file."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def file_lock(file: str | None, *, exclusive: bool) -> Iterator[None]:
    """Waits for the right to work, and holds it inside the `with` block.

    Args:
        file: the lock file that the processes share; None: there is nobody to wait for.
        exclusive: whether no other process may work at the same time. Otherwise several may, as long as none of them
            holds the lock exclusively.
    """
    if file is None:
        yield
        return
    import fcntl  # Linux and macOS

    with Path(file).open("a") as opened:
        fcntl.flock(opened, fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH)
        yield  # closing the file releases the lock, and so does the end of the process
