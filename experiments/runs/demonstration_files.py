"""Demonstrations as a command line names them: a file, a folder, or `minari:ID`, a dataset among the local ones."""

import argparse
from pathlib import Path

from ccil_jax.demonstrations import formats, minari_datasets
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.errors import DemonstrationsError
from envs.registry import TASKS
from experiments.cli import command_line
from experiments.cli.command_line import UsageError

TO_READ = (
    f"a file, the folder of a Minari dataset, or {minari_datasets.PREFIX}ID for one that Minari has on this machine"
)
TO_WRITE = f"a file *.npz, a file *.hdf5 in DSRL's layout, or {minari_datasets.PREFIX}ID, a local dataset of Minari"


def to_read(text: str) -> Path:
    """The file or folder that `text` names, for a parser of options. Raises `ArgumentTypeError` for a wrong name."""
    try:
        return minari_datasets.locate(text)
    except DemonstrationsError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def check_new(path: Path, option: str, *, overwrite: bool) -> None:
    """Checks that demonstrations can have the name `path`.

    Raises:
        UsageError: no format has such names, its library is missing, or there is something that must not be replaced.
    """
    try:
        formats.writer_of(path)
    except DemonstrationsError as error:
        raise UsageError(f"{option} {error}") from None
    if not minari_datasets.is_name(path):
        command_line.check_new_file(path, option, overwrite=overwrite)
    elif minari_datasets.folder_of(path).exists() and not overwrite:
        raise UsageError(f"{option} {path}: there is such a dataset; choose another name or add --overwrite")


def note_on_rewards(demonstrations: Demonstrations | None, task: str) -> str | None:
    """A line about demonstrations of gymnasium's environment, where its reward is not that of our `task`; else None.

    A dataset of Minari names its environment; files of other formats do not say where their rewards come from.
    """
    if demonstrations is None or demonstrations.rewards is None or task not in TASKS:
        return None
    original, lacks = TASKS[task].original, TASKS[task].reward_lacks
    if not lacks or demonstrations.metadata.get("environment") != original:
        return None
    return (
        f"the demonstrations are of {original}, whose reward contains {lacks}. That of our {task} does not, so their "
        "return, and with it the recovered %, does not compare with the learner's"
    )


def check_writable(path: Path, option: str) -> None:
    """Makes the folder in which `path` will be and writes a byte there. Raises `UsageError` if that fails."""
    command_line.check_writable(minari_datasets.root() if minari_datasets.is_name(path) else path.parent, option)
