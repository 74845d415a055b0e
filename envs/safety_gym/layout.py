"""Random layouts: where robot and objects stand at the start of an episode, and where the next goal is.

safety-gymnasium places one object after the other. It draws places uniformly from the arena until one is far enough
from the objects before, up to 100 times, and starts the whole layout anew where none is. Here, all 100 candidates of an
object are drawn at once, and the first valid one is taken. The distribution is the same.
"""

import functools
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from envs.safety_gym.tasks import ARENA, ROBOT_KEEPOUT, SafetyGymTask

NUM_CANDIDATES = 100  # per object, as in safety-gymnasium
NUM_GOAL_CANDIDATES = 512  # for a new goal; safety-gymnasium allows 10,000, of which it has needed 97 at most


def keepouts(task: SafetyGymTask) -> np.ndarray:
    """[P] radii of the robot and of every object, in the order of placement."""
    return np.array([ROBOT_KEEPOUT, *(kind.keepout for kind in task.objects for _ in range(kind.count))])


def places_of(task: SafetyGymTask) -> dict[str, slice]:
    """Which rows of a layout belong to the robot and to each kind of object."""
    slices, start = {"robot": slice(0, 1)}, 1
    for kind in task.objects:
        slices[kind.name] = slice(start, start + kind.count)
        start += kind.count
    return slices


def candidates(key: jax.Array, keepouts: ArrayLike, count: int) -> Float[Array, "... C 2"]:
    """`count` centres for each keepout radius, such that the whole disc lies in the arena. `key` is consumed."""
    reach = ARENA - jnp.asarray(keepouts)
    return reach[..., None, None] * jax.random.uniform(key, (*reach.shape, count, 2), minval=-1.0)


def is_clear(
    points: Float[Array, "C 2"],
    keepout: ArrayLike,
    others: Float[Array, "P 2"],
    other_keepouts: ArrayLike,
) -> Bool[Array, " C"]:
    """Which points are at least the sum of both keepouts away from all others."""
    distance = jnp.linalg.norm(points[:, None] - others[None], axis=-1)
    return (distance >= (keepout + jnp.asarray(other_keepouts))[None]).all(axis=1)


def first_clear(points: Float[Array, "C 2"], clear: Bool[Array, " C"]) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """The first clear point, and whether there is one (otherwise the first point of all)."""
    return points[jnp.argmax(clear)], clear.any()


def attempt(key: jax.Array, radii: ArrayLike) -> tuple[Float[Array, "P 2"], Bool[Array, ""]]:
    """One attempt at a layout: a place for each object in turn, and whether all found one. `key` is consumed."""
    keepout = jnp.asarray(radii)
    order = jnp.arange(len(keepout))

    def place(placed: jax.Array, turn: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        index, points = turn
        clear = is_clear(points, keepout[index], placed, jnp.where(order < index, keepout, -jnp.inf))
        spot, found = first_clear(points, clear)
        return placed.at[index].set(spot), found

    points = candidates(key, keepout, NUM_CANDIDATES)
    layout, found = jax.lax.scan(place, jnp.zeros((len(keepout), 2), points.dtype), (order, points))
    return layout, found.all()


def sample(task: SafetyGymTask, key: jax.Array) -> Float[Array, "P 2"]:
    """Places of the robot and of every object, in the order of `places_of`. `key` is consumed."""
    layout_key, goal_key = jax.random.split(key)
    radii = keepouts(task)
    if task.aim == "button":
        return from_bank(layout_key)
    layout, _ = attempt(layout_key, radii)
    # The goal is drawn once more, now clear of all other objects, in the same way as each later goal.
    row = places_of(task)["goal"].start
    others = np.delete(np.arange(len(radii)), row)
    return layout.at[row].set(draw_goal(goal_key, layout[row], float(radii[row]), layout[others], radii[others]))


def from_bank(key: jax.Array) -> Float[Array, "P 2"]:
    """A layout of the bank, mirrored and turned into one of its eight images under the square's symmetries."""
    bank = load_bank()
    row_key, image_key = jax.random.split(key)
    layout = jnp.asarray(bank)[jax.random.randint(row_key, (), 0, len(bank))]
    flips = jax.random.randint(image_key, (3,), 0, 2)
    signs = 1.0 - 2.0 * flips[None, :2].astype(layout.dtype)
    return signs * jnp.where(flips[2] == 0, layout, layout[:, ::-1])


@functools.cache
def load_bank() -> np.ndarray:
    """[B, 14, 2] float32: valid layouts of the Button1 tasks, made by `python -m envs.safety_gym.bank`.

    Only one attempt in 70 succeeds for these tasks. If layouts were drawn at every reset, the whole batch would wait
    for the simulation with the most attempts.
    """
    with resources.files("envs.safety_gym").joinpath("button_layouts.npy").open("rb") as file:
        bank: np.ndarray = np.load(file, allow_pickle=False)
    return bank


def draw_goal(
    key: jax.Array, old_goal: Float[Array, "2"], keepout: float, others: Float[Array, "P 2"], radii: np.ndarray
) -> Float[Array, "2"]:
    """A goal, uniform on the area that is clear of the others; the old goal if no candidate is. `key` is consumed."""
    points = candidates(key, keepout, NUM_GOAL_CANDIDATES)
    place, found = first_clear(points, is_clear(points, keepout, others, radii))
    return jnp.where(found, place, old_goal)
