"""Cost-constrained control tasks as pure functions. `make` builds one, `TASKS` lists them.

Importing this package imports neither JAX nor an engine (PEP 562): launchers answer `--help` at once.
"""

import importlib
from typing import TYPE_CHECKING, Any

from envs.registry import PHYSICS, TASKS, TaskInfo, check_options, find_task

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
        ValueError: unknown task, physics or option, or a value that the option cannot have.
        ImportError: "warp" without the extra `mujoco-mjx[warp]`.
    """
    task = find_task(name)
    check_options(task, physics, options)
    module, builder = _FAMILIES[task.family]
    environment: Environment = getattr(importlib.import_module(module), builder)(name, physics=physics, **options)
    return environment


def __getattr__(name: str) -> Any:
    if name in ("Environment", "State"):
        import envs.base

        return getattr(envs.base, name)
    raise AttributeError(f"module 'envs' has no attribute {name!r}")
