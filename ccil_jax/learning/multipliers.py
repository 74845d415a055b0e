"""Lagrange multipliers without gradient ascent: the optimal one of a trust region, and a PID controller's."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float


def optimal_weights(
    gram: Float[Array, "2 2"], gap: Float[Array, ""], max_kl: Float[Array, ""] | float
) -> Float[Array, " 2"]:
    """Weights [w_r, w_c] with which w_r x_r + w_c x_c is the direction of constrained policy optimisation.

    In constrained policy optimisation (Achiam et al. 2017), the step d of the parameters solves

        maximise g_r.d  subject to  gap + g_c.d <= 0  and  d.F d / 2 <= max_kl

    with the gradients g of reward and cost and the Fisher matrix F. The objective is linear, so the solution lies on
    the boundary of the trust region, and only its direction is needed. That is x_r - nu x_c, with the natural
    directions x = F^-1 g, and with the multiplier

        nu = max(0, (r + sqrt(A / B) gap) / s),  A = q - r^2 / s,  B = 2 max_kl - gap^2 / s,
        q = g_r.x_r,  r = g_r.x_c,  s = g_c.x_c

    Args:
        gram: [[q, r], [r, s]].
        gap: by how much the surrogate of the cost, per step, exceeds its limit before the step.
        max_kl: radius of the trust region, nats.

    Returns:
        [1, 0] if the step for the reward alone keeps the limit, or if no step changes the cost.
        [1, -nu] if the limit binds.
        [0, -1], which only lowers the cost, if it is above the limit and no step within the radius reaches the limit,
        or if reward and cost rise along the same line, so that no reward can be gained without cost.
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
    """The gains of the controller. Errors are relative to the limit, so the same gains suit tasks of any cost scale."""

    proportional: Float[Array, ""] | float
    integral: Float[Array, ""] | float
    derivative: Float[Array, ""] | float
    smoothing: Float[Array, ""] | float  # beta in e = beta e_before + (1 - beta) error; 0 does not smooth


@struct.dataclass(kw_only=True)
class Pid:
    """The controller between two updates."""

    multiplier: jax.Array  # [] the controller's output lambda
    integral: jax.Array  # [] the sum of errors times the integral gain, in [0, maximum]
    error: jax.Array  # [] the smoothed error e


def pid_init(initial: Float[Array, ""] | float) -> Pid:
    """The controller at the multiplier `initial`, which is the initial value of the integral."""
    start, zero = jnp.asarray(initial, jnp.result_type(float)), jnp.zeros(())
    return Pid(multiplier=start, integral=start, error=zero)


def pid_step(state: Pid, error: Float[Array, ""], gains: Gains, maximum: Float[Array, ""] | float) -> Pid:
    """lambda = kp e + I + kd max(0, e - e_before), clipped to [0, maximum] (Stooke et al. 2020).

    e is the smoothed error, and the integral I the sum of ki times the error, which is not smoothed. I is clipped to
    [0, maximum] too: outside, it would go on to grow without effect, and take as many updates to come back (wind-up).
    """
    smoothed = gains.smoothing * state.error + (1 - gains.smoothing) * error
    integral = jnp.clip(state.integral + gains.integral * error, 0.0, maximum)
    rising = jnp.maximum(smoothed - state.error, 0.0)
    output = gains.proportional * smoothed + integral + gains.derivative * rising
    return Pid(multiplier=jnp.clip(output, 0.0, maximum), integral=integral, error=smoothed)
