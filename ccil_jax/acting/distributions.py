"""Diagonal Gaussians, plain or squashed into the range of the actions: the policy's distribution over actions."""

import math

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float


@struct.dataclass(kw_only=True)
class Gaussian:
    """A batch of independent normal distributions over actions."""

    mean: jax.Array  # [..., action_dim]
    log_std: jax.Array  # [action_dim], or [..., action_dim] inside a `TanhGaussian`


@struct.dataclass(kw_only=True)
class TanhGaussian:
    """Actions `center + half_range * u`, u = tanh of a Gaussian whose deviation depends on the state."""

    gaussian: Gaussian  # both leaves [..., action_dim]
    center: jax.Array  # [action_dim]
    half_range: jax.Array  # [action_dim]


def sample(distribution: Gaussian | TanhGaussian, noise: Float[Array, "... A"]) -> Float[Array, "... A"]:
    """The actions that standard normal `noise` maps to; no noise gives the mode (of the Gaussian before squashing)."""
    if isinstance(distribution, TanhGaussian):
        unit = jnp.tanh(sample(distribution.gaussian, noise))
        return _wide(distribution.center, unit) + _wide(distribution.half_range, unit) * unit
    return distribution.mean + _wide(jnp.exp(distribution.log_std), noise) * noise


def sample_unit(
    distribution: TanhGaussian, noise: Float[Array, "... A"]
) -> tuple[Float[Array, "... A"], Float[Array, "..."]]:
    """The squashed sample u in (-1, 1), before it is scaled to the actions' range, and its log density in u, nats."""
    raw = sample(distribution.gaussian, noise)
    # log(1 - tanh(x)^2), which loses no precision where tanh saturates
    log_slope = 2 * (math.log(2) - raw - jax.nn.softplus(-2 * raw))
    density = -0.5 * (noise**2 + math.log(2 * math.pi)) - distribution.gaussian.log_std - log_slope
    return jnp.tanh(raw), jnp.sum(density, axis=-1)


def log_prob(distribution: Gaussian, action: Float[Array, "... A"]) -> Float[Array, "..."]:
    """Log density of `action`, nats, summed over action dimensions."""
    standardized = (action - distribution.mean) * _wide(jnp.exp(-distribution.log_std), action)
    return -0.5 * jnp.sum(standardized**2 + math.log(2 * math.pi), axis=-1) - jnp.sum(distribution.log_std)


def kl_divergence(old: Gaussian, new: Gaussian) -> Float[Array, "..."]:
    """KL(old || new), nats, summed over action dimensions."""
    variance_ratio = jnp.exp(2 * (old.log_std - new.log_std))
    shift = (old.mean - new.mean) * _wide(jnp.exp(-new.log_std), new.mean)
    spread = _wide(new.log_std - old.log_std, shift)
    return jnp.sum(spread + 0.5 * (_wide(variance_ratio, shift) + shift**2 - 1), axis=-1)


def entropy(distribution: Gaussian) -> Float[Array, ""]:
    """Differential entropy, nats; the same in every state."""
    return jnp.sum(distribution.log_std + 0.5 * math.log(2 * math.pi * math.e))


def fisher_product(distribution: Gaussian, tangent: Gaussian) -> Gaussian:
    """The Fisher information in (mean, log_std) coordinates, per sample, times a tangent: diag(1/std^2, 2)."""
    precision = _wide(jnp.exp(-2 * distribution.log_std), tangent.mean)
    return Gaussian(mean=tangent.mean * precision, log_std=2 * tangent.log_std)


def _wide(per_action: jax.Array, like: jax.Array) -> jax.Array:
    """[..., A]: what is the same in every state, for each of the states of `like`."""
    return jnp.broadcast_to(per_action, like.shape)
