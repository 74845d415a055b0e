"""Processes that prepare side by side and measure one at a time, by locks on a file."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def turn(file: str | None, *, alone: bool) -> Iterator[None]:
    """Waits until this process may work: `alone`, or beside others that are not. Without a file it may at once."""
    if file is None:
        yield
        return
    import fcntl  # Linux and macOS

    with Path(file).open("a") as opened:
        fcntl.flock(opened, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
        yield  # closing gives the lock back, as does the end of a process
