"""Minibatches: random orders of samples, cut into parts of equal size."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

# At most 12 of 32 bits hold the index, for 4,096 samples. The other 20 are random: few pairs of samples have the same.
_MOST_LOW_BITS = 12


def permutation(key: jax.Array, num_samples: int) -> Int[Array, " M"]:
    """A random order of the indices 0 to `num_samples` - 1, int32 [num_samples]. The key is consumed.

    The indices are sorted by random bits, once. `jax.random.permutation` sorts twice, so that ties are broken at random
    too, and takes twice as long. On a CPU, XLA sorts one array six times faster than a pair of arrays. So for few
    samples, random bits and index are put into one number: the index in the lower bits.
    """
    bits = jax.random.bits(key, (num_samples,))
    num_low = (num_samples - 1).bit_length()
    if num_low > _MOST_LOW_BITS:
        return jnp.argsort(bits)
    ranked = jnp.sort((bits >> num_low << num_low) | jnp.arange(num_samples, dtype=bits.dtype))
    return (ranked & ((1 << num_low) - 1)).astype(jnp.int32)


def minibatches(key: jax.Array, num_samples: int, *, minibatch_size: int, num_epochs: int) -> Int[Array, "B M"]:
    """The indices of the samples in each minibatch, [B, minibatch_size], of `num_epochs` passes over all samples.

    Every pass has a random order of its own. Its last minibatch is left out where it would not be full. The key is
    consumed.
    """
    used = num_samples // minibatch_size * minibatch_size
    orders = jax.vmap(lambda key: permutation(key, num_samples)[:used])(jax.random.split(key, num_epochs))
    return orders.reshape(-1, minibatch_size)
