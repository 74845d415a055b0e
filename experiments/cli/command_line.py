"""What every launcher shares: errors of one line with exit status 2, and checks of output folders.

Nothing here imports JAX, so that `--help` and wrong input are answered at once.
"""

import argparse
import datetime
import difflib
import itertools
import os
import shlex
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from ccil_jax.errors import UserError
from ccil_jax.training.filesystem import DISK_IS_FULL, unfit_for_checkpoints
from experiments.cli import xla
from experiments.cli.names import safe_name

RUN_LOCK = ".run.lock"  # in the folder of a run's checkpoints: made when the run begins, and left there
CONSOLE = "ccil"  # the command that comes with an installation; `experiments.cli.console` carries it out
MAX_ERROR = 1000  # length of an error message in characters; it may quote a file, which may be long


class UsageError(UserError):
    """Wrong input. The message is one line that names the option or file and the remedy."""


class Parser(argparse.ArgumentParser):
    """An argument parser whose error messages are one line each; it takes `--num_seeds` for `--num-seeds`."""

    def __init__(self, name: str, description: str) -> None:
        super().__init__(
            prog=launcher_command(name),
            usage=f"{launcher_command(name)} [options]",
            description=description,
            allow_abbrev=False,  # an abbreviation may mean another option once there are more options
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    @property
    def actions(self) -> tuple[argparse.Action, ...]:
        """All options and positional arguments, in the order in which they were added."""
        return tuple(self._actions)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As in argparse, but suggests the nearest option for an unknown one."""
        given = [_hyphenated(a) for a in (sys.argv[1:] if args is None else args)]
        parsed, unknown = self.parse_known_args(given, namespace)
        if unknown:
            option = unknown[0].split("=")[0]
            known = [o for o in self._option_string_actions if o.startswith("--")]
            near = difflib.get_close_matches(option, known, n=1)
            self.error(f"{option}: unknown; " + (f"did you mean {near[0]}?" if near else "see --help"))
        return parsed

    def error(self, message: str) -> NoReturn:
        """Ends the program with exit status 2 and one line on stderr."""
        self.exit(2, error_line(self.prog, message.removeprefix("argument ")))


def error_line(program: str, message: str) -> str:
    """The line with which `program` says on stderr what is wrong."""
    line = " ".join(message.split())
    line = "".join(c if c.isprintable() else "?" for c in line)  # quoted text must not control the terminal
    line = line if len(line) <= MAX_ERROR else f"{line[:MAX_ERROR]}..."
    return f"{program}: error: {line}\n"


def _hyphenated(token: str) -> str:
    name, equals, value = token.partition("=")
    return name.replace("_", "-") + equals + value if token.startswith("--") else token


def run_launcher(parser: Parser, run: Callable[[argparse.Namespace], int | None], argv: Sequence[str] | None) -> int:
    """Parses the arguments and runs the launcher. Returns its exit status.

    Wrong input ends the process with one line on stderr and exit status 2, also if it is found after parsing.
    """
    arguments = parser.parse_args(argv)
    xla.widen_vectors()
    xla.tune_gpus()
    xla.keep_programs()
    try:
        return run(arguments) or 0
    except UserError as error:
        parser.error(error.on_command_line())
    except OSError as error:
        if error.errno not in DISK_IS_FULL:
            raise
        where = f"{error.filename}: " if error.filename else ""
        parser.error(f"{where}{error.strerror}; make space and continue with --resume")


def command() -> str:
    """The command line of this process, quoted for a shell."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    if spec:
        return shlex.join(["python", "-m", spec.name, *sys.argv[1:]])
    if _is_console():
        return shlex.join([CONSOLE, *sys.argv[1:]])
    return shlex.join(["python", *sys.orig_argv[1:]])  # a script with its path, or the code after `-c`


def launcher_command(name: str) -> str:
    """What a person types to start the launcher `name`: `ccil NAME` if this process was started so, or `python -m`."""
    return f"{CONSOLE} {name}" if _is_console() else f"python -m experiments.{name}"


def _is_console() -> bool:
    return Path(sys.argv[0]).name == CONSOLE


def integer(text: str) -> int:
    """An integer; 3000000, 3_000_000 and 3e6 are the same."""
    value = float(text)
    if not value.is_integer():
        raise ValueError(text)
    return int(value)


def positive(text: str) -> int:
    """An integer of at least 1."""
    if integer(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 1")
    return integer(text)


def natural(text: str) -> int:
    """An integer from 0 to 2^32 - 1, the range of a seed."""
    if not 0 <= integer(text) < 2**32:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 0 and below 2**32")
    return integer(text)


def boolean(text: str) -> bool:
    """True or false, in one of the usual spellings."""
    if text.lower() not in ("true", "false", "yes", "no", "1", "0"):
        raise argparse.ArgumentTypeError(f"{text!r}: give true or false")
    return text.lower() in ("true", "yes", "1")


def default_folder(task: str, method: str, option: str = "--out") -> Path:
    """Makes the new folder `runs/<task>_<method>_<time>`, or one with `-02`, `-03` ... after it where that is taken.

    Two runs that begin in the same second get different folders, because only one of them can make a folder. Call this
    after everything else has been checked: a run that is refused should leave no folder behind.

    Raises:
        UsageError: the folder cannot be made, or no checkpoints can be kept there; the message names `option`.
    """
    stamp = datetime.datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    first = folder = Path("runs") / f"{safe_name(task)}_{safe_name(method)}_{stamp}"
    if complaint := unfit_for_checkpoints(first):
        raise UsageError(f"{option} {first}: {complaint}")
    numbers = itertools.count(2)
    try:
        first.parent.mkdir(exist_ok=True)
        while True:
            try:
                folder.mkdir()
            except FileExistsError:
                folder = first.with_name(f"{first.name}-{next(numbers):02d}")
            else:
                return folder
    except OSError as error:
        raise _cannot_write(folder, option, error) from None


def check_output_folder(
    folder: Path, *, resume: bool = False, option: str = "--out", record: str = "config.json"
) -> None:
    """Makes `folder`, checks that it can be written and that it does not mix two runs.

    Args:
        folder: for the results.
        resume: whether the run in the folder is to be continued.
        option: names the folder in error messages.
        record: the file by which a folder with a run is recognised.

    Raises:
        UsageError: the folder holds another run or other files, or none that could be resumed, or cannot be written.
            A run that ended before its first iteration does not count, since nothing would be lost.
    """
    try:
        holds_run = (folder / record).is_file()
        # Files whose names begin with a dot are locks and temporary files of a process that was killed at its start.
        occupied = folder.is_dir() and any(path for path in folder.rglob("*") if not _is_left_over(path))
        did_nothing = holds_run and not resume and _did_nothing(folder)
    except OSError as error:
        raise UsageError(f"{option} {folder}: cannot be read ({error.strerror}); choose another folder") from None
    if resume and not holds_run:
        raise UsageError(f"--resume: {folder} holds no run (no {record}); leave --resume out or correct {option}")
    if holds_run and not resume and not did_nothing:
        raise UsageError(f"{option} {folder}: already holds a run; continue it with --resume or choose another folder")
    if occupied and not resume and not did_nothing:
        raise UsageError(f"{option} {folder}: not empty; choose a new folder")
    if complaint := unfit_for_checkpoints(folder):
        raise UsageError(f"{option} {folder}: {complaint}")
    check_writable(folder, option)


def _did_nothing(folder: Path) -> bool:
    """Whether a run in `folder` ended before its first iteration, as where a function of the user's own is wrong.

    Such a run leaves no more than the files that every run begins with.
    """
    begun = (folder / "checkpoints" / RUN_LOCK).is_file()
    left = [path for place in (folder, folder / "checkpoints") for path in place.glob("*") if not _is_left_over(path)]
    return begun and all(
        path.name in ("config.json", "wandb")
        or path.name.startswith("events.")
        or (path.name == "metrics.csv" and path.stat().st_size == 0)
        for path in left
    )


def _is_left_over(path: Path) -> bool:
    return path.name.startswith(".") or (path.name == "checkpoints" and path.is_dir())


def check_new_file(path: Path, option: str, *, overwrite: bool) -> None:
    """Raises `UsageError`, which names `option`, if `path` is a folder, or a file that must not be replaced."""
    if path.is_dir():
        raise UsageError(f"{option} {path}: is a folder; give the name of a file")
    if path.exists() and not overwrite:
        raise UsageError(f"{option} {path}: exists; choose another name or add --overwrite")


def check_writable(folder: Path, option: str) -> None:
    """Makes `folder` and writes a byte in it. Raises `UsageError`, which names `option`, if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"x")
    except OSError as error:
        raise _cannot_write(folder, option, error) from None


def _cannot_write(folder: Path, option: str, error: OSError) -> UsageError:
    reason = os.strerror(error.errno) if error.errno else str(error)
    return UsageError(f"{option} {folder}: cannot be written ({reason}); choose another folder")
