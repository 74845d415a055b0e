"""The pseudo-lidar: for each direction, how close the nearest object of a kind is."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

NUM_BINS = 16
RANGE = 3.0  # m; beyond it nothing is seen


def lidar(
    robot_pos: Float[Array, "3"], robot_mat: Float[Array, "3 3"], points: Float[Array, "K 2"]
) -> Float[Array, " 16"]:
    """Closeness per direction in the robot's frame: 0 for nothing within 3 m, 1 for at the robot's own place.

    Distances are to the objects' centres on the floor, seen from the robot's origin: a robot that tilts sees its own
    height, too (as in safety-gymnasium). Each object also shows in the two neighbouring bins, the more the nearer its
    direction is to them.

    Args:
        robot_pos: origin of the root body in the world, m.
        robot_mat: the root body's rotation, body to world.
        points: K objects' positions on the floor, m.
    """
    on_floor = jnp.concatenate([points, jnp.zeros_like(points[:, :1])], axis=1)
    seen = ((on_floor - robot_pos[None]) @ robot_mat)[:, :2]
    closeness = jnp.maximum(0.0, RANGE - jnp.linalg.norm(seen, axis=1)) / RANGE
    angle = jnp.arctan2(seen[:, 1], seen[:, 0]) % (2 * math.pi)
    place = angle / (2 * math.pi / NUM_BINS)
    first = jnp.floor(place)
    past = (place - first)[None]
    bins = first.astype(jnp.int32) % NUM_BINS  # rounding can make an angle of just below 0 into 2 pi
    further = jnp.arange(NUM_BINS)[:, None] - bins[None]
    ahead = further % NUM_BINS  # [16, K]: how many bins further round than the object's
    parts = jnp.select([ahead == 0, ahead == 1, ahead == NUM_BINS - 1], [1.0, past, 1 - past], 0.0)
    return (parts * closeness[None]).max(axis=1)
