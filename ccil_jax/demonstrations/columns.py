"""Arrays as files hold them, turned into what is meant where no doubt is possible: the same for every format.

One number a step comes as [N] or as [N, 1]; numbers come as booleans or integers too, and flags as the numbers 0 and 1.
Nothing is broadcast or guessed: what could mean two things raises `ArchiveError`. `where` begins its message, which
goes on with what was found and what must be there.
"""

from collections.abc import Sequence

import numpy as np

from ccil_jax.demonstrations.npz import ArchiveError

_MAX_INDEX = 2**53  # beyond it, floats leave out whole numbers


def numbers(array: np.ndarray, where: str) -> np.ndarray:
    """The array itself, if it holds booleans, integers or real numbers."""
    if array.dtype.kind not in "biuf":
        raise ArchiveError(
            f"{where} has dtype {str(array.dtype)[:60]}, must be a number; convert it to one and save the file again"
        )
    return array


def per_step(array: np.ndarray, where: str, lengths: Sequence[int] = ()) -> np.ndarray:
    """[N] from [N] or [N, 1]; N must be one of `lengths`, if there are any."""
    numbers(array, where)
    if array.ndim == 0 or array.size != len(array) or (lengths and len(array) not in lengths):
        wanted = " or ".join(f"({length},)" for length in lengths or array.shape[:1])
        raise ArchiveError(
            f"{where} has shape {array.shape}, must have {f'shape {wanted}' if wanted else 'one axis'}: one value for "
            "each row; reshape it and save the file again"
        )
    return array.reshape(-1)


def rows(array: np.ndarray, where: str, length: int | None = None) -> np.ndarray:
    """[N, k] from [N, k], from [N], where k is 1, and from an array with further axes of size 1; N is `length`."""
    numbers(array, where)
    width = [size for size in array.shape[1:] if size != 1]
    if array.ndim == 0 or len(width) > 1 or length not in (None, len(array)):
        raise ArchiveError(
            f"{where} has shape {array.shape}, must have shape ({length or 'rows'}, columns); reshape it and save the "
            "file again"
        )
    if width == [0]:
        raise ArchiveError(f"{where} has no columns (shape {array.shape}); record it again")
    return array.reshape(len(array), *(width or [1]))


def flags(array: np.ndarray, where: str, lengths: Sequence[int] = ()) -> np.ndarray:
    """[N] booleans, also from the numbers 0 and 1."""
    column = per_step(array, where, lengths)
    odd = (column != 0) & (column != 1)
    if odd.any():
        row = int(np.argmax(odd))
        raise ArchiveError(f"{where} holds {column[row]} (row {row}), must hold flags: true and false, or 1 and 0")
    return column.astype(np.bool_)


def indices(array: np.ndarray, where: str) -> np.ndarray:
    """[N] of int64, also from floats that are whole numbers."""
    column = per_step(array, where)
    if column.dtype.kind == "b":
        raise ArchiveError(f"{where} has dtype bool, must be an integer; give the index one past each episode's end")
    if column.dtype.kind == "f":
        whole = (np.abs(column) < _MAX_INDEX) & (column == np.floor(column))
        if not whole.all():
            row = int(np.argmin(whole))
            raise ArchiveError(f"{where} holds {column[row]} (entry {row}), must hold integers; correct it")
    return column.astype(np.int64)
