"""The diagonal Gaussian against SciPy and quadrature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from ccil_jax.acting import distributions
from ccil_jax.acting.distributions import Gaussian

MEAN, LOG_STD = np.array([[0.5, -1.0], [2.0, 0.0]]), np.array([0.3, -0.7])
OTHER_MEAN, OTHER_LOG_STD = np.array([[0.1, -0.8], [1.5, 0.4]]), np.array([-0.2, 0.1])


def gaussian(mean: np.ndarray = MEAN, log_std: np.ndarray = LOG_STD) -> Gaussian:
    return Gaussian(mean=jnp.asarray(mean), log_std=jnp.asarray(log_std))


def test_log_prob_is_scipys() -> None:
    action = np.array([[0.0, 0.0], [3.0, -2.0]])
    expected = scipy.stats.norm.logpdf(action, MEAN, np.exp(LOG_STD)).sum(axis=-1)
    np.testing.assert_allclose(distributions.log_prob(gaussian(), jnp.asarray(action)), expected, rtol=1e-5)


def test_entropy_is_scipys_and_the_same_in_every_state() -> None:
    expected = scipy.stats.norm.entropy(0, np.exp(LOG_STD)).sum()
    entropy = distributions.entropy(gaussian())
    assert entropy.shape == ()
    np.testing.assert_allclose(entropy, expected, rtol=1e-5)


def test_kl_is_the_integral_of_its_definition_old_first() -> None:
    def integral(mean: float, log_std: float, other_mean: float, other_log_std: float) -> float:
        p, q = scipy.stats.norm(mean, np.exp(log_std)), scipy.stats.norm(other_mean, np.exp(other_log_std))
        return float(scipy.integrate.quad(lambda x: p.pdf(x) * (p.logpdf(x) - q.logpdf(x)), -20, 20)[0])

    expected = [
        sum(integral(MEAN[i, j], LOG_STD[j], OTHER_MEAN[i, j], OTHER_LOG_STD[j]) for j in range(2)) for i in range(2)
    ]
    divergence = distributions.kl_divergence(gaussian(), gaussian(OTHER_MEAN, OTHER_LOG_STD))
    np.testing.assert_allclose(divergence, expected, rtol=1e-5)
    assert np.all(distributions.kl_divergence(gaussian(), gaussian()) == 0)


def test_sample_scales_and_shifts_the_noise() -> None:
    sample = distributions.sample(gaussian(), jnp.array([[1.0, 0.0], [0.0, -2.0]]))
    expected = [[0.5 + np.exp(0.3), -1.0], [2.0, -2 * np.exp(-0.7)]]
    np.testing.assert_allclose(sample, expected, rtol=1e-6)


@pytest.mark.parametrize("dimension", range(2))
def test_fisher_product_is_the_curvature_of_the_divergence(dimension: int) -> None:
    """Per sample, KL(p || p + h v) = h^2 / 2 v.M v, so its second difference is v.M v."""
    with jax.enable_x64(True):
        at = gaussian(MEAN[:1], LOG_STD)
        for mean, log_std in ((np.eye(2)[dimension], np.zeros(2)), (np.zeros(2), np.eye(2)[dimension])):
            tangent = gaussian(mean[None], log_std)
            image = distributions.fisher_product(at, tangent)
            product = jnp.sum(image.mean * tangent.mean) + jnp.sum(image.log_std * tangent.log_std)
            h = 1e-4
            moved = [gaussian(MEAN[:1] + s * h * mean[None], LOG_STD + s * h * log_std) for s in (1, -1)]
            curvature = sum(distributions.kl_divergence(at, other)[0] for other in moved) / h**2
            np.testing.assert_allclose(product, curvature, rtol=1e-5)


def test_a_squashed_sample_has_the_density_of_a_change_of_variables() -> None:
    """log p(u) = log N(atanh u) + log d(atanh u) / du, by SciPy in float64; and it integrates to 1."""
    gaussian = distributions.Gaussian(mean=jnp.array([[0.3, -1.0]]), log_std=jnp.array([[-0.7, 0.2]]))
    squashed = distributions.TanhGaussian(
        gaussian=gaussian, center=jnp.array([1.0, 0.0]), half_range=jnp.array([0.5, 2.0])
    )
    noise = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32)
    unit, log_prob = distributions.sample_unit(squashed, jnp.asarray(noise))
    raw = np.asarray(gaussian.mean, np.float64) + np.exp(np.asarray(gaussian.log_std, np.float64)) * noise
    expected = scipy.stats.norm.logpdf(raw, gaussian.mean, np.exp(gaussian.log_std)) - np.log1p(-(np.tanh(raw) ** 2))
    np.testing.assert_allclose(log_prob, expected.sum(axis=-1), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(
        distributions.sample(squashed, jnp.asarray(noise)),
        [1.0, 0.0] + np.array([0.5, 2.0]) * np.asarray(unit),
        rtol=1e-6,
    )
    far = distributions.sample_unit(squashed, jnp.full((1, 2), 40.0))[1]
    assert np.isfinite(far).all()
