"""One smoke test for any environment: ours, adapted ones, a user's own."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import State
from envs.jax_tools import as_numbers


def check_environment(env: Any, num_envs: int = 8, num_steps: int = 20) -> None:
    """Checks the promises of `Environment` and `State` on random episodes.

    Shapes and types are as promised; observations, rewards and costs are finite; costs are not negative; the totals of
    an episode are the sums of its steps; every key starts another episode; the same arguments give the same bits; and
    actions are clipped.

    Args:
        env: an `Environment`.
        num_envs: episodes, each with its own key.
        num_steps: random actions per episode, within [-2, 2].

    Raises:
        AssertionError: a promise of `Environment` or `State` is broken.
    """

    def rollout(key: jax.Array) -> tuple[State, State, jax.Array]:
        reset_key, action_key = jax.random.split(key)
        state = env.reset(reset_key)
        actions = jax.random.uniform(action_key, (num_steps, env.action_dim), minval=-2.0, maxval=2.0)

        def step(state: State, action: jax.Array) -> tuple[State, State]:
            state = env.step(state, action)
            return state, state

        return state, jax.lax.scan(step, state, actions)[1], actions

    run, keys = jax.jit(jax.vmap(rollout)), jax.random.split(jax.random.key(0), num_envs)
    first, states, actions = once = run(keys)
    assert first.obs.shape == (num_envs, env.obs_dim)
    assert states.obs.shape == (num_envs, num_steps, env.obs_dim)
    for state in (first, states):
        lead = state.obs.shape[:-1]
        for name in ("reward", "cost", "episode_return", "episode_cost"):
            value = getattr(state, name)
            assert value.shape == lead, name
            assert value.dtype == state.obs.dtype == jnp.result_type(float), name
        assert state.terminated.shape == state.truncated.shape == state.step_count.shape == lead
        assert state.terminated.dtype == state.truncated.dtype == bool
        assert state.step_count.dtype == jnp.int32
        assert all(np.isfinite(leaf).all() for leaf in (state.obs, state.reward, state.cost))
        assert all(term.shape == lead for term in state.terms.values())
    assert not first.reward.any()
    assert not first.cost.any()
    assert not first.done.any()
    assert not first.step_count.any()
    assert (states.cost >= 0).all()
    assert len(np.unique(first.obs, axis=0)) == num_envs, "every key starts another episode"
    np.testing.assert_array_equal(states.step_count, np.broadcast_to(1 + np.arange(num_steps), (num_envs, num_steps)))
    np.testing.assert_allclose(states.episode_return, np.cumsum(states.reward, axis=1), rtol=1e-4, atol=1e-4)
    # A sum of n numbers >= 0 is rounded n times. Costs of 0 and 1 are summed exactly.
    rounding = num_steps * np.finfo(states.cost.dtype).eps
    np.testing.assert_allclose(states.episode_cost, np.cumsum(states.cost, axis=1), rtol=rounding)
    jax.tree.map(_assert_equal, run(keys), once)
    step = jax.jit(jax.vmap(env.step))
    clipped = step(first, jnp.clip(actions[:, 0], env.action_low, env.action_high))
    jax.tree.map(_assert_equal, clipped, step(first, actions[:, 0]))


def _assert_equal(a: jax.Array, b: jax.Array) -> None:
    np.testing.assert_array_equal(as_numbers(a), as_numbers(b))
