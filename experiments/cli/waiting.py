"""Progress of what takes long after a training: a bar on a terminal, a line every ten seconds elsewhere.

Everything is written to standard error. Importing this module imports neither JAX nor rich.
"""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

_SECONDS_BETWEEN_LINES = 10.0


@contextlib.contextmanager
def progress(title: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Gives a function to be told how many of how many units are done.

    Args:
        title: stands at the beginning of the bar or of each line.
        unit: what is counted, such as "steps".
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(file=sys.stderr, soft_wrap=True, markup=False, emoji=False)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:,}/{task.total:,} {task.fields[unit]}", markup=False),
        TimeRemainingColumn(),
    )
    last_line = time.monotonic()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=1, unit=unit)

        def update(done: int, total: int) -> None:
            nonlocal last_line
            bar.update(task, completed=done, total=total)
            if not console.is_terminal and time.monotonic() - last_line >= _SECONDS_BETWEEN_LINES:
                last_line = time.monotonic()
                console.print(f"{title}: {done:,}/{total:,} {unit}", highlight=False)

        yield update
