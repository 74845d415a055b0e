"""Running mean and deviation of observations (Chan et al. 1983), for normalisation.

One object normalises for policy and critics; the discriminator keeps its own over learner and expert data.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

CLIP = 5.0  # authors: normalised observations are clipped to [-5, 5]


@struct.dataclass(kw_only=True)
class RunningStatistics:
    """Moments so far."""

    count: jax.Array  # []
    mean: jax.Array  # [D]
    sum_squares: jax.Array  # [D] of deviations from the mean


def init(size: int) -> RunningStatistics:
    """No samples yet: `normalize` only clips."""
    return RunningStatistics(count=jnp.zeros(()), mean=jnp.zeros(size), sum_squares=jnp.zeros(size))


def update(statistics: RunningStatistics, samples: Float[Array, "... D"]) -> RunningStatistics:
    """Folds a batch in. Any leading axes."""
    samples = samples.reshape(-1, samples.shape[-1])
    size = samples.shape[0]
    batch_mean = jnp.mean(samples, axis=0)
    count = statistics.count + size
    delta = batch_mean - statistics.mean
    spread = jnp.sum((samples - batch_mean[None]) ** 2, axis=0) + delta**2 * (statistics.count * size / count)
    return RunningStatistics(
        count=count, mean=statistics.mean + delta * (size / count), sum_squares=statistics.sum_squares + spread
    )


def std(statistics: RunningStatistics) -> Float[Array, " D"]:
    """Population deviation; 1 before the first sample; at least 1e-2 so that a constant entry cannot explode."""
    variance = statistics.sum_squares / jnp.maximum(statistics.count, 1.0)
    return jnp.where(statistics.count > 0, jnp.maximum(jnp.sqrt(variance), 1e-2), 1.0)


def normalize(statistics: RunningStatistics | None, samples: Float[Array, "... D"]) -> Float[Array, "... D"]:
    """Zero mean, unit deviation, clipped to [-5, 5]; samples as they are where there are no statistics."""
    if statistics is None:
        return samples
    mean, deviation = (jnp.broadcast_to(x, samples.shape) for x in (statistics.mean, std(statistics)))
    return jnp.clip((samples - mean) / deviation, -CLIP, CLIP)
