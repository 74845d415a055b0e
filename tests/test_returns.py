"""Generalised advantage estimation against plain loops and values typed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ccil_jax.learning.returns import gae, successor_values
from tests.probe_envs import gae_by_loop


@pytest.mark.parametrize("seed", range(3))
def test_against_a_loop_with_terminations_and_truncations_mixed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    signal, value, next_value = rng.normal(size=(3, 40, 5))
    terminated = rng.uniform(size=(40, 5)) < 0.1
    truncated = rng.uniform(size=(40, 5)) < 0.1
    done = terminated | truncated
    done[:, 4], terminated[:, 4] = False, False  # one simulation whose episode outlasts the batch
    with jax.enable_x64(True):
        arrays = [jnp.asarray(x) for x in (signal, value, next_value, terminated, done)]
        advantage, returns = jax.jit(gae)(*arrays, 0.9, 0.8)
    expected = gae_by_loop(signal, value, next_value, terminated, done, 0.9, 0.8)
    np.testing.assert_allclose(advantage, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(returns, expected + value, rtol=1e-12, atol=1e-12)


def test_values_typed_by_hand() -> None:
    # gamma 1/2, lambda 1/2. Steps: goes on, terminates (its next value must not count), truncated (it must).
    signal, value = jnp.array([[1.0], [2.0], [3.0]]), jnp.array([[4.0], [8.0], [2.0]])
    next_value = jnp.array([[8.0], [100.0], [6.0]])
    terminated, done = jnp.array([[False], [True], [False]]), jnp.array([[False], [True], [True]])
    advantage, returns = gae(signal, value, next_value, terminated, done, 0.5, 0.5)
    # residuals: 1 + 4 - 4 = 1; 2 + 0 - 8 = -6; 3 + 3 - 2 = 4. The first step's sum: 1 + 1/4 * -6 = -1/2.
    np.testing.assert_array_equal(advantage[:, 0], [-0.5, -6.0, 4.0])
    np.testing.assert_array_equal(returns[:, 0], [3.5, 2.0, 6.0])


def test_lambda_one_gives_discounted_sums_and_lambda_zero_residuals() -> None:
    signal = jnp.array([[1.0], [2.0], [4.0]])
    value, next_value = jnp.array([[3.0], [5.0], [7.0]]), jnp.array([[5.0], [7.0], [8.0]])
    never = jnp.zeros((3, 1), bool)
    _, returns = gae(signal, value, next_value, never, never, 0.5, 1.0)
    np.testing.assert_array_equal(returns[:, 0], [1 + 1 + 1 + 1, 2 + 2 + 2, 4 + 4])  # ... + gamma^k V(s_T), V = 8
    advantage, _ = gae(signal, value, next_value, never, never, 0.5, 0.0)
    np.testing.assert_array_equal(advantage[:, 0], [1 + 2.5 - 3, 2 + 3.5 - 5, 4 + 4 - 7])


def test_bootstraps_from_the_true_successor_and_not_from_the_reset_state() -> None:
    """A column of values in which V(s_T) = 10 and the next episode begins with V(s_0) = -10."""
    signal, done = jnp.zeros((2, 1)), jnp.array([[True], [False]])
    value, next_value = jnp.array([[1.0], [-10.0]]), jnp.array([[10.0], [1.0]])
    advantage, _ = gae(signal, value, next_value, jnp.zeros((2, 1), bool), done, 0.5, 0.9)
    assert advantage[0, 0] == 0.5 * 10.0 - 1.0  # from the reset state it would be 0.5 * -10 - 1


@pytest.mark.parametrize("bootstrap_at_truncation", [True, False])
def test_values_of_successors_are_those_of_every_successor_evaluated(bootstrap_at_truncation: bool) -> None:
    """Runs side by side, with as many truncations as they happen to have, two critics each."""
    num_runs, num_steps, num_envs, obs_size = 3, 30, 5, 4
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(num_runs, 2, obs_size))
    obs, last = rng.normal(size=(num_runs, num_steps, num_envs, obs_size)), rng.normal(size=(num_runs, 1, num_envs, 4))
    terminated, truncated = rng.uniform(size=(2, num_runs, num_steps, num_envs)) < 0.1
    truncated[1] = False  # a run without a time limit
    truncated[2, :, 0] = True  # and one with a truncation in every step
    done = terminated | truncated
    no_future = terminated if bootstrap_at_truncation else done
    next_obs = np.concatenate([obs[:, 1:], last], axis=1)
    next_obs[done] = rng.normal(size=(int(done.sum()), obs_size))  # the episode's own end, not the next one's beginning

    def of_run(
        weights: jax.Array, obs: jax.Array, next_obs: jax.Array, no_future: jax.Array, done: jax.Array
    ) -> jax.Array:
        def evaluate(obs: jax.Array) -> jax.Array:
            return jnp.tanh(jnp.einsum("cd,...nd->c...n", weights, obs))

        return successor_values(evaluate, evaluate(obs), next_obs, no_future, done)

    with jax.enable_x64(True):
        found = jax.jit(jax.vmap(of_run))(*[jnp.asarray(x) for x in (weights, obs, next_obs, no_future, done)])
    expected = np.tanh(np.einsum("rcd,rtnd->rctn", weights, next_obs))
    counts = np.broadcast_to(~no_future[:, None], expected.shape)
    np.testing.assert_allclose(np.asarray(found)[counts], expected[counts], rtol=1e-12)
    assert np.all(np.isfinite(found))  # those without a future are multiplied by zero


def test_arrays_of_other_shapes_and_types_are_refused() -> None:
    """What would be broadcast without an error: a column of rewards, one environment's values, flags as numbers."""
    signal, flags = jnp.zeros((3, 2)), jnp.zeros((3, 2), bool)
    for wrong in ({"signal": signal[..., None]}, {"value": signal[:, :1]}, {"done": signal}, {"terminated": flags[:1]}):
        given = {"signal": signal, "value": signal, "next_value": signal, "terminated": flags, "done": flags} | wrong
        with pytest.raises(AssertionError):
            gae(**given, gamma=0.9, gae_lambda=0.9)
    with pytest.raises(AssertionError, match=r"\(3, 2, 1\)"):
        gae(signal[..., None], signal, signal, flags, flags, 0.9, 0.9)


def test_critics_that_return_a_column_are_refused() -> None:
    """[N, 1] in the place of [N] would become [N, N] without an error."""
    flags, next_obs = jnp.zeros((3, 2), bool), jnp.zeros((3, 2, 4))
    with pytest.raises(AssertionError, match=r"\(2, 1\)"):
        successor_values(lambda obs: obs[:, :1], jnp.zeros((3, 2)), next_obs, flags, flags)
    with pytest.raises(AssertionError):
        successor_values(lambda obs: obs[:, 0], jnp.zeros((3, 2)), next_obs[0], flags, flags)
