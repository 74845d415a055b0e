"""`.npz` archives from strangers: read without pickle and within a limit on their size. Written whole or not at all.

NumPy's own loader can be asked to read object arrays, and then runs any code that is hidden in them. It also believes
what the header of an array says about its size, which can be more than the file holds, or more than there is memory.
"""

import contextlib
import io
import json
import lzma
import os
import struct
import tempfile
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ccil_jax.errors import UserError

MAX_BYTES = 2 * 1024**3  # of all arrays together, unpacked: a small archive can unpack to terabytes
MAX_METADATA_BYTES = 1024**2  # of the text that describes the arrays
SIGNATURE = b"PK"  # the first bytes of an archive

_CHUNK = 1024**2
ObjectReader = Callable[
    [bytes, tuple[int, ...], str], np.ndarray
]  # pickle, shape in the header, "file: 'key'" -> array

_DAMAGE = (  # what a hostile archive can raise out of zipfile, zlib, struct, ast and NumPy
    ArithmeticError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    lzma.LZMAError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


class ArchiveError(UserError):
    """An archive that cannot be read. The message is one line: file, key, remedy."""


def read(
    path: Path,
    keys: Iterable[str],
    *,
    optional: frozenset[str] = frozenset(),
    remedy: str,
    read_objects: ObjectReader | None = None,
) -> dict[str, np.ndarray]:
    """The arrays of an archive. Runs no code in it, and unpacks at most `MAX_BYTES`.

    Args:
        path: of the archive.
        keys: names of the arrays to read.
        optional: those of the names that may be missing.
        remedy: what to do about a file of another kind; ends such messages.
        read_objects: reads the pickle of an object array; None refuses object arrays.

    Raises:
        ArchiveError: the file cannot be read, is damaged, or holds something else.
    """
    _check_kind(path, remedy)
    return read_open(path, str(path), keys, optional=optional, remedy=remedy, read_objects=read_objects)


def read_open(
    source: Path | BinaryIO,
    name: str,
    keys: Iterable[str],
    *,
    optional: frozenset[str] = frozenset(),
    remedy: str,
    read_objects: ObjectReader | None = None,
) -> dict[str, np.ndarray]:
    """As `read`, from an open file or from a path that is known to be an archive. The messages call it `name`."""
    arrays: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(source) as archive:
            members = {info.filename: info for info in archive.infolist()}
            total = sum(info.file_size for info in members.values())
            if total > MAX_BYTES:
                raise ArchiveError(f"{name}: unpacks to {total} bytes, limit {MAX_BYTES}; use fewer episodes")
            for key in keys:
                info = members.get(f"{key}.npy")
                if info is not None:
                    arrays[key] = _read_array(archive, info, f"{name}: '{key}'", remedy, read_objects)
                elif key not in optional:
                    raise ArchiveError(f"{name}: key '{key}' is missing; {remedy}")
    except ArchiveError:
        raise
    except OSError as error:
        raise ArchiveError(f"{name}: cannot be read ({error.strerror}); check the path and rights") from None
    except _DAMAGE:
        raise ArchiveError(f"{name}: truncated or damaged .npz archive; copy or record it again") from None
    return arrays


def starts_with(path: Path, signature: bytes) -> bool:
    """Whether it is a file with these first bytes; false where it cannot be read."""
    if not path.is_file():  # a pipe would be waited for
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(signature)) == signature
    except OSError:
        return False


def keys_of(source: Path | BinaryIO) -> frozenset[str]:
    """Names of the arrays in an archive; none where the file is no archive."""
    try:
        with zipfile.ZipFile(source) as archive:
            return frozenset(name.removesuffix(".npy") for name in archive.namelist())
    except _DAMAGE:
        return frozenset()


def json_object(array: np.ndarray, where: str, remedy: str) -> dict[str, Any]:
    """The JSON object that an array holds as text. Raises `ArchiveError`, which calls the array `where`."""
    try:
        if array.nbytes > MAX_METADATA_BYTES or (array.dtype != np.uint8 and array.ndim):
            raise ValueError("not a text of reasonable length")
        text = array.tobytes().decode() if array.dtype == np.uint8 else str(array.astype(np.str_)[()])
        found = json.loads(text.removeprefix("\ufeff"))  # some editors begin a text with a byte order mark
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise ArchiveError(f"{where} is not a JSON object as text; {remedy}")
    return found


def write(path: Path, arrays: Mapping[str, Any]) -> None:
    """Writes a compressed archive, whole or not at all. Equal arrays give equal bytes. Raises `OSError`."""
    with whole(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """An empty file beside `path` to write to. It takes the place of `path` at the end, or goes where writing fails."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=".tmp")
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)  # mkstemp's 0600 would hide a shared file from its readers
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def _check_kind(path: Path, remedy: str) -> None:
    if not path.exists():
        raise ArchiveError(f"{path}: no such file; check the path")
    if not path.is_file():
        raise ArchiveError(
            f"{path}: not a file, and no Minari dataset in HDF5 (data/main_data.hdf5); give the file itself"
        )
    try:
        with path.open("rb") as file:
            start = file.read(2)
    except OSError as error:
        raise ArchiveError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    if not start:
        raise ArchiveError(f"{path}: the file is empty (0 bytes); copy or record it again")
    if start[:1] == b"\x80":
        raise ArchiveError(f"{path}: a pickle, refused because it could execute code; {remedy}")
    if path.stat().st_size > MAX_BYTES:
        raise ArchiveError(f"{path}: larger than the limit of {MAX_BYTES} bytes; use fewer episodes")
    if start != SIGNATURE:
        raise ArchiveError(f"{path}: not an .npz archive; {remedy}")


def _read_array(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, where: str, remedy: str, read_objects: ObjectReader | None
) -> np.ndarray:
    """One member of the archive as an array, after checking that its header agrees with its size."""
    try:
        content = io.BytesIO(_unpack(archive, info))
        shape, fortran_order, dtype = _read_header(content)
        if not dtype.hasobject and len(content.getbuffer()) - content.tell() == _num_bytes(shape, dtype):
            order: Any = "F" if fortran_order else "C"
            return np.ndarray(shape, dtype, buffer=content.getbuffer(), offset=content.tell(), order=order)
    except _DAMAGE:
        raise ArchiveError(f"{where} is truncated or damaged; copy or record the file again") from None
    if dtype == np.dtype(object) and read_objects is not None:
        return read_objects(content.read(), shape, where)
    if dtype.hasobject:
        raise ArchiveError(f"{where} holds pickled objects, refused because they could execute code; {remedy}")
    raise ArchiveError(f"{where} declares shape {shape}, which is not what the file holds; record it again")


def _unpack(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """The member's bytes, at most one more than it declares. `ZipFile.read` unpacks all before it checks the size."""
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        # NumPy writes no other compression. LZMA could take any amount of memory, as its header says how much.
        raise ValueError("not compressed as NumPy does it")
    with archive.open(info) as member:
        parts = []
        while part := member.read(min(_CHUNK, info.file_size + 1)):
            parts.append(part)
    return b"".join(parts)


def _read_header(content: io.BytesIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = np.lib.format.read_magic(content)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError("not a version of the format")
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    with warnings.catch_warnings():  # which NumPy gives about headers of Python 2, and Python about damaged headers
        warnings.simplefilter("ignore")
        return read_header(content)


def _num_bytes(shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    size = dtype.itemsize
    for length in shape:
        size *= int(length)
    return size
