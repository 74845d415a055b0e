"""Diagonal Gaussian with state-independent deviation: the policy's distribution over actions."""

import math

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float


@struct.dataclass(kw_only=True)
class Gaussian:
    """A batch of independent normal distributions over actions."""

    mean: jax.Array  # [..., action_dim]
    log_std: jax.Array  # [action_dim]


def sample(distribution: Gaussian, noise: Float[Array, "... A"]) -> Float[Array, "... A"]:
    """The actions that standard normal `noise` maps to."""
    return distribution.mean + jnp.exp(distribution.log_std) * noise


def log_prob(distribution: Gaussian, action: Float[Array, "... A"]) -> Float[Array, "..."]:
    """Log density of `action`, nats, summed over action dimensions."""
    standardized = (action - distribution.mean) * jnp.exp(-distribution.log_std)
    return -0.5 * jnp.sum(standardized**2 + math.log(2 * math.pi), axis=-1) - jnp.sum(distribution.log_std)


def kl_divergence(old: Gaussian, new: Gaussian) -> Float[Array, "..."]:
    """KL(old || new), nats, summed over action dimensions."""
    variance_ratio = jnp.exp(2 * (old.log_std - new.log_std))
    shift = (old.mean - new.mean) * jnp.exp(-new.log_std)
    return jnp.sum(new.log_std - old.log_std + 0.5 * (variance_ratio + shift**2 - 1), axis=-1)


def entropy(distribution: Gaussian) -> Float[Array, ""]:
    """Differential entropy, nats; the same in every state."""
    return jnp.sum(distribution.log_std + 0.5 * math.log(2 * math.pi * math.e))


def fisher_product(distribution: Gaussian, tangent: Gaussian) -> Gaussian:
    """The Fisher information in (mean, log_std) coordinates, per sample, times a tangent: diag(1/std^2, 2)."""
    return Gaussian(mean=tangent.mean * jnp.exp(-2 * distribution.log_std), log_std=2 * tangent.log_std)
