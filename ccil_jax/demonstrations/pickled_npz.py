"""Reads the pickled arrays in `.npz` demonstrations of OpenAI's baselines and of CCIL, without running their code.

These files hold one array for each trajectory, in object arrays, which NumPy stores as pickles. A pickle is a program,
and unpickling runs it. The unpickler here is restricted. It accepts only the opcodes and the five names that NumPy
writes for arrays, dtypes and numbers. All opcodes are checked before the first one runs. The names stand for classes in
this file which only keep what they are given, so that no function of NumPy is called. Nothing grows beyond the number
of bytes that the file holds.
"""

import io
import math
import pickle
import pickletools
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.demonstrations import npz

KEYS = ("obs", "acs")
OPTIONAL_KEYS = ("rews", "costs", "accucost")
MAX_OPCODES = 3_000_000  # of a file, which take seconds to parse. An array has about 20, a number in a list 1 to 8
_OPCODES = frozenset(
    "PROTO FRAME STOP MARK MEMOIZE BINPUT LONG_BINPUT BINGET LONG_BINGET GLOBAL STACK_GLOBAL REDUCE BUILD "
    "NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 LONG1 BINFLOAT EMPTY_LIST APPEND APPENDS "
    "EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 BINBYTES SHORT_BINBYTES BINBYTES8 BINUNICODE SHORT_BINUNICODE "
    "BINSTRING SHORT_BINSTRING".split()
)
_REFUSED = "refused because it could execute code; record it anew"
_DTYPE = re.compile(r"b1|[iu][1248]|f[248]|O8?")
_DAMAGE = (
    pickle.UnpicklingError,
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
    struct.error,
)


class _UnsafeError(Exception):
    """A pickle has opcodes or names that arrays do not need."""


def read(path: Path) -> dict[str, list[np.ndarray]]:
    """One numeric array for each trajectory, for each of `KEYS` and for those of `OPTIONAL_KEYS` that are there.

    Raises:
        ArchiveError: the file is damaged, or holds or does anything else.
    """
    optional = frozenset(OPTIONAL_KEYS)
    remedy = "the keys are obs, acs, and costs or accucost"
    left = MAX_OPCODES

    def read_objects(content: bytes, shape: tuple[int, ...], where: str) -> np.ndarray:
        nonlocal left
        array, opcodes = unpickle(content, shape, where, left)
        left -= opcodes
        return array

    arrays = npz.read(path, (*KEYS, *OPTIONAL_KEYS), optional=optional, remedy=remedy, read_objects=read_objects)
    for key, array in arrays.items():
        if array.ndim == 0:
            raise npz.ArchiveError(f"{path}: '{key}' is one value, must be one array per trajectory; record it again")
    return {key: list(array) for key, array in arrays.items()}


def unpickle(
    content: bytes, shape: tuple[int, ...], where: str, max_opcodes: int = MAX_OPCODES
) -> tuple[np.ndarray, int]:
    """The array in a pickle.

    Args:
        content: the pickle; only its first object is looked at.
        shape: of the array, as the file's header declares it.
        where: file and key, which begin a message.
        max_opcodes: how many opcodes the pickle may have.

    Returns:
        A numeric array, or an array [E] of dtype object whose entries are numeric arrays; and how many opcodes there
        were.

    Raises:
        ArchiveError: the pickle is damaged, or holds or does anything else.
    """
    try:
        opcodes = _check_opcodes(content, max_opcodes)
        array = _Unpickler(content).load()
        if not isinstance(array, _Array) or array.shape != shape or not isinstance(array.values, list):
            raise ValueError("not the array that the header declares")
        budget = _Budget(2 * len(content))
        if len(shape) == 1 and any(isinstance(value, _Array | list | tuple) for value in array.values):
            return budget.ragged(array.values), opcodes
        return budget.numbers(array.values).reshape(shape), opcodes
    except _UnsafeError as error:
        raise npz.ArchiveError(f"{where} {error}") from None
    except _DAMAGE:
        raise npz.ArchiveError(f"{where} is truncated or damaged, or no array of arrays; record it anew") from None


def _check_opcodes(content: bytes, limit: int) -> int:
    """Reads the pickle's program without running it, and returns the number of its opcodes.

    All opcodes must be known ones, a frame no larger than the file, and the index of a memo entry no larger than the
    number of opcodes before it, because the unpickler allocates a memo up to that index.
    """
    count = 0
    for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
        if opcode.name not in _OPCODES:
            raise _UnsafeError(f"holds a pickle with opcode {opcode.name}, {_REFUSED}")
        if count > limit:
            raise _UnsafeError(
                f"takes the file past {MAX_OPCODES} opcodes of pickles; save arrays, not lists of numbers"
            )
        size = argument if isinstance(argument, int) else 0
        if opcode.name in ("BINPUT", "LONG_BINPUT") and size > count:
            raise ValueError("the unpickler would make a memo of this size")
        if opcode.name == "FRAME" and size > len(content):
            raise ValueError("the frame is larger than the file")
    return count


class _Dtype:
    """In the place of `numpy.dtype(code, align, copy)`."""

    def __init__(self, code: str | bytes, *_: Any) -> None:
        self.code, self.order = _text(code), "|"
        if not _DTYPE.fullmatch(self.code):
            raise ValueError("not a number's dtype")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, order, *structure = state
        self.order = _text(order)
        if self.order not in ("<", ">", "|", "=") or any(part is not None for part in structure[:3]):
            raise ValueError("not a number's dtype")

    @property
    def is_object(self) -> bool:
        return self.code.startswith("O")

    def numpy(self) -> np.dtype[Any]:
        if self.is_object:
            raise ValueError("objects within objects")
        return np.dtype(self.order + self.code)


class _Array:
    """In the place of `numpy.ndarray`: `values` is a numeric array, or a list where the dtype is object."""

    def __init__(self) -> None:
        self.shape: tuple[int, ...] = ()
        self.values: np.ndarray | list[Any] | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, fortran_order, content = state
        if not (isinstance(shape, tuple) and all(type(n) is int and n >= 0 for n in shape) and len(shape) <= 4):
            raise ValueError("not a shape")
        if dtype.is_object:
            if not isinstance(content, list) or len(content) != math.prod(shape):
                raise ValueError("the list is not as long as the shape says")
            self.values = content
        else:
            kind, content = dtype.numpy(), _bytes(content)
            if len(content) != math.prod(shape) * kind.itemsize:
                raise ValueError("the content is not as long as the shape says")
            self.values = np.frombuffer(content, kind).reshape(shape, order="F" if fortran_order is True else "C")
        self.shape = shape


class _NdarrayName:
    """In the place of the name `numpy.ndarray`, which is passed to `_reconstruct` and is never called."""


def _reconstruct(kind: type, *_: Any) -> _Array:
    if kind is not _NdarrayName:
        raise ValueError("not an array")
    return _Array()


def _scalar(dtype: _Dtype, content: bytes) -> Any:
    return np.frombuffer(_bytes(content), dtype.numpy()).item()


def _bytes(content: Any) -> bytes:
    if not isinstance(content, bytes):
        raise TypeError("not the bytes of an array")
    return content


def _text(value: Any) -> str:
    return value.decode("ascii") if isinstance(value, bytes) else str(value)  # bytes where Python 2 wrote


class _Unpickler(pickle.Unpickler):
    """Finds the names that NumPy writes in this file, and imports nothing."""

    def __init__(self, content: bytes) -> None:
        super().__init__(io.BytesIO(content), encoding="bytes")
        self._budget = _Budget(len(content))

    def find_class(self, module: str, name: str) -> Any:
        names = {
            ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
            ("numpy._core.multiarray", "_reconstruct"): _reconstruct,
            ("numpy.core.multiarray", "scalar"): _scalar,
            ("numpy._core.multiarray", "scalar"): _scalar,
            ("numpy", "ndarray"): _NdarrayName,
            ("numpy", "dtype"): _Dtype,
            ("_codecs", "encode"): self._encode,
        }
        if (module, name) not in names:
            raise _UnsafeError(f"holds a pickle that names {f'{module}.{name}'[:80]!a}, {_REFUSED}")
        return names[module, name]

    def _encode(self, text: str, encoding: str) -> bytes:  # how Python 3 writes bytes that Python 2 can read
        if encoding != "latin1":
            raise ValueError("not the bytes of an array")
        self._budget.spend(len(text))
        return text.encode("latin1")


class _Budget:
    """How many numbers may still be made.

    A pickle may refer to one value many times, so that a small file becomes a huge array. In a sound file every number
    takes at least a byte. So more numbers than there are bytes raise a `ValueError`.
    """

    def __init__(self, left: int) -> None:
        self._left = left

    def spend(self, amount: int) -> None:
        self._left -= amount
        if self._left < 0:
            raise ValueError("more values than bytes")

    def ragged(self, values: list[Any]) -> np.ndarray:
        """[E] of object dtype: each trajectory's value as a numeric array."""
        result = np.empty(len(values), object)
        for i, value in enumerate(values):
            result[i] = self.numeric(value)
        return result

    def numeric(self, value: Any) -> np.ndarray:
        """A trajectory's value: an array, a number, a list of numbers, or a list of rows."""
        if isinstance(value, _Array):
            return self.array(value)
        if not isinstance(value, list | tuple):
            return self.numbers([value]).reshape(())
        if not any(isinstance(row, _Array | list | tuple) for row in value):
            return self.numbers(value)
        self.spend(len(value))
        return np.stack([self.array(row) if isinstance(row, _Array) else self.numbers(row) for row in value])

    def array(self, array: _Array) -> np.ndarray:
        """An array that the pickle holds, boxed numbers unboxed."""
        if isinstance(array.values, np.ndarray):
            self.spend(array.values.size)
            return array.values
        return self.numbers(array.values).reshape(array.shape)

    def numbers(self, values: Any) -> np.ndarray:
        """Plain numbers, as float64."""
        self.spend(1 + len(values))
        if any(type(value) not in (bool, int, float) for value in values):
            raise TypeError("not a number")
        return np.array(values, np.float64)
