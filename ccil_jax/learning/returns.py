"""Generalised advantage estimation (Schulman et al. 2016), one function for reward and cost.

Shapes: T steps, N environments, D entries of an observation.
"""

from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def gae(
    signal: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    done: jax.Array,
    gamma: Float[Array, ""] | float,
    gae_lambda: Float[Array, ""] | float,
) -> tuple[jax.Array, jax.Array]:
    """Advantages and lambda-returns of reward or cost.

        delta_t = signal_t + gamma V(s_t+1) - V(s_t)
        A_t = delta_t + gamma lambda A_t+1

    where V(s_t+1) counts as 0 if the task ended at step t, and A_t+1 as 0 if the episode did.

    Args:
        signal: [T, N] reward or cost of each step.
        value: [T, N] the critic at the observation of each step.
        next_value: [T, N] the critic at the true successor. It is used unless `terminated`, so also at a time limit.
        terminated: [T, N] bool: the task ended at this step, so that nothing follows.
        done: [T, N] bool: the episode ended at this step, by termination or at its time limit.
        gamma: discount.
        gae_lambda: decay lambda of the sum of residuals delta.

    Returns:
        Advantages [T, N], and returns [T, N]: advantage + value.

    Raises:
        AssertionError: the arrays are not all [T, N], the flags are no booleans or the others no floats.
    """
    numbers, flags = [signal, value, next_value], [terminated, done]
    chex.assert_rank(numbers, 2)
    chex.assert_equal_shape([*numbers, *flags])
    chex.assert_type(numbers, float)
    chex.assert_type(flags, bool)
    residual = signal + gamma * next_value * (1 - terminated.astype(signal.dtype)) - value
    decay = gamma * gae_lambda * (1 - done.astype(signal.dtype))

    def backwards(following: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        residual_t, decay_t = step
        advantage = residual_t + decay_t * following
        return advantage, advantage

    after_last = jnp.zeros(signal.shape[1:], residual.dtype)
    _, advantage = jax.lax.scan(backwards, after_last, (residual, decay), reverse=True)
    return advantage, advantage + value


def successor_values(
    evaluate: Callable[[jax.Array], jax.Array],
    value: jax.Array,
    next_obs: jax.Array,
    no_future: jax.Array,
    done: jax.Array,
) -> jax.Array:
    """The critics at the true successors, `evaluate(next_obs[t])` for every step t that has a future.

    Within an episode the successor is the next step's observation, whose value is known from `value`. Only the
    successors at a time limit and after the last step are evaluated: they are so few that it is cheaper to evaluate
    them step by step than to evaluate the successors of all steps.

    Args:
        evaluate: the critics, from the observations [N, D] of one step to values [..., N]. Leading axes are several
            critics.
        value: [..., T, N] the critics at the observation of each step.
        next_obs: [T, N, D] the true successors.
        no_future: [T, N] bool: steps whose successor does not count.
        done: [T, N] bool: steps whose successor is not the next step's observation, because the episode ended.

    Returns:
        [..., T, N]; finite, but of no meaning, where there is no future.

    Raises:
        AssertionError: the shapes do not fit, also that of what `evaluate` returns.
    """
    chex.assert_rank(next_obs, 3)
    *_, num_steps, num_envs = value.shape
    chex.assert_shape([next_obs, no_future, done], [(num_steps, num_envs, None), *[(num_steps, num_envs)] * 2])
    chex.assert_type([no_future, done], bool)

    def fill(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        values, unknown = carry
        step = jnp.argmax(jnp.any(unknown, axis=-1))
        evaluated = evaluate(next_obs[step])
        chex.assert_shape(evaluated, (*value.shape[:-2], num_envs))
        known = jnp.where(unknown[step], evaluated, values[..., step, :])
        return values.at[..., step, :].set(known), unknown.at[step].set(False)

    def incomplete(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        _, unknown = carry
        return jnp.any(unknown)

    unknown = (done & ~no_future).at[-1].set(True)
    start = (jnp.roll(value, -1, axis=-2), unknown)
    values, _ = jax.lax.while_loop(incomplete, fill, start)
    return values
