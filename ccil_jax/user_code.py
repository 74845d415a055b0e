"""Functions of a user's own: how they are called, and what they may return.

What they return is checked while a program is traced, by shapes and types alone, so that the checks add nothing to it.
"""

import sysconfig
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ccil_jax.errors import ConfigError, UserError


def call(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`. An error of the user's own code becomes one line that names its place.

    Args:
        what: the name of the function for messages, for example "constraint.combine".
        function: the user's.
        *arguments: what it is called with.

    Raises:
        ConfigError: it does not take these arguments, or a line of the user's raised an error, which is its cause.
    """
    try:
        return function(*arguments)
    except UserError:
        raise
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)[1:]  # the first one is the call above
        theirs = [frame for frame in frames if not _is_library(frame.filename)]
        if frames and not theirs:  # a fault of this project
            raise
        reason = (str(error).splitlines() or [""])[0]
        place = f"{Path(theirs[-1].filename).name}, line {theirs[-1].lineno}," if theirs else "calling it"
        raise ConfigError(
            f"{what}: {place} raised {type(error).__name__}: {reason.rstrip('.')}; correct that function"
        ) from error


def check_type(what: str, part: Any, wanted: type) -> None:
    """Raises `ConfigError` where `part` is no `wanted`, for example a function that builds one."""
    if not isinstance(part, wanted):
        raise ConfigError(f"{what}: is of type {type(part).__name__}; give a ccil_jax.{wanted.__name__}")


def _is_library(filename: str) -> bool:
    """Whether a file is of this project, of an installed package or of Python, and so not the user's."""
    project = Path(__file__).parent.parent
    ours = [project / name for name in ("ccil_jax", "envs", "experiments")]
    folders = [*ours, *map(Path, sysconfig.get_paths().values())]
    return any(Path(filename).is_relative_to(folder) for folder in folders)
