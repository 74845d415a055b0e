"""Archives from strangers: whatever they hold, they end in one line, run nothing and fill no memory."""

import contextlib
import io
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ccil_jax.demonstrations import npz
from ccil_jax.demonstrations.trajectories import load_demonstrations
from ccil_jax.errors import DemonstrationsError

ARRAYS = {"x": np.arange(12.0).reshape(3, 4), "flags": np.array([True, False]), "text": np.array("{}")}


def read(path: Path) -> dict[str, np.ndarray]:
    return npz.read(path, (*ARRAYS, "more"), optional=frozenset({"more"}), remedy="write it anew")


class Payload:
    """Unpickling it makes a directory named canary."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("canary",)


def _objects(path: Path) -> None:
    np.savez(path, allow_pickle=True, x=np.array([Payload()], object))


def _lying_header(path: Path) -> None:
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (2000000000000, 1), }\n"
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\0" * 64
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", member)


def _flipped(path: Path) -> None:
    npz.write(path, ARRAYS)
    content = bytearray(path.read_bytes())
    content[120] ^= 1
    path.write_bytes(content)


def _truncated(path: Path) -> None:
    npz.write(path, ARRAYS)
    path.write_bytes(path.read_bytes()[:-300])


def _npy(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def _not_arrays(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", b"hello")


BAD_FILES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "missing": (lambda path: None, "no such file"),
    "directory": (lambda path: path.mkdir(), "not a file"),
    "zero bytes": (lambda path: path.write_bytes(b""), "0 bytes"),
    "text": (lambda path: path.write_text("x,y\n1,2\n"), "not an .npz archive; write it anew"),
    "one array": (_npy, "not an .npz archive"),
    "truncated": (_truncated, "truncated or damaged"),
    "only a signature": (lambda path: path.write_bytes(b"PK\x03\x04"), "truncated or damaged"),
    "flipped bit": (_flipped, "truncated or damaged"),
    "not arrays": (_not_arrays, "'x' is truncated or damaged"),
    "missing key": (lambda path: np.savez(path, y=np.zeros(3)), "key 'x' is missing; write it anew"),
    "raw pickle": (lambda path: path.write_bytes(pickle.dumps(Payload())), "could execute code"),
    "pickled objects": (_objects, "'x' holds pickled objects, refused because they could execute code"),
    "header that lies": (_lying_header, r"'x' declares shape \(2000000000000, 1\)"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_end_in_one_line(tmp_path: Path, case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "bad.npz"
    build, message = BAD_FILES[case]
    build(path)
    with pytest.raises(npz.ArchiveError, match=message) as error:
        read(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "canary").exists()
    with pytest.raises(DemonstrationsError, match=r"bad\.npz"):
        load_demonstrations(path)


def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("x.npy", "w") as member:
        for _ in range(64):
            member.write(bytes(1024**2))
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(npz, "MAX_BYTES", 10 * 1024**2)
    with pytest.raises(npz.ArchiveError, match="unpacks to 67108864 bytes, limit 10485760"):
        read(path)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_what_numpy_writes_is_read(tmp_path: Path, save: Callable[..., None]) -> None:
    arrays = {**ARRAYS, "x": np.asfortranarray(ARRAYS["x"]), "more": np.zeros((0, 5), np.int32), "unknown": np.ones(3)}
    save(tmp_path / "a.npz", **arrays)
    found = read(tmp_path / "a.npz")
    assert set(found) == {"x", "flags", "text", "more"}
    for key, value in found.items():
        np.testing.assert_array_equal(value, arrays[key])
        assert value.dtype == arrays[key].dtype


def test_writing_is_reproducible_and_leaves_no_other_file(tmp_path: Path) -> None:
    for name in ("a.npz", "b.npz"):
        npz.write(tmp_path / "deeper" / name, ARRAYS)
    first, second = sorted((tmp_path / "deeper").iterdir())
    assert first.read_bytes() == second.read_bytes()


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.npz"
    npz.write(path, ARRAYS)
    before = path.read_bytes()

    def fail(*_: Any, **__: Any) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="disk full"):
        npz.write(path, {"x": np.ones(3)})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.booleans(),
    st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 255)), min_size=1, max_size=8),
    st.booleans(),
)
def test_no_mutation_raises_anything_else(
    tmp_path: Path, compressed: bool, edits: list[tuple[int, int]], cut: bool
) -> None:
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **ARRAYS)
    content = bytearray(buffer.getvalue())
    for position, value in edits:
        content[position % len(content)] = value
    path = tmp_path / "mutated.npz"
    path.write_bytes(content[: edits[0][0]] if cut else content)
    with contextlib.suppress(npz.ArchiveError):
        read(path)
