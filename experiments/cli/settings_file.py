"""Files of settings, TOML or JSON: read strictly, with errors that name the option and the file."""

import functools
import json
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from experiments.cli.command_line import UsageError


def read(path: Path, option: str) -> dict[str, Any]:
    """The table in a TOML or JSON file. Raises `UsageError`, which begins with `option`, for anything else."""
    read_json = functools.partial(json.loads, object_pairs_hook=_without_doubles)
    loaders: dict[str, Callable[[str], Any]] = {".toml": tomllib.loads, ".json": read_json}
    if path.suffix not in loaders:
        raise UsageError(f"{option} {path}: give a file named *.toml or *.json")
    try:
        content = loaders[path.suffix](path.read_text(encoding="utf-8-sig"))  # editors may write a byte order mark
    except OSError as error:
        raise UsageError(f"{option} {path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise UsageError(f"{option} {path}: not text in UTF-8; save it with that encoding") from None
    except RecursionError:
        raise UsageError(f"{option} {path}: nested too deeply; give a table of fields") from None
    except ValueError as error:
        raise UsageError(f"{option} {path}: not {path.suffix[1:].upper()} ({error})") from None
    if not isinstance(content, dict):
        raise UsageError(f"{option} {path}: give a table of fields")
    return content


def _without_doubles(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object from its entries. Of two entries with the same name, Python would silently keep the last."""
    names = [name for name, _ in pairs]
    if doubles := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"'{doubles[0]}' is there twice")
    return dict(pairs)


def text(value: Any) -> str:
    """A value as it is typed on a command line."""
    if isinstance(value, list | tuple):
        return ",".join(map(text, value))
    return str(value).lower() if value is None or isinstance(value, bool) else str(value)
