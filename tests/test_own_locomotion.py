"""Two tasks of gymnasium as rows from outside the package, each with its own observation, reward and start.

They are no tasks of ours: they show that a row can say all that such a task needs. Compared with gymnasium, step by
step.
"""

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs import registry
from envs.locomotion import Locomotion, LocomotionTask
from envs.physics import Data
from envs.testing import check_environment

pytestmark = pytest.mark.once

gymnasium = pytest.importorskip("gymnasium")
NATIVE: Any = {"rtol": 1e-5, "atol": 1e-6}  # only conversions to float32 round
NUM_STEPS = 60


# InvertedDoublePendulum: a cart with two links; the episode ends when the tip falls below 1 m.


def tip(data: Data) -> jax.Array:
    return data.fields["site_xpos"][0]


def pendulum_obs(model: mujoco.MjModel, data: Data) -> jax.Array:
    del model
    angles, speeds = data.qpos[1:], jnp.clip(data.qvel, -10, 10)
    force = jnp.clip(data.fields["qfrc_constraint"][:1], -10, 10)
    return jnp.concatenate([data.qpos[:1], jnp.sin(angles), jnp.cos(angles), speeds, force])


def pendulum_stands(model: mujoco.MjModel, data: Data) -> jax.Array:
    del model
    return tip(data)[2] > 1


def pendulum_reward(model: mujoco.MjModel, data: Data, action: jax.Array) -> dict[str, jax.Array]:
    del action
    x, _, y = tip(data)
    speeds = data.qvel[1:3]
    return {
        "reward_survive": 10.0 * pendulum_stands(model, data).astype(y.dtype),
        "distance_penalty": -(0.01 * x**2 + (y - 2) ** 2),
        "velocity_penalty": -(1e-3 * speeds[0] ** 2 + 5e-3 * speeds[1] ** 2),
    }


PENDULUM = LocomotionTask(
    xml="inverted_double_pendulum.xml",
    frame_skip=5,
    fields=("site_xpos", "qfrc_constraint"),
    observe=pendulum_obs,
    reward=pendulum_reward,
    healthy=pendulum_stands,
    cost_quantity=lambda x: jnp.abs(x.data.qpos[0]),
    qpos_noise=0.1,
    qvel_noise=0.1,
    qvel_normal=True,
)


# Pusher: an arm pushes a cylinder to a goal; the cylinder starts somewhere else in each episode.


def place(model: mujoco.MjModel, data: Data, body: str) -> jax.Array:
    return data.fields["xpos"][model.body(body).id]


def pusher_obs(model: mujoco.MjModel, data: Data) -> jax.Array:
    places = [place(model, data, body) for body in ("tips_arm", "object", "goal")]
    return jnp.concatenate([data.qpos[:7], data.qvel[:7], *places])


def pusher_reward(model: mujoco.MjModel, data: Data, action: jax.Array) -> dict[str, jax.Array]:
    thing = place(model, data, "object")
    return {
        "reward_dist": -jnp.linalg.norm(thing - place(model, data, "goal")),
        "reward_ctrl": -0.1 * jnp.square(action).sum().astype(thing.dtype),
        "reward_near": -0.5 * jnp.linalg.norm(thing - place(model, data, "tips_arm")),
    }


def pusher_start(model: mujoco.MjModel, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    place_key, qvel_key = jax.random.split(key)
    low, high = jnp.array([-0.3, -0.2]), jnp.array([0.0, 0.2])
    candidates = jax.random.uniform(place_key, (100, 2), minval=low, maxval=high)
    first = jnp.argmax(jnp.linalg.norm(candidates, axis=1) > 0.17)  # the goal is at 0
    qpos = jnp.asarray(model.qpos0, low.dtype).at[-4:-2].set(candidates[first]).at[-2:].set(0.0)
    qvel = jax.random.uniform(qvel_key, (model.nv,), minval=-0.005, maxval=0.005)
    return qpos, qvel.at[-4:].set(0.0)


PUSHER = LocomotionTask(
    xml="pusher_v5.xml",
    frame_skip=5,
    fields=("xpos",),
    observe=pusher_obs,
    reward=pusher_reward,
    start=pusher_start,
    cost_quantity=lambda x: jnp.square(x.action).sum(),
)

ROWS = {"InvertedDoublePendulum": PENDULUM, "Pusher": PUSHER}
SIZES = {"InvertedDoublePendulum": (9, 1), "Pusher": (23, 7)}


def make(name: str, physics: str = "auto", max_episode_steps: int = 1000, cost_threshold: float = 0.5) -> Locomotion:
    return Locomotion(
        ROWS[name], name=name, physics=physics, max_episode_steps=max_episode_steps, cost_threshold=cost_threshold
    )


@pytest.fixture(scope="module", params=list(ROWS))
def name(request: pytest.FixtureRequest) -> Iterator[str]:
    """The name of a task that is registered while this module is tested."""
    task: str = request.param
    envs.register(task, functools.partial(make, task), original=f"{task}-v5")
    yield task
    registry._tasks.pop(task)


@pytest.fixture(scope="module")
def original(name: str) -> Any:
    mujoco.set_mju_user_warning(lambda _: None)  # a model's deprecated attribute would go to a log file here
    try:
        return gymnasium.make(envs.TASKS[name].original).unwrapped
    finally:
        mujoco.set_mju_user_warning(None)


@pytest.fixture(scope="module")
def env(name: str) -> Any:
    return envs.make(name, physics="native")


def test_the_contract_is_kept(env: Any) -> None:
    assert (env.obs_dim, env.action_dim) == SIZES[env.name]
    check_environment(env, num_envs=4, num_steps=5)


@pytest.mark.parametrize("seed", [0, 1])
def test_random_episodes_are_gymnasiums(env: Any, original: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    original.reset(seed=seed)
    qpos, qvel = original.data.qpos.astype(np.float32), original.data.qvel.astype(np.float32)
    original.set_state(qpos.astype(np.float64), qvel.astype(np.float64))
    original.data.qacc_warmstart[:] = 0.0
    state, step = jax.jit(env.reset_to)(qpos, qvel), jax.jit(env.step)
    np.testing.assert_allclose(state.obs, original._get_obs(), **NATIVE)
    assert env.dt == pytest.approx(original.dt)
    low, high = env.action_low, env.action_high
    total, costs = 0.0, []
    for _ in range(NUM_STEPS):
        action = rng.uniform(low, high).astype(np.float32)
        obs, reward, terminated, _, info = original.step(action)
        state = step(state, action)
        total += reward
        np.testing.assert_allclose(state.obs, obs, **NATIVE)
        np.testing.assert_allclose(state.reward, reward, **NATIVE)
        assert bool(state.terminated) == terminated
        assert set(state.terms) <= set(info)
        for term, value in state.terms.items():
            np.testing.assert_allclose(value, info[term], **NATIVE, err_msg=term)
        wanted = np.abs(original.data.qpos[0]) if env.name != "Pusher" else np.sum(action.astype(np.float64) ** 2)
        assert bool(state.cost) == (wanted > env.cost_threshold)
        costs.append(bool(state.cost))
        if terminated:
            break
    np.testing.assert_allclose(state.episode_return, total, rtol=1e-5)
    if env.name == "Pusher":
        assert any(costs) and len(costs) == NUM_STEPS
    else:
        assert terminated, "a random policy lets it fall"


def test_starts_are_distributed_as_gymnasiums(env: Any, original: Any) -> None:
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(2), 400)).physics
    theirs = []
    for seed in range(400):
        original.reset(seed=seed)
        theirs.append(np.concatenate([original.data.qpos, original.data.qvel]))
    ours = np.concatenate([states.qpos, states.qvel], axis=1)
    spread = np.std(theirs, axis=0)
    np.testing.assert_allclose(np.std(ours, axis=0), spread, rtol=0.2, atol=1e-6)
    np.testing.assert_array_less(np.abs(ours.mean(axis=0) - np.mean(theirs, axis=0)), 0.3 * spread + 1e-6)


def test_a_contact_cost_that_a_row_does_not_have_cannot_be_left_out() -> None:
    with pytest.raises(ValueError, match="Pusher: contact_cost False has no effect"):
        Locomotion(PUSHER, name="Pusher", cost_threshold=0.5, contact_cost=False)
