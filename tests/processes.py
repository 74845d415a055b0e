"""Other processes, as Linux shows them."""

from pathlib import Path

import pytest

in_proc = pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="finds processes in Linux's /proc")


def command_lines() -> dict[int, list[str]]:
    """The words that each process was started with; of one that is dead, but still listed, none."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            found[int(path.parent.name)] = path.read_bytes().decode(errors="replace").split("\0")
        except OSError:  # it has ended
            continue
    return found
