"""Running moments against NumPy over all samples at once."""

import jax
import jax.numpy as jnp
import numpy as np

from ccil_jax.acting import running_statistics


def batches() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = [(7, 3, 4), (1, 4), (50, 4), (2, 3, 4)]  # any leading axes
    found = [(rng.normal(3.0, 2.0, shape) * [1.0, 10.0, 0.1, 1.0]).astype(np.float32) for shape in shapes]
    for batch in found:
        batch[..., 3] = 7.0  # a constant column
    return found


def test_batches_give_the_moments_of_all_samples_together() -> None:
    statistics = running_statistics.init(4)
    for batch in batches():
        statistics = jax.jit(running_statistics.update)(statistics, jnp.asarray(batch))
    samples = np.concatenate([batch.reshape(-1, 4) for batch in batches()]).astype(np.float64)
    assert statistics.count == len(samples)
    np.testing.assert_allclose(statistics.mean, samples.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(running_statistics.std(statistics)[:3], samples.std(axis=0)[:3], rtol=1e-4)


def test_normalised_samples_have_zero_mean_and_unit_deviation_and_are_clipped() -> None:
    statistics = running_statistics.init(4)
    for batch in batches():
        statistics = running_statistics.update(statistics, jnp.asarray(batch))
    samples = np.concatenate([batch.reshape(-1, 4) for batch in batches()])
    normal = np.asarray(running_statistics.normalize(statistics, jnp.asarray(samples)))
    np.testing.assert_allclose(normal.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(normal[:, :3].std(axis=0), 1, atol=1e-4)
    far = statistics.mean + jnp.array([1e3, -1e3, 0.0, 1e3]) * running_statistics.std(statistics)
    np.testing.assert_array_equal(running_statistics.normalize(statistics, far), [5.0, -5.0, 0.0, 5.0])


def test_a_constant_column_neither_divides_by_zero_nor_explodes() -> None:
    statistics = running_statistics.update(running_statistics.init(2), jnp.full((10, 2), 3.0))
    np.testing.assert_array_equal(running_statistics.std(statistics), np.full(2, 0.01, np.float32))
    np.testing.assert_array_equal(running_statistics.normalize(statistics, jnp.full(2, 3.0)), [0.0, 0.0])
    np.testing.assert_allclose(running_statistics.normalize(statistics, jnp.full(2, 3.01)), [1.0, 1.0], rtol=1e-4)


def test_without_samples_it_only_clips() -> None:
    normal = running_statistics.normalize(running_statistics.init(3), jnp.array([0.5, -9.0, 6.0]))
    np.testing.assert_array_equal(normal, [0.5, -5.0, 5.0])
