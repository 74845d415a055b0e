"""The child that reads HDF5: its limits hold, and however it ends the parent says so in one line."""

import contextlib
import functools
import importlib.util
import io
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import pytest

from ccil_jax.demonstrations import hdf5, hdf5_child, npz
from ccil_jax.demonstrations.npz import ArchiveError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    with h5py.File(tmp_path / "d.hdf5", "w") as file:
        file["actions"] = np.arange(1024**2, dtype=np.float64)
        file["unknown"] = np.ones(3)
        file["episode_3/infos/cost"] = np.array([True, False])
    return tmp_path / "d.hdf5"


def test_known_arrays_arrive_as_they_are(path: Path) -> None:
    found = hdf5.read(path)
    assert sorted(found) == ["actions", "episode_3/infos/cost"]
    np.testing.assert_array_equal(found["actions"], np.arange(1024**2))
    assert found["episode_3/infos/cost"].tolist() == [True, False]


def test_the_working_directory_holds_no_code_for_the_child(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("h5py", "numpy", "json"):
        (path.parent / f"{module}.py").write_text("import os; os.mkdir('canary')")
    monkeypatch.chdir(path.parent)
    hdf5.read(Path(path.name))
    assert not (path.parent / "canary").exists()


def test_the_limit_counts_all_arrays_together(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz, "MAX_BYTES", 8 * 1024**2 + 1)
    with pytest.raises(ArchiveError, match=r"holds 8388610 bytes, limit 8388609"):
        hdf5.read(path)


def test_a_child_that_dies_hangs_or_cannot_be_is_reported(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(hdf5, "TIMEOUT", 0.001)
        with pytest.raises(ArchiveError, match=r"d\.hdf5: not read within 0\.001 s"):
            hdf5.read(path)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "executable", "false")
        with pytest.raises(ArchiveError, match=r"d\.hdf5: damaged HDF5 file, its reader ended with status 1"):
            hdf5.read(path)
    with monkeypatch.context() as patch:
        patch.setattr(importlib.util, "find_spec", lambda name: None)
        with pytest.raises(ArchiveError, match="needs h5py; install it with"):
            hdf5.read(path)


def test_no_temporary_folder_is_needed(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(path.parent / "missing"))
    monkeypatch.setenv("TMPDIR", str(path.parent / "missing"))
    np.testing.assert_array_equal(hdf5.read(path)["actions"], np.arange(1024**2))


def test_where_files_in_memory_are_unknown_the_temporary_folder_is_used(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "memfd_create")
    folder = path.parent / "temporary"
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    with pytest.raises(ArchiveError, match=r"d\.hdf5: .* needs a temporary folder .* \(No such file.*TMPDIR"):
        hdf5.read(path)
    folder.mkdir()
    np.testing.assert_array_equal(hdf5.read(path)["actions"], np.arange(1024**2))
    assert list(folder.iterdir()) == []


def test_a_full_folder_is_not_a_damaged_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "memfd_create")
    monkeypatch.setattr(tempfile, "tempdir", str(path.parent))
    monkeypatch.setattr(tempfile, "TemporaryFile", functools.partial(Path("/dev/full").open, "wb"))
    message = (
        rf"d\.hdf5: .* the temporary folder {path.parent} \(No space left on device\); make space there or set TMPDIR"
    )
    with pytest.raises(ArchiveError, match=message):
        hdf5.read(path)


def test_a_limit_on_file_sizes_is_not_a_damaged_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_child(arguments: Sequence[str]) -> tuple[int, str]:
        """In this process, as a test that runs as root could not keep the child from raising its limit."""
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
        try:
            with contextlib.redirect_stderr(io.StringIO()) as complaint:
                return hdf5_child.main(arguments), complaint.getvalue().strip()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    monkeypatch.setattr(hdf5_child, "limit_resources", lambda max_bytes: None)
    monkeypatch.setattr(hdf5, "run_child", run_child)
    with pytest.raises(ArchiveError, match=r"d\.hdf5: .* could not be put into memory \(File too large\); .*ulimit"):
        hdf5.read(path)


def test_memory_and_time_are_limited() -> None:
    code = (
        "import resource, numpy as np; from ccil_jax.demonstrations import hdf5_child\n"
        "hdf5_child.CPU_SECONDS = 1\n"
        "hdf5_child.limit_resources(1024)\n"
        "try: np.ones(2**28)\n"
        "except MemoryError: print('refused', flush=True)\n"
        "while True: pass"
    )
    root = Path(__file__).parent.parent
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout == "refused\n"
    assert done.returncode < 0  # by a signal
