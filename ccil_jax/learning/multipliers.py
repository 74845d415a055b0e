"""Multipliers that no gradient ascends: the optimal one of a trust region, and a PID controller's."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float


def optimal_weights(
    gram: Float[Array, "2 2"], gap: Float[Array, ""], max_kl: Float[Array, ""] | float
) -> Float[Array, " 2"]:
    """Weights of [x_r, x_c] whose step, scaled to the radius, is that of constrained policy optimisation.

    Achiam et al. (2017). The step s maximises g_r.s subject to gap + g_c.s <= 0 and s.F s / 2 <= max_kl. Its solution
    lies on the radius (the objective is linear), so a direction is all there is to find: x_r - nu x_c with the
    multiplier nu, from

        q = g_r.x_r, r = g_r.x_c, s = g_c.x_c,  A = q - r^2 / s,  B = 2 max_kl - gap^2 / s

    Args:
        gram: [[q, r], [r, s]].
        gap: by how much the surrogate of the cost, per step, exceeds its limit now.
        max_kl: radius, nats.

    Returns:
        [1, 0] where the plain step keeps the limit, or no step can change the cost; [1, -nu] where the limit binds;
        [0, -1], the recovery, where no step within the radius reaches it, or above it where reward and cost rise along
        the same line, so that nothing is left to gain.
    """
    q, r, s = gram[0, 0], gram[0, 1], gram[1, 1]
    felt = s > jnp.finfo(gram.dtype).tiny
    safe_s = jnp.where(felt, s, 1.0)
    room = 2 * max_kl - gap**2 / safe_s  # B
    unexplained = jnp.maximum(q - r**2 / safe_s, 0.0)  # A
    plain = gap + jnp.sqrt(2 * max_kl / jnp.where(q > 0, q, 1.0)) * r <= 0
    inverse_scale = jnp.sqrt(unexplained / jnp.where(room > 0, room, 1.0))
    nu = jnp.maximum((r + inverse_scale * gap) / safe_s, 0.0)
    bound = jnp.stack([jnp.ones_like(nu), jnp.where(plain | ~felt, 0.0, -nu)])
    one_line = unexplained <= 10 * jnp.finfo(gram.dtype).eps * q
    recover = felt & (gap > 0) & ((room <= 0) | one_line) & ~plain
    return jnp.where(recover, jnp.array([0.0, -1.0], gram.dtype), bound)


class Gains(NamedTuple):
    """Of the controller; errors are relative to the limit, so that the gains suit all tasks."""

    proportional: Float[Array, ""] | float
    integral: Float[Array, ""] | float
    derivative: Float[Array, ""] | float
    smoothing: Float[Array, ""] | float  # share of the previous smoothed error that stays


@struct.dataclass(kw_only=True)
class Pid:
    """The controller between two updates."""

    multiplier: jax.Array  # [] its output
    integral: jax.Array  # [] sum of errors times the gain, in [0, maximum]
    error: jax.Array  # [] smoothed


def pid_init(initial: Float[Array, ""] | float) -> Pid:
    """Starts at the multiplier `initial`, as if it had been integrated."""
    start, zero = jnp.asarray(initial, jnp.result_type(float)), jnp.zeros(())
    return Pid(multiplier=start, integral=start, error=zero)


def pid_step(state: Pid, error: Float[Array, ""], gains: Gains, maximum: Float[Array, ""] | float) -> Pid:
    """lambda = max(0, kp e + ki sum(e) + kd max(0, de)) (Stooke et al. 2020), e smoothed.

    The integral is clipped to [0, maximum]: beyond, it would wind up and take as many updates to come back.
    """
    smoothed = gains.smoothing * state.error + (1 - gains.smoothing) * error
    integral = jnp.clip(state.integral + gains.integral * error, 0.0, maximum)
    rising = jnp.maximum(smoothed - state.error, 0.0)
    output = gains.proportional * smoothed + integral + gains.derivative * rising
    return Pid(multiplier=jnp.clip(output, 0.0, maximum), integral=integral, error=smoothed)
