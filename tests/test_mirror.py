"""Mirror symmetries that tasks declare, against the physics: a step of the mirrored world is the mirrored step."""

from typing import Any

import jax
import mujoco
import numpy as np
import pytest

import envs
from ccil_jax.agents import build
from ccil_jax.agents.expert import expert_of
from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.errors import ConfigError
from ccil_jax.types import ExpertData
from envs.base import Mirror, mirror_of
from envs.safety_gym.environment import SafetyGym
from envs.safety_gym.robots import ROBOTS

pytestmark = pytest.mark.once

SYMMETRIC = ("PointGoal1", "CarGoal1", "DoggoGoal1", "PointPush1", "CarPush1")
WORLD = np.array([-1.0, 1.0, 1.0])  # x changes its sign, so that the magnetic field, which points along -y, stays
HALF_TURN = np.array([0.0, 0.0, 0.0, 1.0])  # about the vertical, as a quaternion
JOINT = mujoco.mjtJoint


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    result = np.zeros(4)
    mujoco.mju_mulQuat(result, np.asarray(a, float), np.asarray(b, float))
    return result


def mirrored_poses(env: SafetyGym, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint by joint. A rotation R becomes M R L: M is the world's mirror, L that of the body, which is its own image.

    L is M too, save for a robot whose y axis points sideways.
    """
    robot = ROBOTS[env.task.robot]
    model, new_qpos, new_qvel = env.model, qpos.copy(), qvel.copy()
    for joint in (model.joint(i) for i in range(model.njnt)):
        q, v = joint.qposadr[0], joint.dofadr[0]
        own = joint.name in ("root", "x", "y", "yaw")
        body = np.ones(3)
        body[robot.lateral if own else 0] = -1.0
        if joint.type[0] == JOINT.mjJNT_FREE:
            new_qpos[q : q + 3] = WORLD * qpos[q : q + 3]
            turned = np.array([1, 1, -1, -1]) * qpos[q + 3 : q + 7]  # M R M
            new_qpos[q + 3 : q + 7] = product(turned, HALF_TURN) if body[1] < 0 else turned
            new_qvel[v : v + 3] = WORLD * qvel[v : v + 3]
            new_qvel[v + 3 : v + 6] = -body * qvel[v + 3 : v + 6]
        elif joint.type[0] == JOINT.mjJNT_BALL:
            new_qpos[q : q + 4] = np.array([1, 1, -1, -1]) * qpos[q : q + 4]
            new_qvel[v : v + 3] = np.array([1, -1, -1]) * qvel[v : v + 3]
        elif joint.name == "x":
            new_qpos[q], new_qvel[v] = -qpos[q], -qvel[v]
        elif joint.name == "yaw":
            new_qpos[q], new_qvel[v] = np.pi - qpos[q], -qvel[v]
        elif joint.name == "waist_x":
            new_qpos[q], new_qvel[v] = -qpos[q], -qvel[v]
        elif joint.name in robot.counterparts:
            other = model.joint(robot.counterparts[joint.name])
            new_qpos[q], new_qvel[v] = qpos[other.qposadr[0]], qvel[other.dofadr[0]]
    return new_qpos, new_qvel


def declared(env: SafetyGym) -> Mirror:
    mirror = mirror_of(env)
    assert mirror is not None
    return mirror


@pytest.mark.parametrize("name", SYMMETRIC)
def test_a_mirrored_step_is_a_step_of_the_mirrored_world(name: str) -> None:
    env = envs.make(name, physics="native")
    assert isinstance(env, SafetyGym)
    mirror = declared(env)
    reset, reset_to, step = jax.jit(env.reset), jax.jit(env.reset_to), jax.jit(env.step)
    rng = np.random.default_rng(0)

    def random_action() -> np.ndarray:
        return rng.uniform(env.action_low, env.action_high).astype(np.float32)

    state = reset(jax.random.key(3))
    for _ in range(20):  # to a state in which everything moves
        state = step(state, random_action())
    qpos, qvel = mirrored_poses(env, np.asarray(state.physics.data.qpos), np.asarray(state.physics.data.qvel))
    layout = np.asarray(state.physics.layout)
    state = reset_to(layout, state.physics.data.qpos, state.physics.data.qvel)
    image = reset_to(layout * WORLD[:2], qpos, qvel)
    moved = 0.0
    for _ in range(5):  # rounding grows: sideways the robot sticks and slips
        np.testing.assert_allclose(image.obs, mirror.obs(np.asarray(state.obs)), atol=5e-3)
        action, before = random_action(), state.obs
        state, image = step(state, action), step(image, mirror.action(action))
        np.testing.assert_allclose(image.reward, state.reward, atol=1e-4)
        assert image.cost == state.cost
        moved = max(moved, float(np.abs(state.obs - before).max()))
    assert moved > 0.1


@pytest.mark.parametrize("name", SYMMETRIC)
def test_two_mirrors_change_nothing_and_one_does(name: str) -> None:
    env = envs.make(name)
    assert isinstance(env, SafetyGym)
    mirror = declared(env)
    obs, action = np.arange(1.0, env.obs_dim + 1), np.arange(1.0, env.action_dim + 1)
    np.testing.assert_array_equal(mirror.obs(mirror.obs(obs)), obs)
    np.testing.assert_array_equal(mirror.action(mirror.action(action)), action)
    assert (mirror.obs(obs) != obs).sum() > env.obs_dim / 2
    assert (mirror.action(action) != action).any()


@pytest.mark.parametrize("name", ["PointButton1", "CarButton1", "HalfCheetah", "Swimmer"])
def test_no_symmetry_is_declared_where_none_is_known(name: str) -> None:
    """Gremlins circle to one side, so a button task in the mirror is another task."""
    assert mirror_of(envs.make(name)) is None


def mirror_with(**changes: list[int]) -> Mirror:
    fields = {"obs_index": [1, 0, 2], "obs_sign": [1, 1, -1], "action_index": [0], "action_sign": [-1]} | changes
    return Mirror(**{name: np.array(value) for name, value in fields.items()})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"obs_index": [1, 1, 2]}, "obs_index must name every place"),
        ({"obs_index": [1, 0, 3]}, "obs_index must name every place"),
        ({"obs_sign": [1, 1]}, r"obs_sign must have shape \(3,\)"),
        ({"action_sign": [0]}, "action_sign must consist of 1 and -1"),
        ({"obs_sign": [1, -1, 1]}, "the image of the image of obs"),
        ({"obs_index": [1, 2, 0]}, "the image of the image of obs"),
    ],
)
def test_what_is_no_mirror_is_refused(changes: dict[str, list[int]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        mirror_with(**changes)


@pytest.mark.parametrize(
    ("mirror", "message"),
    [(mirror_with(), r"Swimmer: mirror.obs_index must have shape \(8,\)"), ("left", "Swimmer: mirror is of type str")],
)
def test_a_mirror_that_does_not_fit_the_task_is_refused_before_anything_is_trained(mirror: Any, message: str) -> None:
    class Mirrored(type(envs.make("Swimmer"))):  # type: ignore[misc]  # its base is known only at run time
        pass

    env = envs.make("Swimmer")
    env.__class__ = Mirrored
    Mirrored.mirror = mirror
    with pytest.raises(ConfigError, match=message):
        build.resolve(Config(), env, random_demonstrations("Swimmer"))


# As demonstrations ---------------------------------------------------------------------------------------------------


def learnt_from(name: str, choice: str, demonstrations: Demonstrations) -> ExpertData:
    config = Config(method="iq_learn", mirrored_demonstrations=choice)
    data = expert_of(config, envs.make(name), demonstrations)
    assert data is not None
    return data


def random_demonstrations(name: str) -> Demonstrations:
    """Two episodes of ten steps; their numbers mean nothing."""
    env, rng, end = envs.make(name), np.random.default_rng(0), np.arange(20) % 10 == 9
    return Demonstrations(
        obs=rng.normal(size=(20, env.obs_dim)).astype(np.float32),
        actions=rng.normal(size=(20, env.action_dim)).astype(np.float32),
        rewards=None,
        costs=np.ones(20, np.float32),
        terminated=end & (np.arange(20) > 10),
        truncated=end & (np.arange(20) < 10),
        episode_ends=np.array([10, 20]),
    )


def test_images_follow_the_demonstrations_and_nothing_is_known_of_held_out_steps() -> None:
    name = "CarGoal1"
    demonstrations, mirror = random_demonstrations(name), mirror_of(envs.make(name))
    plain, doubled = (learnt_from(name, choice, demonstrations) for choice in ("none", "symmetric_tasks"))
    assert mirror is not None
    assert plain.transitions is not None
    assert doubled.transitions is not None
    for own, both, image in (
        (plain.obs, doubled.obs, mirror.obs),
        (plain.action, doubled.action, mirror.action),
        (plain.held_out_obs, doubled.held_out_obs, mirror.obs),
        (plain.held_out_action, doubled.held_out_action, mirror.action),
        (plain.transitions.obs, doubled.transitions.obs, mirror.obs),
        (plain.transitions.next_obs, doubled.transitions.next_obs, mirror.obs),
        (plain.transitions.action, doubled.transitions.action, mirror.action),
        (plain.transitions.initial_obs, doubled.transitions.initial_obs, mirror.obs),
        (plain.transitions.terminated, doubled.transitions.terminated, lambda flags: flags),
    ):
        np.testing.assert_array_equal(both, np.concatenate([own, image(own)]))


def test_a_task_without_a_symmetry_has_no_images() -> None:
    demonstrations = random_demonstrations("Swimmer")
    plain, same = (learnt_from("Swimmer", choice, demonstrations) for choice in ("none", "symmetric_tasks"))
    jax.tree.map(np.testing.assert_array_equal, plain, same)


def test_the_limit_stays_that_of_the_demonstrations() -> None:
    """The expert has not paid for the images."""
    env, demonstrations = envs.make("PointGoal1"), random_demonstrations("PointGoal1")
    config = Config(method="ccil", mirrored_demonstrations="symmetric_tasks")
    assert build.resolve(config, env, demonstrations).cost_limit == 10.0
