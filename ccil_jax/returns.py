"""Generalised advantage estimation (Schulman et al. 2016), the same function for reward and cost."""

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
    residual = signal + gamma * next_value * (1 - terminated) - value
    decay = gamma * gae_lambda * (1 - done)

    def backwards(following: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        residual_t, decay_t = step
        advantage = residual_t + decay_t * following
        return advantage, advantage

    _, advantage = jax.lax.scan(backwards, jnp.zeros_like(residual[0]), (residual, decay), reverse=True)
    return advantage, advantage + value
