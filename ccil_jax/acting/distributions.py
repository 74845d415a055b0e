"""The policy's distribution over actions: a diagonal Gaussian, plain, censored at the bounds, or squashed."""

import math

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

LARGEST_UNIT = 1 - 1e-3  # a squashed action nearer to a bound counts as one here: at the bound, atanh is infinite


@struct.dataclass(kw_only=True)
class Gaussian:
    """Normal distributions over actions, one for each state of a batch; entries of an action are independent."""

    mean: jax.Array  # [..., action_dim]
    log_std: jax.Array  # [action_dim], the same in every state; [..., action_dim] inside a `TanhGaussian`


@struct.dataclass(kw_only=True)
class CensoredGaussian:
    """Actions as they are executed: those of a Gaussian, clipped to the range of the actions.

    Inside the range an action has the Gaussian's density. At a bound it stands for every draw at the bound or beyond,
    and has the probability of that tail (Fujita and Maeda 2018, "Clipped action policy gradient").
    """

    gaussian: Gaussian
    low: jax.Array  # [action_dim], -inf where there is no bound
    high: jax.Array  # [action_dim], inf where there is no bound


@struct.dataclass(kw_only=True)
class TanhGaussian:
    """Actions center + half_range * u, where u is tanh of a Gaussian whose standard deviation depends on the state."""

    gaussian: Gaussian  # both leaves [..., action_dim]
    center: jax.Array  # [action_dim]
    half_range: jax.Array  # [action_dim]


def gaussian_of(distribution: Gaussian | CensoredGaussian | TanhGaussian) -> Gaussian:
    """The Gaussian before its draws are clipped or squashed."""
    return distribution if isinstance(distribution, Gaussian) else distribution.gaussian


def sample(
    distribution: Gaussian | CensoredGaussian | TanhGaussian, noise: Float[Array, "... A"]
) -> Float[Array, "... A"]:
    """The actions that standard normal `noise` maps to: mean + std * noise, clipped or squashed as the distribution is.

    Zero noise gives the mode (that of the Gaussian before it is squashed).
    """
    if isinstance(distribution, CensoredGaussian):
        raw = sample(distribution.gaussian, noise)
        return jnp.clip(raw, _wide(distribution.low, raw), _wide(distribution.high, raw))
    if isinstance(distribution, TanhGaussian):
        unit = jnp.tanh(sample(distribution.gaussian, noise))
        return _wide(distribution.center, unit) + _wide(distribution.half_range, unit) * unit
    return distribution.mean + _wide(jnp.exp(distribution.log_std), noise) * noise


def sample_unit(
    distribution: TanhGaussian, noise: Float[Array, "... A"]
) -> tuple[Float[Array, "... A"], Float[Array, "..."]]:
    """The squashed sample u in (-1, 1), before it is scaled to the range of the actions, and its log density, nats.

    The density is that of u: log N(x; mean, std) - log(1 - tanh(x)^2), summed over the entries of x = atanh(u).
    """
    raw = sample(distribution.gaussian, noise)
    density = _unit_log_density(noise, distribution.gaussian.log_std, raw)
    return jnp.tanh(raw), jnp.sum(density, axis=-1)


def _unit_log_density(noise: jax.Array, log_std: jax.Array, raw: jax.Array) -> jax.Array:
    """Log densities [..., A] of the entries of u = tanh(raw), where raw = mean + std * noise."""
    # log(1 - tanh(x)^2) in a form that loses no precision where tanh is close to 1 or -1
    log_slope = 2 * (math.log(2) - raw - jax.nn.softplus(-2 * raw))
    return -0.5 * (noise**2 + math.log(2 * math.pi)) - log_std - log_slope


def log_prob(
    distribution: Gaussian | CensoredGaussian | TanhGaussian, action: Float[Array, "... A"]
) -> Float[Array, "..."]:
    """Log likelihood of `action`, nats, summed over its entries; an action beyond a bound counts as one at the bound.

    It is the log density, and for an entry at a bound of a `CensoredGaussian` log Phi of the tail,

        log Phi((low - mean) / std)  and  log Phi((mean - high) / std).

    An entry of a `TanhGaussian` that is nearer to a bound than a thousandth of the half range counts as one there.
    """
    if isinstance(distribution, CensoredGaussian):
        return _censored_log_prob(distribution, action)
    if isinstance(distribution, TanhGaussian):
        return _squashed_log_prob(distribution, action)
    standardized = (action - distribution.mean) * _wide(jnp.exp(-distribution.log_std), action)
    return -0.5 * jnp.sum(standardized**2 + math.log(2 * math.pi), axis=-1) - jnp.sum(distribution.log_std)


def _censored_log_prob(distribution: CensoredGaussian, action: jax.Array) -> jax.Array:
    mean, log_std = distribution.gaussian.mean, _wide(distribution.gaussian.log_std, action)
    low, high = _wide(distribution.low, action), _wide(distribution.high, action)
    at_bound = (action <= low) | (action >= high)
    beyond = jnp.where(action <= low, low - mean, mean - high)  # from the mean to the bound, positive if it is beyond
    standardized = jnp.where(at_bound, beyond, action - mean) * jnp.exp(-log_std)
    # 0 where it is not needed: there a bound may be infinite, and infinity times a derivative of 0 is NaN.
    tail = jax.scipy.special.log_ndtr(jnp.where(at_bound, standardized, 0.0))
    # Added up as the Gaussian's are, so that without an entry at a bound the sum is the same to the last bit.
    quadratic = jnp.where(at_bound, -2 * tail, standardized**2 + math.log(2 * math.pi))
    return -0.5 * jnp.sum(quadratic, axis=-1) - jnp.sum(jnp.where(at_bound, 0.0, log_std), axis=-1)


def _squashed_log_prob(distribution: TanhGaussian, action: jax.Array) -> jax.Array:
    unit = (action - _wide(distribution.center, action)) / _wide(distribution.half_range, action)
    raw = jnp.arctanh(jnp.clip(unit, -LARGEST_UNIT, LARGEST_UNIT))
    noise = (raw - distribution.gaussian.mean) * jnp.exp(-distribution.gaussian.log_std)
    density = _unit_log_density(noise, distribution.gaussian.log_std, raw)
    return jnp.sum(density, axis=-1) - jnp.sum(jnp.log(distribution.half_range))


def kl_divergence(old: Gaussian | CensoredGaussian, new: Gaussian | CensoredGaussian) -> Float[Array, "..."]:
    """The Kullback-Leibler divergence KL(old || new), nats, summed over the entries of the action.

    That of the Gaussians. Clipping both alike can only lower it (data processing inequality), so for censored ones it
    is an upper bound.
    """
    old, new = gaussian_of(old), gaussian_of(new)
    variance_ratio = jnp.exp(2 * (old.log_std - new.log_std))
    shift = (old.mean - new.mean) * _wide(jnp.exp(-new.log_std), new.mean)
    spread = _wide(new.log_std - old.log_std, shift)
    return jnp.sum(spread + 0.5 * (_wide(variance_ratio, shift) + shift**2 - 1), axis=-1)


def entropy(distribution: Gaussian | CensoredGaussian) -> Float[Array, ""]:
    """Differential entropy of the Gaussian, nats. It is the same in every state, as the standard deviations are."""
    return jnp.sum(gaussian_of(distribution).log_std + 0.5 * math.log(2 * math.pi * math.e))


def fisher_product(distribution: Gaussian, tangent: Gaussian) -> Gaussian:
    """The Fisher matrix of one sample in the coordinates (mean, log_std), diag(1 / std^2, 2), times `tangent`."""
    precision = _wide(jnp.exp(-2 * distribution.log_std), tangent.mean)
    return Gaussian(mean=tangent.mean * precision, log_std=2 * tangent.log_std)


def _wide(per_action: jax.Array, like: jax.Array) -> jax.Array:
    """What is the same in every state, [A], repeated for each of the states of `like`, [..., A]."""
    return jnp.broadcast_to(per_action, like.shape)
