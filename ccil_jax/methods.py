"""The methods, one row each: who learns, where the reward comes from, how the cost enters, and whose limit holds.

Importing this module imports no JAX. A part of a row is a key of the table that holds the functions (`agents.build`,
`acting.networks`, `learning.reward_models`, `learning.constraints`), or a function of the user's own with the same
arguments as the functions there (without the policy, for a reward).
"""

import functools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeVar

from ccil_jax import user_code
from ccil_jax.errors import ConfigError
from ccil_jax.presets import PRESETS
from envs.lookup import hint, named_object

Part = str | Callable[..., Any]
Maker = TypeVar("Maker", bound=Callable[..., Any])


class Method(NamedTuple):
    """One row of the table. A part is None where the method has none."""

    agent: Part = "on_policy"
    reward: Part | None = None
    constraint: Part | None = None
    limit: Literal["demonstrations", "prescribed"] | None = None  # the first is J_E, the demonstrations' mean cost
    policy: Part = "gaussian"
    imitates: bool = True  # whether the method learns from demonstrations
    has_multiplier: bool = False  # whether a Lagrange multiplier is carried from one iteration to the next
    preset: str = "default"  # the hyperparameters that a launcher starts from, a key of `presets.PRESETS`
    reads: tuple[str, ...] = ()  # fields of `Config` that parts of the user's own read


_methods: dict[str, Method] = {  # only `register_method` and `find_method` add to it
    "malm": Method(reward="discriminator", constraint="meta_lagrangian", limit="demonstrations", has_multiplier=True),
    "cvag": Method(reward="discriminator", constraint="alternating", limit="demonstrations"),
    "ccil": Method(reward="discriminator", constraint="lagrangian", limit="demonstrations", has_multiplier=True),
    "lgail": Method(reward="discriminator", constraint="lagrangian", limit="prescribed", has_multiplier=True),
    "gail": Method(reward="discriminator", constraint="unconstrained"),
    "cpo_il": Method(reward="discriminator", constraint="trust_region_optimal", limit="demonstrations"),
    "pid_il": Method(reward="discriminator", constraint="pid", limit="demonstrations", has_multiplier=True),
    "bc": Method(agent="behavior_cloning", preset="bc"),
    "iq_learn": Method(agent="iq_learn", policy="squashed", preset="iq_learn"),
    "trpo": Method(reward="task", constraint="unconstrained", imitates=False),
    "expert": Method(reward="task", constraint="lagrangian", limit="prescribed", imitates=False, has_multiplier=True),
}
METHODS: Mapping[str, Method] = MappingProxyType(_methods)
_BUILT_IN = tuple(_methods.values())


def register_method(name: str, method: Method) -> None:
    """Adds a row to `METHODS`, so that `Config(method=name)` means it.

    For the launchers, which do not know the module that calls this function, write the row as a variable of a module
    and give `--method package.module:VARIABLE`; it needs no registration.

    Args:
        name: of the method, as in `Config.method`.
        method: the row.

    Raises:
        ConfigError: the name is taken or is no identifier, or the row's parts do not go together.
    """
    if not name.isidentifier():
        raise ConfigError(f"method {name!r}: not an identifier; use letters, digits and underscores")
    if name in _methods:
        raise ConfigError(f"method {name}: is registered already; choose another name")
    _methods[name] = _checked(name, method)


def find_method(name: Any) -> Method:
    """The row of a method.

    Args:
        name: a key of `METHODS`; or "module:VARIABLE", a row in a module of the user's own, which is imported.

    Raises:
        ConfigError: there is no such row.
    """
    if isinstance(name, str) and name in _methods:
        return _methods[name]
    if not isinstance(name, str) or ":" not in name:
        near = hint(name, _methods) if isinstance(name, str) else ""
        raise ConfigError(f"--method {name!r}: unknown; {near}choose one of {', '.join(_methods)}")
    try:
        method = named_object(name)
    except ValueError as error:
        raise ConfigError(f"--method {error}") from None
    _methods[name] = _checked(name, method)
    return _methods[name]


def _checked(name: str, method: Any) -> Method:
    """The row. Raises `ConfigError` for parts that are unknown or do not go together.

    Importing the tables of functions would import JAX. Their names are known from the package's own rows, which use
    every one of them.
    """
    if not isinstance(method, Method):
        raise ConfigError(f"--method {name}: is of type {type(method).__name__}; name a ccil_jax.Method")
    for column in ("agent", "reward", "constraint", "policy"):
        part = getattr(method, column)
        if isinstance(part, str):
            names: dict[str, Any] = {known: None for row in _BUILT_IN if (known := getattr(row, column)) is not None}
            function_of(part, names, f"--method {name}: {column}")
    if complaint := _mismatch(method):
        raise ConfigError(f"--method {name}: {complaint}")
    return method


def _mismatch(method: Method) -> str | None:
    """What does not go together in a row whose names are known; None if all does."""
    of_agent = [row for row in _BUILT_IN if row.agent == method.agent]  # none where the agent is the user's own
    if method.limit not in (None, "demonstrations", "prescribed"):
        return f"limit {method.limit!r}: give 'demonstrations', 'prescribed' or None"
    if method.limit == "demonstrations" and not method.imitates:
        return "has no demonstrations to take its limit from; let limit be 'prescribed'"
    if method.preset not in PRESETS:
        return f"preset {method.preset!r}: unknown; choose one of {', '.join(PRESETS)}"
    if of_agent and isinstance(method.policy, str) and method.policy not in {row.policy for row in of_agent}:
        return f"agent {method.agent} has no {method.policy} policy; give {of_agent[0].policy!r} or your own"
    if not method.imitates and (method.reward == "discriminator" or (of_agent and method.agent != "on_policy")):
        return "learns from demonstrations; let imitates be True"
    if method.agent == "on_policy":
        return _mismatch_on_policy(method)
    if of_agent and (idle := [part for part in ("reward", "constraint", "limit") if getattr(method, part) is not None]):
        return f"{idle[0]} makes no difference to agent {method.agent}; leave it out"
    return None


def _mismatch_on_policy(method: Method) -> str | None:
    if method.reward is None or method.constraint is None:
        return "an on-policy method needs a reward and a constraint; name both"
    if method.constraint != "unconstrained" and method.limit is None:
        return "its constraint needs a limit; let limit be 'demonstrations' or 'prescribed'"
    multiplier = {row.constraint: row.has_multiplier for row in _BUILT_IN}
    if method.has_multiplier is not multiplier.get(method.constraint, method.has_multiplier):
        return f"constraint {method.constraint}: let has_multiplier be {not method.has_multiplier}"
    return None


def function_of(part: Part, table: Mapping[str, Maker], what: str) -> Maker | Callable[..., Any]:
    """The function of a part of a row: the table's, or the user's own.

    Raises:
        ConfigError: the table has no such name.
    """
    if callable(part):
        return functools.partial(user_code.call, what, part)
    if part not in table:
        raise ConfigError(f"{what} {part!r}: unknown; {hint(part, table)}choose one of {', '.join(table)}")
    return table[part]
