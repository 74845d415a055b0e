"""The pseudo-lidar: for each direction, how close the nearest object of a kind is."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

NUM_BINS = 16
RANGE = 3.0  # m; beyond it nothing is seen


def lidar(
    robot_pos: Float[Array, "3"], robot_mat: Float[Array, "3 3"], points: Float[Array, "K 2"]
) -> Float[Array, " 16"]:
    """Closeness c = max(0, 1 - d / 3 m) of the nearest object, for each of 16 directions in the robot's frame.

    d is the distance from the robot's origin to the object's centre on the floor, in the plane of the robot's x and y
    axes: if the robot tilts, its own height enters too (as in safety-gymnasium). An object lies in the bin of its
    direction and shows there with c. It also shows in the next bin with a c, where a in [0, 1) is how far its direction
    lies past the start of its own bin, as a part of the bin's width; and in the bin before with (1 - a) c.

    Args:
        robot_pos: origin of the root body in the world, m.
        robot_mat: the root body's rotation, body to world.
        points: positions of K objects on the floor, m.

    Returns:
        For each bin the largest value that an object shows there; 0 where there is none within 3 m.
    """
    on_floor = jnp.concatenate([points, jnp.zeros_like(points[:, :1])], axis=1)
    seen = ((on_floor - robot_pos[None]) @ robot_mat)[:, :2]
    closeness = jnp.maximum(0.0, RANGE - jnp.linalg.norm(seen, axis=1)) / RANGE
    angle = jnp.arctan2(seen[:, 1], seen[:, 0]) % (2 * math.pi)
    place = angle / (2 * math.pi / NUM_BINS)
    first = jnp.floor(place)
    past = (place - first)[None]
    bins = first.astype(jnp.int32) % NUM_BINS  # an angle just below 0 can be rounded to 2 pi, which is bin 0 again
    further = jnp.arange(NUM_BINS)[:, None] - bins[None]
    ahead = further % NUM_BINS  # [16, K]: how many bins a bin is ahead of the object's own
    parts = jnp.select([ahead == 0, ahead == 1, ahead == NUM_BINS - 1], [1.0, past, 1 - past], 0.0)
    return (parts * closeness[None]).max(axis=1)
