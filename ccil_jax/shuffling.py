"""Random orders of samples."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int


def permutation(key: jax.Array, num_samples: int) -> Int[Array, " M"]:
    """A random order of `num_samples` indices. The key is consumed.

    One sort of random bits: half the cost of `jax.random.permutation`, whose second sort only breaks ties.
    """
    return jnp.argsort(jax.random.bits(key, (num_samples,)))


def minibatches(key: jax.Array, num_samples: int, minibatch_size: int) -> Int[Array, "B M"]:
    """Indices of one epoch in a random order, [B, minibatch_size]; the last partial batch is dropped."""
    num_minibatches = num_samples // minibatch_size
    return permutation(key, num_samples)[: num_minibatches * minibatch_size].reshape(num_minibatches, minibatch_size)
