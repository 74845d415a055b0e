"""Tables in the terminal, and how their cells write numbers."""

from typing import Any

from ccil_jax.training.progress import number

__all__ = ["BEYOND_ERROR", "bounds", "marked", "number", "show", "with_error"]

BEYOND_ERROR = "beyond the demonstrations' error"  # what the mark of a violation says


def show(table: Any) -> None:
    """Prints a rich table. Its texts are shown as they are, without markup. In a pipe or a log file it is 160 wide."""
    from rich.console import Console

    console = Console(markup=False, emoji=False)
    if not console.is_terminal:
        console.width = 160
    console.print(table)


def marked(text: str, beyond_error: bool | None) -> str:
    """The text of a violation, with a star behind it if it is beyond the error of the demonstrations."""
    return f"{text} *" if beyond_error else text


def with_error(mean: float | None, error: float | None) -> str:
    """A mean with its standard error, such as `22.00 +- 1.20`; a dash for what is unknown."""
    return "-" if mean is None else f"{number(mean)} +- {number(error)}"


def bounds(low: float | None, high: float | None) -> str:
    """An interval in brackets, such as `[1.00, 2.00]`; `[-]` where there is none."""
    return "[-]" if low is None or high is None else f"[{number(low)}, {number(high)}]"
