"""Configurations that earlier versions wrote. Importing this module imports no JAX.

A field that such a configuration lacks is newer than it, and has its default: what earlier versions did is the default
of a new field. A field that this version lacks matters only to the methods that read it.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ccil_jax.methods import Method


class Gone(NamedTuple):
    """A field of earlier versions that `Config` no longer has."""

    read_by: Callable[[Method], bool]  # whether the method of a row read it
    instead: str  # the field of `Config` that took its place
    now: str  # what holds instead; a sentence without a full stop


GONE: Mapping[str, Gone] = {
    "bc_epochs": Gone(
        lambda row: row.agent == "behavior_cloning",
        "cloning_updates",
        "bc now counts gradient steps (cloning_updates), no longer passes over the demonstrations",
    )
}


def without_unread(fields: Mapping[str, Any], row: Method) -> dict[str, Any]:
    """The fields of a configuration, by name, without those in `GONE` that the method of `row` did not read."""
    return {name: value for name, value in fields.items() if name not in GONE or GONE[name].read_by(row)}


def refusal(name: str, value: Any) -> str:
    """Why this version does not go on with a training that was written with a field in `GONE`, and what to do."""
    return (
        f"written with {name} {value} by an earlier version: {GONE[name].now}; continue with the version that wrote "
        "it, or begin a new run in another folder"
    )
