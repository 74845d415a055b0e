"""Cost-constrained control tasks as pure functions. `make` builds one, `TASKS` lists them, `register` adds one.

Importing this package imports neither JAX nor an engine nor gymnasium: launchers answer `--help` at once. Names that
need them are imported when they are first used (PEP 562).
"""

import importlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Never

from envs.gymnasium_tasks import register_once_imported, register_with_gymnasium
from envs.registry import PHYSICS, TASKS, TaskInfo, find_task, register

if TYPE_CHECKING:
    from envs.adapters.brax_env import FromBrax, to_brax
    from envs.adapters.gymnasium_env import GymnasiumEnv, GymnasiumVectorEnv
    from envs.base import Environment, State
    from envs.costs import with_cost

__all__ = [
    "PHYSICS",
    "TASKS",
    "Environment",
    "FromBrax",
    "GymnasiumEnv",
    "GymnasiumVectorEnv",
    "State",
    "TaskInfo",
    "find_task",
    "make",
    "register",
    "register_with_gymnasium",
    "to_brax",
    "with_cost",
]

_LAZY = {
    "Environment": "envs.base",
    "State": "envs.base",
    "FromBrax": "envs.adapters.brax_env",
    "to_brax": "envs.adapters.brax_env",
    "GymnasiumEnv": "envs.adapters.gymnasium_env",
    "GymnasiumVectorEnv": "envs.adapters.gymnasium_env",
    "with_cost": "envs.costs",
}
_NOTHING: Mapping[str, Any] = MappingProxyType({})


def make(
    name: str,
    physics: str = "auto",
    *,
    max_episode_steps: int | None = None,
    num_threads: int | None = None,
    cost_threshold: float | None = None,
    contact_cost: bool | None = None,
    options: Mapping[str, Any] = _NOTHING,
    **others: Never,
) -> "Environment":
    """Builds a task. An argument that is None is left to the task.

    Args:
        name: a key of `TASKS`; or "module:attribute", for example "my_package.tasks:make", a function or class that
            returns an `Environment`. Its parameters, each with a default value, are the task's options.
        physics: "native" (C MuJoCo on threads), "mjx" (MJX-JAX), "warp" (MJX-Warp) or "auto": native where JAX runs
            on a CPU; on an accelerator warp, where it can run, else mjx.
        max_episode_steps: control steps after which an episode is truncated.
        num_threads: of the native engine. By default the usable CPUs are shared among JAX's local devices.
        cost_threshold: locomotion tasks cost 1 in a step where their quantity exceeds it, else 0 (`TaskInfo.cost`).
        contact_cost: whether contacts count in that quantity (Ant, Humanoid).
        options: further options by name, as a registered task may have them (`TaskInfo.options`).
        **others: at run time the same as `options`. For a type checker there are none, so that it reports a wrong
            keyword as an error.

    Returns:
        The environment: `reset(key)` and `step(state, action)` of a single simulation, to be vmapped.

    Raises:
        ValueError: the task, the physics or an option is unknown, has no effect, or cannot have the value given.
        ImportError: "warp" without the extra `mujoco-mjx[warp]`.
    """
    usual = {
        "max_episode_steps": max_episode_steps,
        "num_threads": num_threads,
        "cost_threshold": cost_threshold,
        "contact_cost": contact_cost,
    }
    given = {key: value for key, value in usual.items() if value is not None}
    if twice := [key for key in options if key in given or key in others]:
        raise ValueError(f"{name}: option {twice[0]!r} is given twice; give it by keyword or in `options`")
    environment: Environment = find_task(name).make(physics, {**given, **options, **others})
    return environment


if not TYPE_CHECKING:  # a type checker knows all names, and should report others

    def __getattr__(name: str) -> Any:
        if name in _LAZY:
            return getattr(importlib.import_module(_LAZY[name]), name)
        raise AttributeError(f"module 'envs' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_once_imported()
