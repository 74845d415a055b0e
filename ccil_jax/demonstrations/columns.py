"""Arrays from files, brought into the form that demonstrations have. All formats share these functions.

Files differ in how they store the same thing: one number for each step may be [N] or [N, 1], numbers may be booleans or
integers, and flags may be the numbers 0 and 1. Each of these has one meaning and is accepted. What could mean two
things is refused with an `ArchiveError`; nothing is broadcast or guessed. The argument `where` names the file and the
array at the beginning of the message, which goes on with what was found and what must be there.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ccil_jax.demonstrations.npz import ArchiveError

_MAX_INDEX = 2**53  # floating-point numbers beyond it cannot represent every integer


def numbers(array: np.ndarray, where: str) -> np.ndarray:
    """The array itself, if it holds booleans, integers or real numbers; anything else is refused."""
    if array.dtype.kind not in "biuf":
        raise ArchiveError(
            f"{where} has dtype {str(array.dtype)[:60]}, must be a number; convert it to one and save the file again"
        )
    return array


def per_step(array: np.ndarray, where: str, lengths: Sequence[int] = ()) -> np.ndarray:
    """One number for each step: [N] from [N] or [N, 1]. N must be one of `lengths`, unless that is empty."""
    numbers(array, where)
    if array.ndim == 0 or array.size != len(array) or (lengths and len(array) not in lengths):
        wanted = " or ".join(f"({length},)" for length in lengths or array.shape[:1])
        raise ArchiveError(
            f"{where} has shape {array.shape}, must have {f'shape {wanted}' if wanted else 'one axis'}: one value for "
            "each row; reshape it and save the file again"
        )
    return array.reshape(-1)


def rows(array: np.ndarray, where: str, length: int | None = None) -> np.ndarray:
    """One row for each step: [N, k] from [N, k], from [N] (then k is 1), and from arrays with further axes of size 1.

    N must be `length`, unless that is None.
    """
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
    """One flag for each step: booleans [N], also from the numbers 0 and 1."""
    column = per_step(array, where, lengths)
    odd = (column != 0) & (column != 1)
    if odd.any():
        row = int(np.argmax(odd))
        raise ArchiveError(f"{where} holds {column[row]} (row {row}), must hold flags: true and false, or 1 and 0")
    return column.astype(np.bool_)


def indices(array: np.ndarray, where: str) -> np.ndarray:
    """Integers: int64 [N], also from floating-point numbers that are whole."""
    column = per_step(array, where)
    if column.dtype.kind == "b":
        raise ArchiveError(f"{where} has dtype bool, must be an integer; give the index one past each episode's end")
    if column.dtype.kind == "f":
        whole = (np.abs(column) < _MAX_INDEX) & (column == np.floor(column))
        if not whole.all():
            row = int(np.argmin(whole))
            raise ArchiveError(f"{where} holds {column[row]} (entry {row}), must hold integers; correct it")
    return column.astype(np.int64)


FORMS: Mapping[str, Callable[[np.ndarray, str], np.ndarray]] = {  # the form of each array of demonstrations
    "obs": rows,
    "actions": rows,
    "rewards": per_step,
    "costs": per_step,
    "terminated": flags,
    "truncated": flags,
    "episode_ends": indices,
    "final_obs": rows,
}
OPTIONAL = frozenset({"rewards", "final_obs"})  # those that demonstrations may lack


def joined(parts: Sequence[np.ndarray], where: Callable[[int], str]) -> np.ndarray:
    """The arrays of all trajectories, one after the other. `where(i)` names that of trajectory i in a message."""
    for i, part in enumerate(parts):
        if part.shape[1:] != parts[0].shape[1:]:
            raise ArchiveError(
                f"{where(i)} has shape {part.shape}, trajectory 0 has {parts[0].shape}; only their lengths may differ"
            )
    return np.concatenate(parts) if parts else np.zeros(0)


def contradiction(first: str, second: str) -> ArchiveError:
    """The error for a file with two different arrays of costs."""
    return ArchiveError(
        f"{first} and '{second}' hold different costs of the same steps; remove the one that is not the task's cost"
    )
