"""The tasks' own rules on the native backend: resets, limits, guards, options. Parity is tested elsewhere."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import State

pytestmark = pytest.mark.once

NUM_ENVS = 8


@pytest.fixture(scope="module", params=[name for name, info in envs.TASKS.items() if info.family == "locomotion"])
def env(request: pytest.FixtureRequest) -> Any:
    return envs.make(request.param, physics="native")


def test_reset_noise(env: Any) -> None:
    """As the row says; that the row says what gymnasium does is tested with the parity."""
    keys = jax.random.split(jax.random.key(1), 500)
    physics = jax.jit(jax.vmap(env.reset))(keys).physics
    width, scale, normal = env.task.qpos_noise, env.task.qvel_noise, env.task.qvel_normal
    offset = physics.qpos - env.model.qpos0
    assert np.abs(offset).max() <= width * 1.0001
    np.testing.assert_allclose(np.std(offset, axis=0), width / np.sqrt(3), rtol=0.15)
    np.testing.assert_allclose(np.mean(offset, axis=0), 0.0, atol=width / 8)
    np.testing.assert_allclose(np.std(physics.qvel, axis=0), scale if normal else scale / np.sqrt(3), rtol=0.15)
    assert (np.abs(physics.qvel).max() > 2 * scale) if normal else (np.abs(physics.qvel).max() <= scale * 1.0001)
    correlation = np.corrcoef(np.concatenate([offset, physics.qvel], axis=1).T) - np.eye(env.model.nq + env.model.nv)
    assert np.abs(correlation).max() < 0.25, "each coordinate has its own noise"


def test_time_limit_truncates() -> None:
    env: Any = envs.make("HalfCheetah", physics="native", max_episode_steps=3)
    state, step = env.reset(jax.random.key(0)), jax.jit(env.step)
    flags = []
    for _ in range(3):
        state = step(state, jnp.zeros(6))
        flags.append((bool(state.truncated), bool(state.terminated), bool(state.done)))
    assert flags == [(False, False, False), (False, False, False), (True, False, True)]


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("Hopper", 1, 0.6),
        ("Hopper", 2, 0.3),
        ("Walker2d", 1, 2.2),
        ("Walker2d", 2, -1.2),
        ("Ant", 2, 1.5),
        ("Humanoid", 2, 0.8),
    ],
)
def test_unhealthy_terminates_and_pays_no_healthy_reward(name: str, index: int, value: float) -> None:
    env: Any = envs.make(name, physics="native")
    qpos, qvel = np.array(env.model.qpos0, np.float32), np.zeros(env.model.nv, np.float32)
    healthy = env.step(env.reset_to(qpos, qvel), jnp.zeros(env.action_dim))
    qpos[index] = value
    fallen = env.step(env.reset_to(qpos, qvel), jnp.zeros(env.action_dim))
    assert not healthy.terminated
    assert healthy.terms["healthy"] > 0
    assert fallen.terminated
    assert not fallen.truncated
    assert fallen.terms["healthy"] == 0


def test_hopper_terminates_on_any_large_coordinate() -> None:
    env: Any = envs.make("Hopper", physics="native")
    qvel = np.zeros(6, np.float32)
    qvel[0] = 101.0  # forward speed: beyond the healthy state range, though height and pitch are fine
    state = env.step(env.reset_to(np.array(env.model.qpos0), qvel), jnp.zeros(3))
    assert state.terminated
    assert np.abs(state.obs[5:]).max() <= 10.0, "velocities in the observation are clipped"


def test_cost_threshold_is_strict_and_configurable() -> None:
    action = jnp.full(6, 0.5)  # 0.1 * sum of squares = 0.15
    for threshold, cost in [(0.1, 1.0), (0.2, 0.0)]:
        env: Any = envs.make("HalfCheetah", physics="native", cost_threshold=threshold)
        assert env.step(env.reset(jax.random.key(0)), action).cost == cost
    hopper: Any = envs.make("Hopper", physics="native", cost_threshold=3.0)
    assert hopper.step(hopper.reset(jax.random.key(0)), jnp.ones(3)).cost == 0.0  # 3 > 3 is false


@pytest.mark.parametrize("name", ["Ant", "Humanoid"])
def test_contact_cost_can_be_dropped(name: str) -> None:
    """On the ground contact forces count; without the term only the control cost does, and the motion is the same."""
    keys = jax.random.split(jax.random.key(0), 4)
    results = {}
    for contact_cost in (True, False):
        env: Any = envs.make(name, physics="native", contact_cost=contact_cost, cost_threshold=0.0)

        def rollout(key: jax.Array, env: Any = env) -> State:
            state = env.reset(key)
            states: State = jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, state, jnp.zeros((60, env.action_dim)))[1]
            return states

        results[contact_cost] = jax.jit(jax.vmap(rollout))(keys)
    np.testing.assert_array_equal(results[True].obs, results[False].obs)
    assert not results[False].cost.any()
    assert not results[False].terms["contact"].any()
    np.testing.assert_array_equal(results[True].cost, results[True].terms["contact"] < 0)
    assert results[True].cost.any()


def test_terms_sum_to_the_reward(env: Any) -> None:
    state = jax.jit(jax.vmap(lambda k: env.step(env.reset(k), jnp.full(env.action_dim, 0.3))))(
        jax.random.split(jax.random.key(3), NUM_ENVS)
    )
    kept = env.task.reward_terms
    if env.task.reward is not None:  # the row's own
        np.testing.assert_allclose(state.reward, sum(state.terms.values()), rtol=1e-6)
        return
    assert ("control" in kept) == (env.name in ("Swimmer", "Walker2d"))
    assert "contact" not in kept
    np.testing.assert_allclose(state.reward, sum(state.terms[name] for name in kept), rtol=1e-6)
    assert (state.terms["control"] < 0).all()


def test_non_finite_physics_terminates_with_finite_values(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a log file in the working directory
    env: Any = envs.make("HalfCheetah", physics="native")
    state = env.step(env.reset_to(jnp.zeros(9), jnp.full(9, 1e20)), jnp.zeros(6))
    assert state.terminated
    assert state.reward == 0.0
    assert state.cost == 0.0
    assert np.isfinite(state.obs).all()
    assert np.isfinite(list(state.terms.values())).all()
    nan_action = env.step(env.reset(jax.random.key(0)), jnp.full(6, jnp.nan))
    assert nan_action.terminated
    assert np.isfinite(nan_action.obs).all()
    assert np.isfinite(nan_action.reward)


def test_auto_physics_is_native_on_the_cpu() -> None:
    if jax.default_backend() != "cpu":
        pytest.skip("not on a CPU")
    env: Any = envs.make("Swimmer")
    assert env.physics_name == "native"


def test_wrong_names_are_refused_in_one_line() -> None:
    for arguments, wanted in [(("Cheetah",), "HalfCheetah"), (("Swimmer", "bullet"), "native")]:
        with pytest.raises(ValueError, match=wanted) as error:
            envs.make(*arguments)
        assert "\n" not in str(error.value)
