"""Running mean and standard deviation of observations (Chan et al. 1983), to normalise what networks get.

Policy and critics share one object. The discriminator has its own, over observations of the learner and of the expert.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

CLIP = 5.0  # normalised observations are clipped to [-5, 5], as in the authors' code


@struct.dataclass(kw_only=True)
class RunningStatistics:
    """Moments of all samples so far."""

    count: jax.Array  # [] float: number of samples
    mean: jax.Array  # [D]
    sum_squares: jax.Array  # [D] of deviations from the mean


def init(size: int) -> RunningStatistics:
    """Statistics of no samples. With them, `normalize` clips and does nothing else."""
    return RunningStatistics(count=jnp.zeros(()), mean=jnp.zeros(size), sum_squares=jnp.zeros(size))


def update(statistics: RunningStatistics, samples: Float[Array, "... D"]) -> RunningStatistics:
    """The statistics with a batch of samples added, which may have any leading axes."""
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
    """Standard deviation over all samples; 1 before the first sample.

    It is at least 1e-2, so that an entry that was constant so far cannot become huge when it changes.
    """
    variance = statistics.sum_squares / jnp.maximum(statistics.count, 1.0)
    return jnp.where(statistics.count > 0, jnp.maximum(jnp.sqrt(variance), 1e-2), 1.0)


def normalize(statistics: RunningStatistics | None, samples: Float[Array, "... D"]) -> Float[Array, "... D"]:
    """(samples - mean) / std, clipped to [-5, 5]. Where there are no statistics (None), the samples as they are."""
    if statistics is None:
        return samples
    mean, deviation = (jnp.broadcast_to(x, samples.shape) for x in (statistics.mean, std(statistics)))
    return jnp.clip((samples - mean) / deviation, -CLIP, CLIP)
