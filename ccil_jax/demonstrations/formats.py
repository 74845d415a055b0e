"""The table of the formats that demonstrations can be read from and written to. Formats to read can be added to it.

| Format | Content | An episode ends |
|---|---|---|
| baselines, CCIL | `.npz` with `obs`, `acs`, `rews`, and `accucost` or `costs` of each step | with its array |
| DSRL | HDF5 with `observations, actions, rewards, costs, terminals, timeouts` | where either flag is set |
| Minari | a folder with `data/main_data.hdf5`, one group `episode_N` each; cost in `infos/cost` | with its group |
| our own | `.npz`, see `own` | where `episode_ends` says so |

What is read is recognised by its content, and what is written by its name. Nothing in a file is trusted: the readers of
this table run no code from it and bound how much they read, and `load_demonstrations` checks all values that a reader
returns.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ccil_jax.demonstrations import baselines, columns, dsrl, hdf5, minari, minari_datasets, npz, own
from ccil_jax.errors import DemonstrationsError, UserError
from envs.lookup import named_object

_OPTIONAL = columns.OPTIONAL | {"costs", "metadata"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Format:
    """A format of demonstrations: how a file or folder of it is recognised, and how it is read.

    `read` returns a mapping with the arrays of `Demonstrations` by name: `obs`, `actions`, `terminated`, `truncated`
    and `episode_ends`, and where the file has them `rewards`, `costs`, `final_obs` and `metadata` (a JSON object).
    Episodes lie one after the other. Arrays may have other types of numbers than `Demonstrations`, and [N, 1] in the
    place of [N].
    """

    name: str
    recognizes: Callable[[Path], bool]  # is called with every path to be read, so it should look at little of it
    read: Callable[[Path], Mapping[str, Any]]
    costs: str = ""  # where a file has its costs: stands in the message about a file without costs


def _read_hdf5(path: Path) -> dict[str, Any]:
    found = hdf5.read(path)
    return minari.arrays_of(found, path) if minari.holds_episodes(found) else dsrl.arrays_of(found, path)


FORMATS: list[Format] = [  # in the order in which they are asked whether they recognise a file
    Format(
        name="baselines",
        recognizes=baselines.recognizes,
        read=baselines.read,
        costs="'accucost', or 'costs' of each step",
    ),
    Format(
        name="hdf5",  # of DSRL, or a file out of a dataset of Minari
        recognizes=lambda path: npz.starts_with(path, hdf5.SIGNATURE),
        read=_read_hdf5,
        costs="'costs' in DSRL, 'infos/cost' in Minari",
    ),
    Format(name="minari", recognizes=minari.recognizes, read=minari.read, costs="'infos/cost'"),
    # Every file that no other format recognises is read as one of our own: that reader says what is wrong with it.
    Format(name="ccil_jax", recognizes=lambda path: True, read=own.read),
]


def register_format(new: Format) -> None:
    """Adds a format, so that `load_demonstrations` and the launchers recognise and read its files.

    It is asked before all formats that are in the table already, so also before the package's own.

    Raises:
        UserError: this is no `Format`, or one with the same name is in the table.
    """
    checked = _checked_format(new, "register_format")
    if checked.name in {known.name for known in FORMATS}:
        raise UserError(f"format {checked.name!r}: registered already; choose another name")
    FORMATS.insert(0, checked)


def named(text: str) -> Format:
    """The `Format` that "module:attribute" names. The module is imported; the format need not be registered.

    Raises:
        UserError: there is no such object, or it is no `Format`.
    """
    try:
        found = named_object(text)
    except ValueError as error:
        raise UserError(str(error)) from error
    return _checked_format(found, text)


def _checked_format(found: object, where: str) -> Format:
    if not isinstance(found, Format):
        raise UserError(f"{where}: {type(found).__name__} is no ccil_jax.Format; give one")
    if not found.name:
        raise UserError(f"{where}: the format has no name; give it one")
    return found


def format_of(path: Path) -> Format:
    """The first format of the table that recognises `path`. Raises `DemonstrationsError` where its function fails."""
    return next(known for known in FORMATS if _call(known, known.recognizes, path))


def read(path: Path, file_format: Format) -> dict[str, Any]:
    """What the reader of `file_format` returns, with None for arrays that may be missing and are.

    The values are not checked yet.

    Raises:
        DemonstrationsError: the reader refuses the file or fails, or returns something else than arrays by name.
    """
    arrays = _call(file_format, file_format.read, path)
    if not isinstance(arrays, Mapping):
        raise DemonstrationsError(
            f"{path}: the reader of format {file_format.name} returned {type(arrays).__name__}; it must return the "
            "arrays by name"
        )
    known = {*columns.FORMS, "metadata"}
    for names, complaint in ((known - _OPTIONAL - set(arrays), "no"), (set(arrays) - known, "the unknown")):
        if names:
            raise DemonstrationsError(
                f"{path}: the reader of format {file_format.name} returned {complaint} {min(map(repr, names))}; it "
                f"must return {', '.join(sorted(known - _OPTIONAL))}, and may return {', '.join(sorted(_OPTIONAL))}"
            )
    metadata = arrays.get("metadata", {})
    if not isinstance(metadata, Mapping):
        raise DemonstrationsError(
            f"{path}: the reader of format {file_format.name} returned metadata of type {type(metadata).__name__}; "
            "they must be a dict"
        )
    return {**dict.fromkeys(_OPTIONAL), **arrays, "metadata": dict(metadata)}


def _call(file_format: Format, function: Callable[[Path], Any], path: Path) -> Any:
    """`function(path)`. Whatever it raises becomes a `DemonstrationsError`: a damaged file can make any reader fail."""
    try:
        return function(path)
    except UserError as error:
        raise DemonstrationsError(str(error)) from error
    except Exception as error:
        reason = " ".join(str(error).split())
        raise DemonstrationsError(
            f"{path}: format {file_format.name} failed with {type(error).__name__}: {reason}; check the file, or the "
            "functions of the format"
        ) from error


Writer = Callable[[Path, Mapping[str, Any], Mapping[str, Any]], None]  # path, arrays of `Demonstrations`, metadata


def writer_of(path: str | os.PathLike[str]) -> Writer:
    """What writes demonstrations of the name `path`: `*.npz` (ours), `*.hdf5` or `*.h5` (DSRL's), `minari:ID`.

    Raises:
        DemonstrationsError: the name is none of these, or the library that the format needs is missing.
    """
    suffix = Path(path).suffix
    if suffix == ".npz":
        return own.write
    if minari_datasets.is_name(path):
        minari_datasets.folder_of(path)
        hdf5.check_can_write(path)
        return minari_datasets.write
    if suffix in dsrl.SUFFIXES:
        hdf5.check_can_write(path)
        return dsrl.write
    raise DemonstrationsError(
        f"{os.fspath(path)}: a demonstrations file is named *.npz, or *.hdf5 for DSRL's layout; minari:ID makes a "
        "dataset of Minari"
    )
