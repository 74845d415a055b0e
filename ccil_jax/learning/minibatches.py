"""Random orders of samples."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

_MOST_LOW_BITS = 12  # of 32: the others tell all but a few pairs of 4,096 samples apart, and ties keep their order


def permutation(key: jax.Array, num_samples: int) -> Int[Array, " M"]:
    """A random order of `num_samples` indices. The key is consumed.

    One sort of random bits: half the cost of `jax.random.permutation`, whose second sort only breaks ties. XLA sorts a
    single array six times faster than a pair on a CPU, so few indices are the lower bits of what is sorted themselves.
    """
    bits = jax.random.bits(key, (num_samples,))
    num_low = (num_samples - 1).bit_length()
    if num_low > _MOST_LOW_BITS:
        return jnp.argsort(bits)
    ranked = jnp.sort((bits >> num_low << num_low) | jnp.arange(num_samples, dtype=bits.dtype))
    return (ranked & ((1 << num_low) - 1)).astype(jnp.int32)


def minibatches(key: jax.Array, num_samples: int, *, minibatch_size: int, num_epochs: int) -> Int[Array, "B M"]:
    """Indices of the minibatches of `num_epochs` passes, each in a random order of its own, [B, minibatch_size].

    The last partial batch of each pass is dropped. The key is consumed.
    """
    used = num_samples // minibatch_size * minibatch_size
    orders = jax.vmap(lambda key: permutation(key, num_samples)[:used])(jax.random.split(key, num_epochs))
    return orders.reshape(-1, minibatch_size)
