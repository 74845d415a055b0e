"""The table of tasks. Imports no JAX, no engine: launchers read it to answer `--help` and to reject wrong names."""

import dataclasses
from collections.abc import Mapping
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


def _locomotion(name: str, dims: tuple[int, int], cost_threshold: float, cost_limit: float, quantity: str) -> TaskInfo:
    return TaskInfo(
        name=name,
        family="locomotion",
        obs_dim=dims[0],
        action_dim=dims[1],
        options=MappingProxyType({"cost_threshold": cost_threshold, "contact_cost": True}),
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
    _locomotion("Ant", (27, 8), 2.0, 300.0, "0.5 * sum of squared actions + contact cost"),
    _locomotion("Humanoid", (270, 17), 0.2, 40.0, "0.1 * sum of squared actions + contact cost"),
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
