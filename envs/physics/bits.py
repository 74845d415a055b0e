"""float64 values as pairs of uint32, so that an engine's exact state travels through a float32 program."""

import jax
import jax.numpy as jnp

_BIAS_DIFFERENCE = 1023 - 127  # of the exponents of binary64 and binary32


def float64_bits(x: jax.Array) -> jax.Array:
    """The IEEE 754 binary64 bits of `x`, exactly.

    Args:
        x: `[n]` floating point; float64 only where x64 is enabled.

    Returns:
        `[2 n]` uint32, little-endian: the low word of each value, then its high word.
    """
    if x.dtype == jnp.float64:
        words = jax.lax.bitcast_convert_type(x, jnp.uint32)
    else:
        words = _widen(jax.lax.bitcast_convert_type(x.astype(jnp.float32), jnp.uint32))
    return words.reshape(*x.shape[:-1], 2 * x.shape[-1])


def _widen(bits: jax.Array) -> jax.Array:
    """binary32 bits `[...]` to binary64 words `[..., 2]` (low, high).

    This uses integer arithmetic only: XLA may turn subnormal floats into zero, and has no float64 without x64.
    """
    sign = bits & jnp.uint32(0x80000000)
    exponent = (bits >> 23) & jnp.uint32(0xFF)
    mantissa = bits & jnp.uint32(0x007FFFFF)
    # A subnormal number of binary32 is a normal one in binary64: its leading 1 moves to bit 23, the place of the 1
    # that a normal number does not store.
    shift = jnp.where(mantissa == 0, jnp.uint32(0), jax.lax.clz(mantissa) - 8)
    subnormal = (exponent == 0) & (mantissa != 0)
    mantissa = jnp.where(subnormal, (mantissa << shift) & jnp.uint32(0x007FFFFF), mantissa)
    wide = jnp.where(subnormal, _BIAS_DIFFERENCE + 1 - shift, exponent + _BIAS_DIFFERENCE)
    wide = jnp.where(exponent == 0xFF, jnp.uint32(0x7FF), wide)
    wide = jnp.where((exponent == 0) & (mantissa == 0) & ~subnormal, jnp.uint32(0), wide)
    high = sign | (wide << 20) | (mantissa >> 3)
    low = mantissa << 29
    return jnp.stack([low, high], axis=-1).astype(jnp.uint32)
