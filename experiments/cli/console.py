"""The command `ccil NAME ...`, which does the same as `python -m experiments.NAME ...` and works in any folder."""

import ast
import difflib
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

import ccil_jax
from experiments.cli.command_line import CONSOLE, error_line

_WRONG_INPUT = 2  # exit status
_MAIN = "\ndef main("


def launchers() -> dict[str, str]:
    """The names of all launchers, with the first lines of their docstrings. The files are read, not imported."""
    found = {}
    for path in sorted(Path(__file__).parents[1].glob("*.py")):
        text = path.read_text(encoding="utf-8")
        if _MAIN in text:
            found[path.stem] = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
    return found


def overview() -> str:
    """What `ccil --help` prints."""
    known = launchers()
    width = max(map(len, known))
    usages = [f"{CONSOLE} {rest}" for rest in ("NAME [options]", "NAME --help", "--version")]
    lines = [f"  {name:<{width}}  {line}" for name, line in known.items()]
    return "\n".join(["usage: " + "\n       ".join(usages), "", *lines, ""])


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        print(overview(), end="")
        return 0
    if name == "--version":
        print(f"ccil_jax {ccil_jax.__version__}")
        return 0
    module, known = name.replace("-", "_"), launchers()
    if module not in known:
        near = difflib.get_close_matches(module, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"see {CONSOLE} --help"
        print(error_line(CONSOLE, f"{name}: unknown; {hint}"), end="", file=sys.stderr)
        return _WRONG_INPUT
    status: int = importlib.import_module(f"experiments.{module}").main(rest)
    return status


if __name__ == "__main__":
    sys.exit(main())
