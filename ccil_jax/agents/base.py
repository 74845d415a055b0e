"""What all agents share: the record that the training loop knows, and what they report of their episodes."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from ccil_jax.types import Metrics, Transition


class Agent(NamedTuple):
    """A learner as pure functions of one seed, to be jitted, vmapped, scanned or differentiated.

    A state has a field or property `actor`, a `ccil_jax.acting.rollout.Actor`.
    """

    init: Callable[[jax.Array], Any]  # key -> state; the key is consumed
    step: Callable[[Any], tuple[Any, Metrics]]  # state -> state after one iteration, metrics of scalars


@struct.dataclass(kw_only=True)
class EpisodeEstimates:
    """Means over the whole episodes that finished last; carried over while none finishes."""

    episode_return: jax.Array  # []
    episode_cost: jax.Array  # [] J_k; starts at the limit, so that the first gap is 0
    episode_length: jax.Array  # []


def estimate_episodes(previous: EpisodeEstimates, transition: Transition) -> tuple[EpisodeEstimates, jax.Array]:
    """Means over the whole episodes that end in this batch, or `previous` if none does; and how many did."""
    ends = transition.done & transition.whole
    count = jnp.sum(ends)

    def mean(totals: jax.Array, carried: jax.Array) -> jax.Array:
        total = jnp.sum(jnp.where(ends, totals.astype(carried.dtype), 0.0))
        return jnp.where(count > 0, total / jnp.maximum(count, 1).astype(carried.dtype), carried)

    return EpisodeEstimates(
        episode_return=mean(transition.episode_return, previous.episode_return),
        episode_cost=mean(transition.episode_cost, previous.episode_cost),
        episode_length=mean(transition.episode_length, previous.episode_length),
    ), count


def running_mean(mean: jax.Array, new: jax.Array, count: jax.Array) -> jax.Array:
    """The mean of `count` values, of which `new` is the last and `mean` that of the others."""
    return mean + (new - mean) / count.astype(mean.dtype)


def polynomial_decay_mean(mean: jax.Array, new: jax.Array, *, count: jax.Array, power: jax.Array | float) -> jax.Array:
    """A mean in which value k weighs about k^power; `new` is value `count`, and `mean` that of the values before it.

    The weight is exactly k (k + 1) ... (k + power - 1), which is 1 for power 0. Whatever their number, about the last
    1/(power + 1) of the values make up the mean, so nobody has to say beforehand how many there will be
    (Shamir and Zhang 2013, polynomial-decay averaging).
    """
    share = (power + 1) / (count.astype(mean.dtype) + power)
    return mean + (new - mean) * share


def episode_metrics(estimates: EpisodeEstimates, cost_rate: jax.Array) -> Metrics:
    """What every agent that acts reports."""
    return {
        "episode_return": estimates.episode_return,
        "episode_cost": estimates.episode_cost,
        "episode_length": estimates.episode_length,
        "cost_rate": cost_rate,
    }
