"""The mirror symmetry of Safety Gym tasks: left and right of the robot change places.

The plane of the mirror is vertical and contains the robot's forward axis. Floor, goals and obstacles have no left or
right of their own, so the mirror image of a step is a step of the same task with another layout.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from envs.base import Mirror
from envs.safety_gym.lidar import NUM_BINS
from envs.safety_gym.robots import Robot
from envs.safety_gym.scene import BASIC_SENSORS

SENSOR = mujoco.mjtSensor
_VECTORS = (SENSOR.mjSENS_ACCELEROMETER, SENSOR.mjSENS_VELOCIMETER, SENSOR.mjSENS_MAGNETOMETER)
_ROTATIONS = (SENSOR.mjSENS_GYRO, SENSOR.mjSENS_BALLANGVEL)  # angular velocities


def make(robot: Robot, actuators: Sequence[str], num_lidars: int) -> Mirror:
    """The symmetry of a task.

    Args:
        robot: the robot.
        actuators: the names of the action's entries.
        num_lidars: how many lidars end the observation.
    """
    flip = np.ones(3)
    flip[robot.lateral] = -1.0
    parts = [(name, _signs(kind, flip)) for name, kind, *_ in (*BASIC_SENSORS, *robot.sensors)]
    if robot.ball is not None:
        parts.append(("ball", np.outer(flip, flip).ravel()))  # M R M of a rotation R and the reflection M
    parts += [(name, np.ones(2)) for name in robot.hinges]
    own = _exchanged([(name, len(signs)) for name, signs in parts], robot)
    bins = _mirrored_bins(robot.lateral)
    return Mirror(
        obs_index=np.concatenate([own, *(len(own) + NUM_BINS * i + bins for i in range(num_lidars))]),
        obs_sign=np.concatenate([*(signs for _, signs in parts), np.ones(NUM_BINS * num_lidars)]),
        action_index=_exchanged([(name, 1) for name in actuators], robot),
        action_sign=np.array([-1.0 if name in robot.turning else 1.0 for name in actuators]),
    )


def _signs(kind: mujoco.mjtSensor, flip: np.ndarray) -> np.ndarray:
    """Of a sensor's entries: a vector v becomes M v, an angular velocity w becomes -M w, and a number stays."""
    if kind in _VECTORS:
        return flip
    return -flip if kind in _ROTATIONS else np.ones(1)


def _exchanged(parts: Sequence[tuple[str, int]], robot: Robot) -> np.ndarray:
    """Where each entry of an array comes from; `parts` are the names and sizes of what it is made of."""
    ends = np.cumsum([size for _, size in parts])
    first = {name: end - size for (name, size), end in zip(parts, ends, strict=True)}
    index = [np.arange(end - size, end) for (_, size), end in zip(parts, ends, strict=True)]
    for place, (name, size) in enumerate(parts):
        if name in robot.counterparts:
            index[place] = first[robot.counterparts[name]] + np.arange(size)
    return np.concatenate(index)


def _mirrored_bins(lateral: int) -> np.ndarray:
    """Which bin of the lidar each bin shows in the mirror: a direction a becomes -a, or pi - a if x points sideways."""
    bins = NUM_BINS - 1 - np.arange(NUM_BINS)
    return bins if lateral == 1 else (bins + NUM_BINS // 2) % NUM_BINS
