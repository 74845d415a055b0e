"""Least-squares regression of critics on returns, by minibatches and an optimiser of optax (Adam unless told)."""

import dataclasses
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float

from ccil_jax.acting import running_statistics
from ccil_jax.acting.running_statistics import RunningStatistics
from ccil_jax.learning.minibatches import minibatches
from ccil_jax.learning.optimizers import Optimizer, adam
from ccil_jax.types import PyTree


@struct.dataclass(kw_only=True)
class Critic:
    """One value function, or several with a leading axis."""

    params: PyTree  # of the network
    optimizer: PyTree  # the optimiser's state


@struct.dataclass(kw_only=True)
class NormalizedCritic(Critic):
    """A value function whose network learns targets of mean 0 and deviation 1.

    It is a class of its own, because the checkpoints of other critics have no such part.
    """

    statistics: RunningStatistics  # of all targets so far, as samples with one entry


def init(params: PyTree, learning_rate: Float[Array, ""] | float, optimizer: Optimizer = adam) -> Critic:
    """A critic with these parameters, before its first fit."""
    return Critic(params=params, optimizer=optimizer(learning_rate).init(params))


def init_normalized(
    params: PyTree, learning_rate: Float[Array, ""] | float, optimizer: Optimizer = adam
) -> NormalizedCritic:
    """As `init`, for targets of any size."""
    critic = init(params, learning_rate, optimizer)
    return NormalizedCritic(params=critic.params, optimizer=critic.optimizer, statistics=running_statistics.init(1))


def predict(apply: Callable[[PyTree, jax.Array], jax.Array], critic: Critic, obs: jax.Array) -> jax.Array:
    """The values [...] of observations [..., D], in the unit of the targets."""
    values = apply(critic.params, obs)
    if not isinstance(critic, NormalizedCritic):
        return values
    return critic.statistics.mean[0] + running_statistics.std(critic.statistics)[0] * values


def fit(
    apply: Callable[[PyTree, jax.Array], jax.Array],
    critic: Critic,
    obs: jax.Array,
    target: jax.Array,
    key: jax.Array,
    *,
    learning_rate: Float[Array, ""] | float,
    num_epochs: int,
    minibatch_size: int,
    optimizer: Optimizer = adam,
) -> tuple[Critic, jax.Array]:
    """Minimises the mean of (apply(params, obs) - target)^2 over the M samples.

    Every epoch has a new random order. Its last minibatch is left out where it would not be full. The network of a
    `NormalizedCritic` gets (target - mean) / std, with the statistics of all targets so far, these included (van
    Hasselt et al. 2016, without their correction of the last layer when the statistics move).

    Args:
        apply: the network, from parameters and observations [m, D] to values [m].
        critic: where to begin.
        obs: [M, D].
        target: [M].
        key: consumed.
        learning_rate: of `optimizer`.
        num_epochs: passes over the samples.
        minibatch_size: samples of a gradient step.
        optimizer: learning rate -> `optax.GradientTransformation`.

    Returns:
        The fitted critic, and the mean loss [] over the last epoch, in the targets' unit squared.

    Raises:
        AssertionError: the shapes do not fit, also that of what `apply` returns.
    """
    chex.assert_rank(obs, 2)
    chex.assert_shape(target, obs.shape[:1])
    rule, unit = optimizer(learning_rate), jnp.ones(())
    if isinstance(critic, NormalizedCritic):
        critic = dataclasses.replace(critic, statistics=running_statistics.update(critic.statistics, target[:, None]))
        unit = running_statistics.std(critic.statistics)[0]
        target = (target - critic.statistics.mean[0]) / unit

    def loss(params: PyTree, indices: jax.Array) -> jax.Array:
        predicted = apply(params, obs[indices])
        chex.assert_shape(predicted, indices.shape)  # [m, 1] less [m] would be [m, m] without an error
        return jnp.mean((predicted - target[indices]) ** 2)

    def descend(critic: Critic, indices: jax.Array) -> tuple[Critic, jax.Array]:
        value, gradient = jax.value_and_grad(loss)(critic.params, indices)
        updates, optimizer_state = rule.update(gradient, critic.optimizer, critic.params)
        params = optax.apply_updates(critic.params, updates)
        return dataclasses.replace(critic, params=params, optimizer=optimizer_state), value

    indices = minibatches(key, obs.shape[0], minibatch_size=minibatch_size, num_epochs=num_epochs)
    critic, losses = jax.lax.scan(descend, critic, indices)
    of_epochs = losses.reshape(num_epochs, -1)
    return critic, jnp.mean(of_epochs[-1]) * unit**2
