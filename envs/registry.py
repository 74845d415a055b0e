"""The table of tasks. Imports no JAX, no engine: launchers read it to answer `--help` and to reject wrong names."""

import dataclasses
import difflib
import math
import operator
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

PHYSICS = ("auto", "native", "mjx", "warp")


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskInfo:
    """What is known of a task without building it."""

    name: str
    family: str  # "locomotion" or "safety_gym": which class `envs.make` builds
    obs_dim: int
    action_dim: int
    options: Mapping[str, Any]  # of `envs.make`, this family's own, with the task's defaults
    cost_limit: float  # default episode cost allowed to the expert that records demonstrations
    original: str  # the environment that the task is compared with, in gymnasium or safety-gymnasium
    cost: str  # what costs 1 in a step, in words


def _locomotion(
    name: str, dims: tuple[int, int], cost_threshold: float, cost_limit: float, quantity: str, *, contact: bool = False
) -> TaskInfo:
    """A row; `contact` says that the cost counts contacts, so that there is a choice to leave them out."""
    contact_cost = {"contact_cost": True} if contact else {}
    return TaskInfo(
        name=name,
        family="locomotion",
        obs_dim=dims[0],
        action_dim=dims[1],
        options=MappingProxyType({"cost_threshold": cost_threshold, **contact_cost}),
        cost_limit=cost_limit,
        original=f"{name}-v5",
        cost=f"{quantity} > {cost_threshold:g}",
    )


_HAZARD = "the robot's centre is over a hazard"
_BUTTON = f"{_HAZARD}, it touches a wrong button or a gremlin"


def _safety_gym(name: str, dims: tuple[int, int], cost: str) -> TaskInfo:
    return TaskInfo(
        name=name,
        family="safety_gym",
        obs_dim=dims[0],
        action_dim=dims[1],
        options=MappingProxyType({}),
        cost_limit=25.0,  # of the published results on these tasks (Ray et al. 2019)
        original=f"Safety{name}-v0",
        cost=cost,
    )


_ROWS = (
    _locomotion("Swimmer", (8, 2), 1.0, 300.0, "planar speed of the head, m/s"),
    _locomotion("HalfCheetah", (17, 6), 0.2, 300.0, "0.1 * sum of squared actions"),
    _locomotion("Hopper", (11, 3), 1.0, 200.0, "sum of squared actions"),
    _locomotion("Walker2d", (17, 6), 1.0, 300.0, "absolute forward speed, m/s"),
    _locomotion("Ant", (27, 8), 2.0, 300.0, "0.5 * sum of squared actions + contact cost", contact=True),
    _locomotion("Humanoid", (270, 17), 0.2, 40.0, "0.1 * sum of squared actions + contact cost", contact=True),
    _safety_gym("PointGoal1", (60, 2), _HAZARD),
    _safety_gym("PointButton1", (76, 2), _BUTTON),
    _safety_gym("PointPush1", (76, 2), _HAZARD),
    _safety_gym("CarGoal1", (72, 2), _HAZARD),
    _safety_gym("CarButton1", (88, 2), _BUTTON),
    _safety_gym("CarPush1", (88, 2), _HAZARD),
    _safety_gym("DoggoGoal1", (104, 12), _HAZARD),
    _safety_gym("DoggoButton1", (120, 12), _BUTTON),
)
TASKS: Mapping[str, TaskInfo] = MappingProxyType({task.name: task for task in _ROWS})


def find_task(name: Any) -> TaskInfo:
    """The description of a task.

    Raises:
        ValueError: there is no such task. The message names the one meant, as far as can be told: capitals are
            ignored, and so are prefixes and versions of gymnasium and safety-gymnasium.
    """
    if isinstance(name, str) and name in TASKS:
        return TASKS[name]
    spellings = {spelling.casefold(): task.name for task in _ROWS for spelling in (task.name, task.original)}
    raise ValueError(f"{name}: unknown task; {_hint(str(name), spellings)}choose one of {', '.join(TASKS)}")


def check_options(task: TaskInfo, physics: Any, options: Mapping[str, Any]) -> None:
    """Checks what `envs.make` was given besides the task.

    Raises:
        ValueError: the task has no such option, or not such a value.
    """
    if physics not in PHYSICS:
        near = _hint(str(physics), {name: name for name in PHYSICS})
        raise ValueError(f"{physics}: unknown physics; {near}choose one of {', '.join(PHYSICS)}")
    known = {name: check for name, check in _CHECKS.items() if name in _COMMON_OPTIONS or name in task.options}
    for name, value in options.items():
        if name not in known:
            near = _hint(name, {name: name for name in known})
            raise ValueError(f"{task.name} has no option {name!r}; {near}its options are physics, {', '.join(known)}")
        known[name](f"{task.name}: {name}", value)


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


_COMMON_OPTIONS = ("max_episode_steps", "num_threads")  # of every task
_CHECKS: Mapping[str, Callable[[str, Any], None]] = MappingProxyType(
    {
        "max_episode_steps": check_count,
        "num_threads": _check_threads,
        "cost_threshold": _check_threshold,
        "contact_cost": _check_switch,
    }
)


def _hint(name: str, spellings: Mapping[str, str]) -> str:
    """A question that names what was probably meant, or nothing. Of equally near spellings it takes the first."""
    near = difflib.get_close_matches(name.casefold(), spellings, n=1, cutoff=0.6)
    return f"did you mean {spellings[near[0]]}? " if near else ""
