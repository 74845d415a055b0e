"""`envs.with_cost`: a task under another cost, else the same to the last bit."""

import copy
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import State
from envs.testing import check_environment
from tests.probe_envs import Counter, Walk, same_bits

pytestmark = pytest.mark.once


def effort(before: State, action: jax.Array, after: State) -> jax.Array:
    del before, after
    return jnp.square(action).sum()


def way(before: State, action: jax.Array, after: State) -> jax.Array:
    """Of the robot's root along x, in m; and the action, so that both count."""
    del action
    return jnp.abs(after.physics.qpos[0] - before.physics.qpos[0])


def rollout(env: Any, actions: jax.Array) -> Callable[[jax.Array], State]:
    def run(key: jax.Array) -> State:
        states: State = jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, env.reset(key), actions)[1]
        return states

    return run


def test_only_the_cost_is_another() -> None:
    env = envs.make("HalfCheetah", physics="native", max_episode_steps=15)
    actions = jax.random.uniform(jax.random.key(0), (20, 6), minval=-2.0, maxval=2.0)
    keys = jax.random.split(jax.random.key(1), 3)
    plain = jax.jit(jax.vmap(rollout(env, actions)))(keys)
    other = jax.jit(jax.vmap(rollout(envs.with_cost(env, effort), actions)))(keys)
    for field in dataclasses.fields(State):
        if "cost" not in field.name:
            assert same_bits(getattr(other, field.name), getattr(plain, field.name)), field.name
    wanted = np.square(np.clip(actions, -1, 1)).sum(axis=1)  # of what the actuators got
    np.testing.assert_allclose(other.cost, np.tile(wanted, (3, 1)), rtol=1e-6)
    np.testing.assert_allclose(other.episode_cost, np.cumsum(other.cost, axis=1), rtol=1e-6)
    assert plain.truncated.any()


def test_a_cost_may_depend_on_both_states() -> None:
    env = envs.with_cost(envs.make("Hopper", physics="native"), way)
    state, step = env.reset(jax.random.key(0)), jax.jit(env.step)
    for _ in range(5):
        after = step(state, jnp.ones(3))
        moved = abs(float(after.physics.qpos[0]) - float(state.physics.qpos[0]))
        np.testing.assert_allclose(after.cost, moved, rtol=1e-5, atol=1e-8)
        state = after
    assert state.episode_cost > 0


@pytest.mark.parametrize("task", ["Swimmer", "PointGoal1"])
def test_it_keeps_the_contract(task: str) -> None:
    check_environment(envs.with_cost(envs.make(task, physics="native"), effort), num_envs=3, num_steps=5)


def test_what_the_environment_has_besides_stays_reachable() -> None:
    plain: Any = envs.make("Swimmer", physics="native", max_episode_steps=4)
    env = copy.copy(envs.with_cost(plain, effort))
    for name in ("name", "obs_dim", "action_dim", "max_episode_steps", "dt", "physics_name", "model", "num_substeps"):
        assert getattr(env, name) is getattr(plain, name) or getattr(env, name) == getattr(plain, name), name
    np.testing.assert_array_equal(env.action_low, plain.action_low)
    np.testing.assert_array_equal(env.action_high, plain.action_high)
    state = env.reset_to(np.zeros(5), np.zeros(5))
    assert env.step(state, jnp.ones(2)).cost == 2.0
    assert env.engine_arrays(state)["qpos"].shape == (5,)
    with pytest.raises(AttributeError, match="no attribute 'shape'"):
        _ = env.shape
    with pytest.raises(ValueError, match=r"Swimmer: an action must have shape \(2,\)"):
        env.step(state, jnp.ones(3))


def test_costs_of_costs() -> None:
    """The outer cost sees the inner one as the task's own."""
    env = envs.with_cost(Counter(), lambda before, action, after: 10 * after.cost)
    outer = envs.with_cost(env, lambda before, action, after: after.cost + 1)
    state = outer.step(outer.reset(jax.random.key(0)), jnp.zeros(1))
    state = outer.step(state, jnp.zeros(1))
    assert [float(x) for x in (state.cost, state.episode_cost)] == [21.0, 42.0]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_cost_that_is_not_finite_ends_the_episode(value: float) -> None:
    env = envs.with_cost(Walk(), lambda before, action, after: jnp.where(after.step_count > 1, value, 3.0))
    first = env.step(env.reset(jax.random.key(0)), jnp.zeros(1))
    second = env.step(first, jnp.zeros(1))
    assert [bool(state.terminated) for state in (first, second)] == [False, True]
    costs = (first.cost, first.episode_cost, second.cost, second.episode_cost)
    assert [float(x) for x in costs] == [3.0, 3.0, 0.0, 3.0]
    assert second.reward == 0.0
    assert second.episode_return == first.episode_return
    assert np.isfinite(second.obs).all()


def test_a_negative_cost_is_hidden_from_nobody() -> None:
    env = envs.with_cost(Walk(), lambda before, action, after: -0.5)
    start = env.reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"Walk: the cost function returned -0\.5; costs are 0 or more"):
        env.step(start, jnp.zeros(1))
    compiled = jax.jit(env.step)(start, jnp.zeros(1))
    assert np.isnan(compiled.cost)
    assert np.isnan(compiled.episode_cost)
    assert not compiled.terminated


def test_a_cost_of_another_shape_is_refused() -> None:
    env = envs.with_cost(Walk(), lambda before, action, after: action)
    with pytest.raises(ValueError, match=r"Walk: cost must have shape \(\), but has shape \(1,\)"):
        jax.eval_shape(env.step, env.reset(jax.random.key(0)), jnp.zeros(1))


def test_the_check_of_a_task_allows_real_costs_their_rounding() -> None:
    """Summed in another order, 20 squares differ in their last bits; sums of 0 and 1 do not."""
    swimmer = envs.make("Swimmer", max_episode_steps=20)
    check_environment(envs.with_cost(swimmer, lambda before, action, after: jnp.sum(action**2)))
