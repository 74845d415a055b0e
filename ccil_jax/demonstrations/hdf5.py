"""HDF5 files from strangers, read by a child process: see `hdf5_child` beside this file for what is refused and why."""

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

SIGNATURE = b"\x89HDF\r\n\x1a\n"
TIMEOUT = 300.0  # seconds


def read(path: Path) -> dict[str, np.ndarray]:
    """The arrays that demonstrations are made of, by their path inside the file.

    Raises `ArchiveError`, also where the HDF5 library crashed, hung or took too much memory.
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


def _nameless_file(path: Path) -> tuple[BinaryIO, str, str]:
    """A file for the child's arrays, gone once it is closed; where it is; and what to do if there is no room.

    It is in memory where the system has such files, so that no temporary folder is needed.
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
    """Exit status and last words of `hdf5_child` in a fresh process. Raises `subprocess.TimeoutExpired`."""
    root = str(Path(__file__).parents[2])
    settings = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])),
        "HDF5_PLUGIN_PRELOAD": "::",  # no filter is loaded from disk, whatever the file asks for
        "OPENBLAS_NUM_THREADS": "1",  # its threads would count against the child's memory
    }
    command = [sys.executable, "-P", "-m", "ccil_jax.demonstrations.hdf5_child", *arguments]
    done = subprocess.run(
        command,
        cwd=Path(root).anchor,  # not ours, where a stranger's module might be found
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
