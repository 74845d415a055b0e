"""Checks of the options that `envs.make` hands to a task. Imports no JAX."""

import math
import operator
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

COMMON = ("physics", "max_episode_steps", "num_threads")  # every built-in task has these; others where they say so


def check_count(what: str, value: Any) -> None:
    """Refuses with a `ValueError` what is not a whole number from 1 to 2^31 - 1, the largest that JAX counts to."""
    try:
        sound = not isinstance(value, bool) and 1 <= operator.index(value) < 2**31
    except TypeError:
        sound = False
    if not sound:
        raise ValueError(f"{what} {value!r}: must be a whole number from 1 to 2147483647")


def _check_threads(what: str, value: Any) -> None:
    if value is not None:
        check_count(what, value)


def _check_threshold(what: str, value: Any) -> None:
    try:
        sound = value is None or (not isinstance(value, bool | str) and 0 <= float(value) < math.inf)
    except TypeError:
        sound = False
    if not sound:
        raise ValueError(f"{what} {value!r}: must be a finite number that is not negative, or None for the task's own")


def _check_switch(what: str, value: Any) -> None:
    if not isinstance(value, bool):
        raise ValueError(f"{what} {value!r}: must be True or False")


# The check of each option by its name. Registered tasks may have other options, which they check themselves.
CHECKS: Mapping[str, Callable[[str, Any], None]] = MappingProxyType(
    {
        "max_episode_steps": check_count,
        "num_threads": _check_threads,
        "cost_threshold": _check_threshold,
        "contact_cost": _check_switch,
    }
)
