"""Generalised advantage estimation (Schulman et al. 2016), the same function for reward and cost."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def gae(
    signal: Float[Array, "T N"],
    value: Float[Array, "T N"],
    next_value: Float[Array, "T N"],
    terminated: Bool[Array, "T N"],
    done: Bool[Array, "T N"],
    gamma: Float[Array, ""] | float,
    gae_lambda: Float[Array, ""] | float,
) -> tuple[Float[Array, "T N"], Float[Array, "T N"]]:
    """Advantages and lambda-returns of reward or cost.

    Args:
        signal: reward or cost of each step.
        value: critic at `obs`.
        next_value: critic at the true successor; used unless `terminated`, so also at a time limit.
        terminated: the task ended at this step: nothing follows.
        done: terminated or truncated: the sum of residuals stops here. A superset of `terminated`.
        gamma: discount.
        gae_lambda: decay of the sum of residuals.

    Returns:
        (advantage, advantage + value).
    """
    residual = signal + gamma * next_value * (1 - terminated.astype(signal.dtype)) - value
    decay = gamma * gae_lambda * (1 - done.astype(signal.dtype))

    def backwards(following: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        residual_t, decay_t = step
        advantage = residual_t + decay_t * following
        return advantage, advantage

    _, advantage = jax.lax.scan(backwards, jnp.zeros_like(residual[0]), (residual, decay), reverse=True)
    return advantage, advantage + value


def successor_values(
    evaluate: Callable[[Float[Array, "N D"]], Float[Array, "... N"]],
    value: Float[Array, "... T N"],
    next_obs: Float[Array, "T N D"],
    no_future: Bool[Array, "T N"],
    done: Bool[Array, "T N"],
) -> Float[Array, "... T N"]:
    """What critics say of the successors: `evaluate(next_obs[t])` for every t, where there is a future.

    Within an episode the successor is the next step's observation, whose value is known. What is left is the last step
    and those with a time limit's: few, so that evaluating them one by one is cheaper than evaluating all.

    Args:
        evaluate: the critics, of one step's observations.
        value: the critics at `obs`.
        next_obs: the true successors.
        no_future: steps whose successor does not count.
        done: steps whose successor is not the next step's observation.
    """

    def fill(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        values, unknown = carry
        step = jnp.argmax(jnp.any(unknown, axis=-1))
        known = jnp.where(unknown[step], evaluate(next_obs[step]), values[..., step, :])
        return values.at[..., step, :].set(known), unknown.at[step].set(False)

    unknown = (done & ~no_future).at[-1].set(True)
    start = (jnp.roll(value, -1, axis=-2), unknown)
    return jax.lax.while_loop(lambda carry: jnp.any(carry[1]), fill, start)[0]
