"""Least-squares regression of critics on returns by minibatch Adam."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float

from ccil_jax.learning.minibatches import minibatches
from ccil_jax.learning.optimizers import Optimizer, adam
from ccil_jax.types import PyTree


@struct.dataclass(kw_only=True)
class Critic:
    """Parameters and optimiser of one value function, or of several with a leading axis."""

    params: PyTree
    optimizer: PyTree


def init(params: PyTree, learning_rate: Float[Array, ""] | float, optimizer: Optimizer = adam) -> Critic:
    """A critic that has not been fitted."""
    return Critic(params=params, optimizer=optimizer(learning_rate).init(params))


def fit(
    apply: Callable[[PyTree, jax.Array], jax.Array],
    critic: Critic,
    obs: Float[Array, "M D"],
    target: Float[Array, " M"],
    key: jax.Array,
    *,
    learning_rate: Float[Array, ""] | float,
    num_epochs: int,
    minibatch_size: int,
    optimizer: Optimizer = adam,
) -> tuple[Critic, Float[Array, ""]]:
    """Minimises mean (apply(params, obs) - target)^2; every epoch is a fresh shuffle, its last partial batch dropped.

    Returns:
        The fitted critic, and the mean loss over the last epoch.
    """
    rule = optimizer(learning_rate)

    def loss(params: PyTree, indices: jax.Array) -> jax.Array:
        return jnp.mean((apply(params, obs[indices]) - target[indices]) ** 2)

    def descend(critic: Critic, indices: jax.Array) -> tuple[Critic, jax.Array]:
        value, gradient = jax.value_and_grad(loss)(critic.params, indices)
        updates, optimizer_state = rule.update(gradient, critic.optimizer)
        return Critic(params=optax.apply_updates(critic.params, updates), optimizer=optimizer_state), value

    indices = minibatches(key, obs.shape[0], minibatch_size=minibatch_size, num_epochs=num_epochs)
    critic, losses = jax.lax.scan(descend, critic, indices)
    return critic, jnp.mean(losses.reshape(num_epochs, -1)[-1])
