"""What the tasks reward and what they charge for: named functions of the situation after a control step."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

GOAL_RADIUS = 0.3  # m; the aims "goal" and "push" are met within this distance


@struct.dataclass(kw_only=True)
class Situation:
    """Where everything is after a control step. The goal is that which held during the step. Lengths in metres."""

    robot: jax.Array  # [3]
    objects: dict[str, jax.Array]  # kind -> [count, 3] centres
    sizes: dict[str, float] = struct.field(pytree_node=False)  # kind -> radius
    goal: jax.Array  # [3]
    goal_button: jax.Array  # [] index of the button to press
    timer: jax.Array  # [] control steps during which wrong buttons still cost nothing
    touched: dict[str, jax.Array]  # kind -> [count] bool: in contact with the robot


class Aim(NamedTuple):
    """What a task asks for. The reward of a step is the sum of the decreases of all distances, plus 1 if it is met."""

    distances: Callable[[Situation], dict[str, jax.Array]]  # m, by name, [] each
    met: Callable[[Situation], jax.Array]  # [] bool: whether the goal was reached in this step


def _distance(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(jnp.square(a - b)))


def _on_floor(x: Situation) -> jax.Array:
    return _distance(x.robot[:2], x.goal[:2])


def _box(x: Situation) -> jax.Array:
    return x.objects["push_box"][0]


AIMS = {
    "goal": Aim(
        distances=lambda x: {"goal_distance": _on_floor(x)},
        met=lambda x: _on_floor(x) <= GOAL_RADIUS,
    ),
    "button": Aim(
        distances=lambda x: {"goal_distance": _on_floor(x)},
        met=lambda x: x.touched["buttons"][x.goal_button],
    ),
    "push": Aim(  # in space: the goal's centre lies lower than the box's
        distances=lambda x: {"box_distance": _distance(x.robot, _box(x)), "goal_distance": _distance(_box(x), x.goal)},
        met=lambda x: _distance(_box(x), x.goal) <= GOAL_RADIUS,
    ),
}


def _over_hazard(x: Situation) -> jax.Array:
    offset = x.objects["hazards"][:, :2] - x.robot[None, :2]
    return (jnp.sqrt(jnp.sum(jnp.square(offset), axis=1)) < x.sizes["hazards"]).any()


def _wrong_button(x: Situation) -> jax.Array:
    wrong = jnp.arange(len(x.touched["buttons"])) != x.goal_button
    return (x.touched["buttons"] & wrong).any() & (x.timer == 0)


# By name, a condition [] bool. A step costs 1 if any of the task's conditions holds, else 0.
COSTS: dict[str, Callable[[Situation], jax.Array]] = {
    "hazards": _over_hazard,
    "buttons": _wrong_button,
    "gremlins": lambda x: x.touched["gremlins"].any(),
}
