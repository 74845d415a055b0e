"""The child that reads HDF5: its limits hold, and however it ends the parent says so in one line."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from ccil_jax import hdf5, npz
from ccil_jax.npz import ArchiveError


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


def test_memory_and_time_are_limited() -> None:
    code = (
        "import resource, numpy as np; from ccil_jax import hdf5_child\n"
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
