"""Random orders of samples."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int


def permutation(key: jax.Array, num_samples: int) -> Int[Array, " M"]:
    """A random order of `num_samples` indices. The key is consumed.

    One sort of random bits: half the cost of `jax.random.permutation`, whose second sort only breaks ties.
    """
    return jnp.argsort(jax.random.bits(key, (num_samples,)))


def minibatches(key: jax.Array, num_samples: int, *, minibatch_size: int, num_epochs: int) -> Int[Array, "B M"]:
    """Indices of the minibatches of `num_epochs` passes, each in a random order of its own, [B, minibatch_size].

    The last partial batch of each pass is dropped. The key is consumed.
    """
    used = num_samples // minibatch_size * minibatch_size
    orders = jax.vmap(lambda key: permutation(key, num_samples)[:used])(jax.random.split(key, num_epochs))
    return orders.reshape(-1, minibatch_size)
