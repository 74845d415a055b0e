"""Cost-constrained control tasks as pure functions. `make` builds one, `TASKS` lists them.

Importing this package imports neither JAX nor an engine (PEP 562): launchers answer `--help` at once.
"""

import importlib
from typing import TYPE_CHECKING, Any

from envs.registry import PHYSICS, TASKS, TaskInfo

if TYPE_CHECKING:
    from envs.base import Environment, State

__all__ = ["PHYSICS", "TASKS", "Environment", "State", "TaskInfo", "make"]

_FAMILIES = {
    "locomotion": ("envs.locomotion", "Locomotion"),
    "safety_gym": ("envs.safety_gym.environment", "SafetyGym"),
}


def make(name: str, physics: str = "auto", **options: Any) -> "Environment":
    """Builds a task.

    Args:
        name: a key of `TASKS`.
        physics: "native" (C MuJoCo on threads), "mjx" (MJX-JAX), "warp" (MJX-Warp) or "auto": native where JAX runs
            on a CPU, mjx on an accelerator.
        **options: `max_episode_steps`, `num_threads`, and the task's own (`TaskInfo.options`).

    Returns:
        The environment: `reset(key)`, `step(state, action)`, single simulation, to be vmapped.

    Raises:
        ValueError: unknown task or physics.
        ImportError: "warp" without the extra `mujoco-mjx[warp]`.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}: choose one of {', '.join(TASKS)}")
    if physics not in PHYSICS:
        raise ValueError(f"unknown physics {physics!r}: choose one of {', '.join(PHYSICS)}")
    module, builder = _FAMILIES[TASKS[name].family]
    environment: Environment = getattr(importlib.import_module(module), builder)(name, physics=physics, **options)
    return environment


def __getattr__(name: str) -> Any:
    if name in ("Environment", "State"):
        import envs.base

        return getattr(envs.base, name)
    raise AttributeError(f"module 'envs' has no attribute {name!r}")
