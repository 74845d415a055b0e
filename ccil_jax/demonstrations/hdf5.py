"""HDF5 files from strangers, read by a child process. `hdf5_child`, beside this file, says what is refused and why."""

import contextlib
import importlib.util
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ccil_jax.demonstrations import hdf5_child, npz
from ccil_jax.errors import DemonstrationsError

SIGNATURE = b"\x89HDF\r\n\x1a\n"
TIMEOUT = 300.0  # seconds that the child process may take


def read(path: Path) -> dict[str, np.ndarray]:
    """The datasets that demonstrations are made of, by their path inside the file.

    Raises:
        ArchiveError: h5py is not installed, or the file is refused or damaged, also where the HDF5 library crashed on
            it, did not end, or took too much memory.
    """
    if importlib.util.find_spec("h5py") is None:
        raise npz.ArchiveError(f"{path}: reading HDF5 needs h5py; install it with `pip install 'ccil_jax[hdf5]'`")
    file, place, remedy = _nameless_file(path)
    with file:
        try:
            status, complaint = run_child([str(path.absolute()), str(file.fileno()), str(npz.MAX_BYTES)])
        except subprocess.TimeoutExpired:
            raise npz.ArchiveError(f"{path}: not read within {TIMEOUT:g} s; the HDF5 file is damaged") from None
        if status == hdf5_child.REFUSED:
            raise npz.ArchiveError(f"{path}: {complaint}")
        if status == hdf5_child.NOT_WRITTEN:
            raise npz.ArchiveError(f"{path}: its arrays could not be put into {place} ({complaint}); {remedy}")
        if status != 0:
            raise npz.ArchiveError(f"{path}: damaged HDF5 file, its reader ended with status {status}; copy it again")
        return npz.read_open(file, str(path), sorted(npz.keys_of(file)), remedy="copy the file again")


def check_can_write(path: str | os.PathLike[str]) -> None:
    """Raises `DemonstrationsError` where the library that writes HDF5 is missing."""
    if importlib.util.find_spec("h5py") is None:
        raise DemonstrationsError(
            f"{os.fspath(path)}: writing HDF5 needs h5py; install it with `pip install 'ccil_jax[hdf5]'`"
        )


def _nameless_file(path: Path) -> tuple[BinaryIO, str, str]:
    """A file without a name, for the child's arrays: it is gone once it is closed.

    It is in memory where the system has such files, so that no temporary folder is needed.

    Returns:
        The file, where it is, and what the user can do if there is no room for the arrays.
    """
    with contextlib.suppress(AttributeError, OSError):
        file = os.fdopen(os.memfd_create("arrays"), "w+b")
        return file, "memory", "free some, raise the limits that `ulimit -a` shows, or use fewer episodes"
    try:
        file = tempfile.TemporaryFile()  # noqa: SIM115  (closed by the caller)
    except OSError as error:
        raise npz.ArchiveError(
            f"{path}: reading HDF5 needs a temporary folder that can be written ({error.strerror}); set TMPDIR to one"
        ) from None
    return file, f"the temporary folder {tempfile.gettempdir()}", "make space there or set TMPDIR to another folder"


def run_child(arguments: Sequence[str]) -> tuple[int, str]:
    """Runs `hdf5_child` in a new process. Raises `subprocess.TimeoutExpired`.

    Returns:
        The exit status, and the last line that it wrote to standard error.
    """
    root = str(Path(__file__).parents[2])
    settings = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])),
        "HDF5_PLUGIN_PRELOAD": "::",  # loads no filter from disk, even if the file asks for one: filters are code
        "OPENBLAS_NUM_THREADS": "1",  # its threads would count against the child's memory
    }
    command = [sys.executable, "-P", "-m", "ccil_jax.demonstrations.hdf5_child", *arguments]
    done = subprocess.run(
        command,
        cwd=Path(root).anchor,  # not the current folder, where Python might find a stranger's module
        env=settings,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        pass_fds=[int(arguments[1])],
        text=True,
        errors="replace",
        timeout=TIMEOUT,
        check=False,
    )
    return done.returncode, done.stderr.strip().rpartition("\n")[2]
