"""The table of tasks. Imports no JAX, no engine: launchers read it to answer `--help` and to reject wrong names."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

PHYSICS = ("auto", "native", "mjx", "warp")


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskInfo:
    """What is known of a task without building it."""

    name: str
    family: str  # "locomotion": which module builds it
    obs_dim: int
    action_dim: int
    cost_threshold: float  # the 0/1 cost is 1 where the task's quantity exceeds it
    cost_limit: float  # default episode cost allowed to the expert that records demonstrations
    gymnasium_id: str  # the original that the task is compared with
    cost: str  # the quantity behind the cost, in words


def _locomotion(
    name: str, dims: tuple[int, int], cost_threshold: float, cost_limit: float, cost: str
) -> tuple[str, TaskInfo]:
    return name, TaskInfo(
        name=name,
        family="locomotion",
        obs_dim=dims[0],
        action_dim=dims[1],
        cost_threshold=cost_threshold,
        cost_limit=cost_limit,
        gymnasium_id=f"{name}-v5",
        cost=cost,
    )


TASKS: Mapping[str, TaskInfo] = MappingProxyType(
    dict(
        (
            _locomotion("Swimmer", (8, 2), 1.0, 300.0, "planar speed of the head, m/s"),
            _locomotion("HalfCheetah", (17, 6), 0.2, 300.0, "0.1 * sum of squared actions"),
            _locomotion("Hopper", (11, 3), 1.0, 200.0, "sum of squared actions"),
            _locomotion("Walker2d", (17, 6), 1.0, 300.0, "absolute forward speed, m/s"),
            _locomotion("Ant", (27, 8), 2.0, 300.0, "0.5 * sum of squared actions + contact cost"),
            _locomotion("Humanoid", (270, 17), 0.2, 40.0, "0.1 * sum of squared actions + contact cost"),
        )
    )
)
