"""The table of tasks: the built-in ones, those that `register` adds, and those that a text names.

Imports neither JAX nor an engine: command lines read it to answer `--help` and to refuse wrong names at once.
"""

import dataclasses
import functools
import inspect
import re
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from envs.engines import PHYSICS
from envs.lookup import hint, named_object, own_object, parts
from envs.options import COMMON
from envs.task_info import MAX_EPISODE_STEPS, TaskInfo

__all__ = ["PHYSICS", "TASKS", "TaskInfo", "find_task", "register"]


def _build(target: str, name: str, **options: Any) -> Any:
    return own_object(target)(name, **options)


def _locomotion(
    name: str,
    dims: tuple[int, int],
    cost_threshold: float,
    cost_limit: float,
    quantity: str,
    *,
    contact: bool = False,
    reward_lacks: str = "",
) -> TaskInfo:
    """A row; `contact` says that the cost counts contacts, so that there is a choice to leave them out."""
    return TaskInfo(
        name=name,
        build=functools.partial(_build, "envs.locomotion:make", name),
        family="locomotion",
        obs_dim=dims[0],
        action_dim=dims[1],
        options=MappingProxyType({"cost_threshold": cost_threshold, **({"contact_cost": True} if contact else {})}),
        cost_limit=cost_limit,
        cost=f"{quantity} > {cost_threshold:g}",
        original=f"{name}-v5",
        original_package="gymnasium",
        reward_lacks=reward_lacks,
        original_options=MappingProxyType({"include_cfrc_ext_in_observation": False} if contact else {}),
    )


_CONTROL, _BOTH = "the control cost", "the control cost and the contact cost"
_HAZARD = "the robot's centre is over a hazard"
_BUTTON = f"{_HAZARD}, it touches a wrong button or a gremlin"


def _safety_gym(name: str, dims: tuple[int, int], cost: str) -> TaskInfo:
    return TaskInfo(
        name=name,
        build=functools.partial(_build, "envs.safety_gym.environment:SafetyGym", name),
        family="safety_gym",
        obs_dim=dims[0],
        action_dim=dims[1],
        cost_limit=25.0,  # of the published results on these tasks (Ray et al. 2019)
        cost=cost,
        expert_preset="safety_gym_expert",
        original=f"Safety{name}-v0",
        original_package="safety_gymnasium",
    )


_ROWS = (
    _locomotion("Swimmer", (8, 2), 1.0, 300.0, "planar speed of the head, m/s"),
    _locomotion("HalfCheetah", (17, 6), 0.2, 300.0, "0.1 * sum of squared actions", reward_lacks=_CONTROL),
    _locomotion("Hopper", (11, 3), 1.0, 200.0, "sum of squared actions", reward_lacks=_CONTROL),
    _locomotion("Walker2d", (17, 6), 1.0, 300.0, "absolute forward speed, m/s"),
    _locomotion(
        "Ant", (27, 8), 2.0, 300.0, "0.5 * sum of squared actions + contact cost", contact=True, reward_lacks=_BOTH
    ),
    _locomotion(
        "Humanoid",
        (270, 17),
        0.2,
        200.0,
        "0.1 * sum of squared actions + contact cost",
        contact=True,
        reward_lacks=_BOTH,
    ),
    _safety_gym("PointGoal1", (60, 2), _HAZARD),
    _safety_gym("PointButton1", (76, 2), _BUTTON),
    _safety_gym("PointPush1", (76, 2), _HAZARD),
    _safety_gym("CarGoal1", (72, 2), _HAZARD),
    _safety_gym("CarButton1", (88, 2), _BUTTON),
    _safety_gym("CarPush1", (88, 2), _HAZARD),
    _safety_gym("DoggoGoal1", (104, 12), _HAZARD),
    _safety_gym("DoggoButton1", (120, 12), _BUTTON),
)
_tasks = {task.name: task for task in _ROWS}  # the registry; `register` alone changes it
TASKS: Mapping[str, TaskInfo] = MappingProxyType(_tasks)  # a view that nobody can write to


def register(
    name: str,
    build: Callable[..., Any] | str,
    *,
    options: Mapping[str, Any] | None = None,
    obs_dim: int | None = None,
    action_dim: int | None = None,
    cost_limit: float | None = None,
    cost: str = "",
    expert_preset: str = "expert",
    original: str | None = None,
) -> TaskInfo:
    """Adds a task to `TASKS`, so that `envs.make(name)` builds it.

    Args:
        name: of letters, digits, "_", "." and "-".
        build: called with the task's options by keyword; returns an `Environment`. Or a text, "module:attribute",
            which names such a callable and is looked up when the task is built.
        options: names of the task's own options and the values that they have by default. By default these are the
            parameters of `build`. A text is not looked up yet, so there they have to be said; of the options that
            all built-in tasks have (`physics`, `max_episode_steps`, `num_threads`) it has to take every one.
        obs_dim: length of an observation, if it is known beforehand.
        action_dim: length of an action, if it is known beforehand.
        cost_limit: default episode cost that is allowed to an expert which records demonstrations.
        cost: what costs how much in a step, in words.
        expert_preset: key of `ccil_jax.presets.PRESETS`, the hyperparameters that an expert starts from.
        original: the environment that the task is compared with.

    Returns:
        The task's entry.

    Raises:
        ValueError: the name is taken or has other characters, or a parameter of `build` lacks a default value.
    """
    if not re.fullmatch(r"[\w.-]+", name):
        raise ValueError(f"{name!r}: the name of a task is of letters, digits, '_', '.' and '-'; choose such a name")
    if name in _tasks:
        raise ValueError(f"{name}: a task of this name is registered already; choose another name")
    task = TaskInfo(
        name=name,
        build=build,
        obs_dim=obs_dim,
        action_dim=action_dim,
        cost_limit=cost_limit,
        cost=cost,
        expert_preset=expert_preset,
        original=original,
    )
    if isinstance(build, str):
        parts(build)  # is it of the right form?
    else:
        task = _with_signature(task)
    _tasks[name] = task if options is None else dataclasses.replace(task, options=MappingProxyType(dict(options)))
    return _tasks[name]


def _with_signature(task: TaskInfo) -> TaskInfo:
    """`task` with the options that the signature of its `build` shows. Raises `ValueError` where one has no default."""
    if not callable(task.build):
        raise ValueError(
            f"{task.name}: what builds a task must be a function or a class, not {type(task.build).__name__}; "
            "give one that returns an envs.Environment"
        )
    options: dict[str, Any] = {}
    common: dict[str, Any] = {}
    for parameter in inspect.signature(task.build).parameters.values():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        always_given = parameter.name in ("physics", "max_episode_steps")
        lacks_default = parameter.default is parameter.empty and not always_given
        if lacks_default or parameter.kind is parameter.POSITIONAL_ONLY:
            raise ValueError(
                f"{task.name}: parameter {parameter.name!r} of what builds the task must have a default value and be "
                "given by keyword; change its signature"
            )
        (common if parameter.name in COMMON else options)[parameter.name] = parameter.default
    limit = common.get("max_episode_steps")
    if limit is inspect.Parameter.empty:
        limit = MAX_EPISODE_STEPS
    return dataclasses.replace(
        task, options=MappingProxyType(options), common=frozenset(common), max_episode_steps=limit
    )


def find_task(name: Any) -> TaskInfo:
    """The description of a task.

    Args:
        name: a key of `TASKS`; or "module:attribute", a function or class that returns an `Environment` and whose
            parameters are the task's options. Its module is imported, from the current folder too.

    Raises:
        ValueError: there is no such task. The message names the one that was probably meant; to find it, upper and
            lower case are taken for the same, as are the names of the environments that the tasks are compared with.
    """
    if isinstance(name, str) and name in _tasks:
        return _tasks[name]
    if isinstance(name, str) and ":" in name:
        return _with_signature(TaskInfo(name=name, build=named_object(name)))
    spellings = {
        spelling.casefold(): task.name for task in _tasks.values() for spelling in (task.name, task.original or "")
    }
    raise ValueError(
        f"{name}: unknown task; {hint(str(name), spellings=spellings)}choose one of {', '.join(_tasks)}, "
        "or module:function for a task of your own"
    )
