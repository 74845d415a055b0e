"""The diagonal Gaussian, plain, squashed and censored, against SciPy and quadrature."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from ccil_jax.acting import distributions
from ccil_jax.acting.distributions import LARGEST_UNIT, CensoredGaussian, Gaussian, TanhGaussian
from ccil_jax.agents import build, on_policy
from ccil_jax.agents.expert import expert_data
from ccil_jax.types import Transition
from envs.base import State
from envs.jax_tools import full_precision
from tests.probe_envs import Probe, assert_same_bits, same_bits, walk_config, walk_demonstrations

pytestmark = pytest.mark.once

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


def squashed(mean: Any, std: Any) -> TanhGaussian:
    """Actions within [-1, 3], [2, 3], one Gaussian for each state."""
    gaussian = Gaussian(mean=jnp.asarray(mean), log_std=jnp.log(jnp.asarray(std)))
    return TanhGaussian(gaussian=gaussian, center=jnp.array([1.0, 2.5]), half_range=jnp.array([2.0, 0.5]))


def test_the_likelihood_of_a_squashed_action_is_that_of_the_change_of_variables() -> None:
    """Against SciPy, against quadrature, and against the density of a draw."""
    with jax.enable_x64(True):
        mean, std = np.array([[0.3, -0.8], [-1.0, 0.5]]), np.array([[0.5, 1.1], [0.9, 0.4]])
        unit = np.array([[0.2, -0.9], [0.99, 0.0]])
        action = np.array([1.0, 2.5]) + np.array([2.0, 0.5]) * unit
        density = scipy.stats.norm.logpdf(np.arctanh(unit), mean, std) - np.log(1 - unit**2) - np.log([2.0, 0.5])
        found = distributions.log_prob(squashed(mean, std), jnp.asarray(action))
        np.testing.assert_allclose(found, density.sum(axis=-1), rtol=1e-10)

        one = TanhGaussian(
            gaussian=Gaussian(mean=jnp.array([[0.3]]), log_std=jnp.array([[-1.0]])),
            center=jnp.array([1.0]),
            half_range=jnp.array([2.0]),
        )
        total = scipy.integrate.quad(lambda a: np.exp(distributions.log_prob(one, jnp.array([[a]]))[0]), -1, 3)[0]
        np.testing.assert_allclose(total, 1, rtol=1e-6)

        noise = jnp.asarray([[0.4, -1.2], [-0.3, 0.1]])
        drawn, likelihood = distributions.sample_unit(squashed(mean, std), noise)
        action = np.array([1.0, 2.5]) + np.array([2.0, 0.5]) * np.asarray(drawn)
        found = distributions.log_prob(squashed(mean, std), jnp.asarray(action))
        np.testing.assert_allclose(found, likelihood - np.log(2.0 * 0.5), rtol=1e-8)


def test_a_squashed_action_at_a_bound_counts_as_one_just_inside() -> None:
    """Where its likelihood and the derivatives of that are finite."""
    at, inside = (np.array([1.0, 2.5]) + np.array([2.0, 0.5]) * unit for unit in (1.0, LARGEST_UNIT))

    def likelihood(mean: jax.Array, action: np.ndarray) -> jax.Array:
        return distributions.log_prob(squashed(mean, [[0.5, 1.1]]), jnp.asarray(action, jnp.float32)[None])[0]

    mean = jnp.array([[0.3, -0.8]])
    found, slope = jax.value_and_grad(likelihood)(mean, at)
    np.testing.assert_allclose(found, likelihood(mean, inside), rtol=1e-3)
    np.testing.assert_allclose(slope, (np.arctanh(LARGEST_UNIT) - mean) / np.array([0.5, 1.1]) ** 2, rtol=1e-3)


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


# Censored ------------------------------------------------------------------------------------------------------------

INF = np.inf
CENSORED = [  # mean, log-std, low, high of one entry
    (0.2, -0.5, -1.0, 1.0),
    (1.4, 0.1, -1.0, 1.0),  # mostly at a bound
    (-1.6, -1.0, -1.0, 0.5),  # nearly always at a bound
    (0.3, 0.2, -INF, 0.7),
    (-0.1, -0.8, -0.2, INF),
    (0.5, 0.3, -INF, INF),
]


def censored(mean: Any, log_std: Any, low: Any, high: Any) -> CensoredGaussian:
    """Of numbers or of [..., A] and [A]."""
    entries = (jnp.atleast_1d(jnp.asarray(value, jnp.result_type(float))) for value in (log_std, low, high))
    log_std, low, high = entries
    mean = jnp.atleast_1d(jnp.asarray(mean, jnp.result_type(float)))
    return CensoredGaussian(gaussian=Gaussian(mean=mean, log_std=log_std), low=low, high=high)


def probability(numbers: tuple[float, ...], action: float) -> float:
    """The density inside the range, the probability at a bound, by SciPy."""
    mean, log_std, low, high = numbers
    normal = scipy.stats.norm(mean, np.exp(log_std))
    return float(normal.cdf(low) if action <= low else normal.sf(high) if action >= high else normal.pdf(action))


def integral(numbers: tuple[float, ...], value: Any) -> float:
    """The expectation of `value(action)`: both tails and the inside, by quadrature."""
    mean, log_std, low, high = numbers
    std = np.exp(log_std)
    inside = max(low, mean - 12 * std), min(high, mean + 12 * std)
    total, _ = scipy.integrate.quad(
        lambda x: value(x) * probability(numbers, x) if low < x < high else 0.0,
        *inside,
        points=[x for x in (mean,) if inside[0] < x < inside[1]] or None,
        epsabs=1e-12,
        limit=200,
    )
    return float(total) + sum(value(bound) * probability(numbers, bound) for bound in (low, high) if np.isfinite(bound))


@pytest.mark.parametrize("numbers", CENSORED)
def test_the_likelihood_of_a_censored_action_is_scipys_and_its_total_is_1(numbers: tuple[float, ...]) -> None:
    mean, log_std, low, high = numbers
    with jax.enable_x64(True):
        log_prob = jax.jit(lambda action: distributions.log_prob(censored(*numbers), action[..., None]))
        nodes, weights = np.polynomial.legendre.leggauss(200)
        ends = np.clip([low, high], mean - 12 * np.exp(log_std), mean + 12 * np.exp(log_std))
        inside = ends.mean() + nodes * np.diff(ends) / 2
        found = np.exp(log_prob(jnp.asarray(inside)))
        bounds = [bound for bound in (low, high) if np.isfinite(bound)]
        tails = np.exp(log_prob(jnp.asarray(bounds))) if bounds else np.zeros(0)
        beyond = [bound + sign * 3 for bound, sign in ((low, -1), (high, 1)) if np.isfinite(bound)]
        assert same_bits(log_prob(jnp.asarray(beyond)), log_prob(jnp.asarray(bounds)))  # count as at the bound
    np.testing.assert_allclose(found, [probability(numbers, x) for x in inside], rtol=1e-10)
    np.testing.assert_allclose(tails, [probability(numbers, x) for x in bounds], rtol=1e-10)
    np.testing.assert_allclose(np.sum(weights * found) * np.diff(ends) / 2 + np.sum(tails), 1.0, rtol=1e-8)


def stratified(size: int) -> np.ndarray:
    """Standard normal noise [size, 1] at equal steps of its distribution function, so that means over it are exact."""
    return scipy.stats.norm.ppf((np.arange(size) + 0.5) / size)[:, None]


@pytest.mark.parametrize("numbers", CENSORED)
def test_censored_samples_have_the_mean_and_the_variance_of_the_distribution(numbers: tuple[float, ...]) -> None:
    _, _, low, high = numbers
    with jax.enable_x64(True):
        distribution = censored(*numbers)
        actions = np.asarray(distributions.sample(distribution, jnp.asarray(stratified(400_000))))
    assert actions.min() >= low
    assert actions.max() <= high
    mean = integral(numbers, lambda x: x)
    np.testing.assert_allclose(actions.mean(), mean, atol=1e-5)
    np.testing.assert_allclose(actions.var(), integral(numbers, lambda x: (x - mean) ** 2), rtol=1e-4)
    for bound in (low, high):
        if np.isfinite(bound):
            np.testing.assert_allclose(np.mean(actions == bound), probability(numbers, bound), atol=1e-5)


@pytest.mark.parametrize("numbers", CENSORED)
def test_the_expected_score_of_a_censored_action_is_0(numbers: tuple[float, ...]) -> None:
    """E[d log p / d theta] = 0 at the parameters that the actions come from. Without the tails' terms it would not."""
    mean, log_std, low, high = numbers
    with jax.enable_x64(True):
        actions = distributions.sample(censored(*numbers), jnp.asarray(stratified(400_000)))

        @jax.jit
        def mean_log_prob(mean: jax.Array, log_std: jax.Array) -> jax.Array:
            return jnp.mean(distributions.log_prob(censored(mean, log_std, low, high), actions))

        parameters = jnp.asarray(mean), jnp.asarray(log_std)
        score = jax.grad(mean_log_prob, argnums=(0, 1))(*parameters)
        plain = jax.grad(
            lambda mean, log_std: jnp.mean(
                distributions.log_prob(Gaussian(mean=mean[None], log_std=log_std[None]), actions)
            ),
            argnums=(0, 1),
        )(*parameters)
    np.testing.assert_allclose(score, 0, atol=2e-4)
    assert np.isinf([low, high]).all() or np.abs(plain).max() > 0.01  # executed actions have another density than drawn


ACTIONS = {"inside": 0.3, "at the lower bound": -1.0, "at the upper bound": 0.8, "below": -1.7, "above": 4.0}


@pytest.mark.parametrize("where", ACTIONS)
@pytest.mark.parametrize(("mean", "log_std"), [(0.1, -0.4), (2.5, 0.2), (-2.0, -0.9)])
def test_the_censored_gradient_is_the_central_difference(where: str, mean: float, log_std: float) -> None:
    step = 1e-6
    with jax.enable_x64(True):

        @jax.jit
        def log_prob(mean: jax.Array, log_std: jax.Array) -> jax.Array:
            return distributions.log_prob(censored(mean, log_std, -1.0, 0.8), jnp.asarray([ACTIONS[where]]))

        at = jnp.asarray(mean), jnp.asarray(log_std)
        gradient = jax.grad(log_prob, argnums=(0, 1))(*at)
        moves = [(step, 0.0), (0.0, step)]
        differences = [(log_prob(at[0] + x, at[1] + y) - log_prob(at[0] - x, at[1] - y)) / (2 * step) for x, y in moves]
    assert np.abs(differences).max() > 1e-3
    np.testing.assert_allclose(gradient, differences, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("standardized", [-30.0, -8.0, -1.0, 0.0, 1.0, 8.0, 30.0])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_censored_tails_in_float32(standardized: float, side: float) -> None:
    """The mean is so many deviations beyond a bound (within the range if negative). Against SciPy in float64:

    log Phi(x), and its derivative phi / Phi = sqrt(2 / pi) / erfcx(-x / sqrt 2). JAX computes the derivative from the
    difference of two numbers of about x^2 / 2, so that 30 deviations away float32 leaves an error of 2e-5.
    """
    log_std, bound = np.float32(-1.0), np.float32(side)
    mean = np.float32(bound + side * standardized * np.exp(log_std))
    std = np.exp(np.float64(log_std))
    x = side * (np.float64(mean) - bound) / std
    hazard = np.sqrt(2 / np.pi) / scipy.special.erfcx(-x / np.sqrt(2))

    @jax.jit
    def log_prob(mean: jax.Array, log_std: jax.Array) -> jax.Array:
        return distributions.log_prob(censored(mean, log_std, -1.0, 1.0), jnp.asarray([bound]))

    found, gradient = jax.value_and_grad(log_prob, argnums=(0, 1))(jnp.asarray(mean), jnp.asarray(log_std))
    assert found.dtype == jnp.float32
    tiny = np.finfo(np.float32).tiny  # what is smaller is 0
    np.testing.assert_allclose(found, scipy.special.log_ndtr(x), rtol=1e-5, atol=tiny)
    np.testing.assert_allclose(gradient, [side * hazard / std, -hazard * x], rtol=5e-5, atol=tiny)


def test_without_an_entry_at_a_bound_it_is_the_gaussian_bit_for_bit() -> None:
    rng = np.random.default_rng(1)
    mean, actions = (jnp.asarray(rng.normal(size=(50, 7)), jnp.float32) for _ in range(2))
    log_std = jnp.asarray(rng.normal(size=7), jnp.float32)
    plain = Gaussian(mean=mean, log_std=log_std)

    def all_of(distribution: Any) -> tuple[jax.Array, jax.Array, Gaussian]:
        def log_prob(gaussian: Gaussian) -> jax.Array:
            own = distribution.replace(gaussian=gaussian) if isinstance(distribution, CensoredGaussian) else gaussian
            return distributions.log_prob(own, actions)

        found, pull = jax.vjp(jax.jit(log_prob), plain)
        return distributions.sample(distribution, actions), found, pull(jnp.ones_like(found))[0]

    for bound in (30.0, INF):
        wide = censored(mean, log_std, np.full(7, -bound), np.full(7, bound))
        (*found, slope), (*expected, plain_slope) = all_of(wide), all_of(plain)
        assert_same_bits([*found, slope.mean], [*expected, plain_slope.mean])
        np.testing.assert_allclose(slope.log_std, plain_slope.log_std, rtol=1e-6)  # is summed in another order
    narrow = censored(mean, log_std, np.full(7, -1.5), np.full(7, 1.5))
    inside = np.all(np.abs(np.asarray(actions)) < 1.5, axis=-1)
    assert 0 < inside.sum() < 50
    one, other = (np.asarray(distributions.log_prob(own, actions)) for own in (narrow, plain))
    np.testing.assert_array_equal(one == other, inside)


def test_the_entries_of_a_censored_action_are_independent() -> None:
    """Its likelihood is the product of theirs, inside, at a bound, without bounds; and so is its gradient."""
    mean, log_std = np.array([0.3, 1.5, -0.2]), np.array([-0.3, 0.1, 0.4])
    low, high, action = np.array([-1.0, -1.0, -INF]), np.array([1.0, 1.0, INF]), np.array([0.2, 1.0, 5.0])
    with jax.enable_x64(True):

        def gradient(mean: Any, log_std: Any, low: Any, high: Any, action: Any) -> Any:
            def log_prob(gaussian: Gaussian) -> jax.Array:
                return distributions.log_prob(
                    CensoredGaussian(gaussian=gaussian, low=jnp.asarray(low), high=jnp.asarray(high)),
                    jnp.asarray(action),
                )

            return jax.value_and_grad(log_prob)(Gaussian(mean=jnp.asarray(mean), log_std=jnp.asarray(log_std)))

        together, of_all = gradient(mean, log_std, low, high, action)
        single = [gradient(*(x[i : i + 1] for x in (mean, log_std, low, high, action))) for i in range(3)]
        np.testing.assert_allclose(together, sum(value for value, _ in single), rtol=1e-12)
        np.testing.assert_allclose(of_all.mean, [own.mean[0] for _, own in single], rtol=1e-12)
        np.testing.assert_allclose(of_all.log_std, [own.log_std[0] for _, own in single], rtol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "low", "high"),
    [
        ((0.2, -0.5), (0.5, -0.3), -1.0, 1.0),
        ((1.5, 0.1), (1.1, -0.2), -1.0, 1.0),
        ((-2.0, -0.3), (-1.5, 0.2), -1.0, INF),
        ((0.0, -2.0), (0.1, -1.9), -5.0, 5.0),  # nothing is ever clipped: equal
    ],
)
def test_the_gaussians_divergence_is_an_upper_bound_of_the_censored_one(
    old: tuple[float, float], new: tuple[float, float], low: float, high: float
) -> None:
    numbers, others = (*old, low, high), (*new, low, high)
    exact = integral(numbers, lambda x: np.log(probability(numbers, x) / probability(others, x)))
    with jax.enable_x64(True):
        bound = float(distributions.kl_divergence(censored(*numbers), censored(*others)))
        plain = [Gaussian(mean=jnp.asarray([mean]), log_std=jnp.asarray([log_std])) for mean, log_std in (old, new)]
        assert bound == float(distributions.kl_divergence(*plain))
        entropy = float(distributions.entropy(censored(*numbers)))
        np.testing.assert_allclose(entropy, scipy.stats.norm.entropy(0, np.exp(old[1])), rtol=1e-12)
    if high == 5.0:
        np.testing.assert_allclose(bound, exact, rtol=1e-6)
    else:
        assert 0 < exact < 0.98 * bound


class Echo(Probe):
    """Shows the action that it was given, as it was given; every step costs that action's size."""

    def start(self, key: jax.Array) -> jax.Array:
        return jnp.zeros(1)

    def observe(self, physics: jax.Array) -> jax.Array:
        return physics

    def advance(self, physics: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        return action, jnp.zeros(()), jnp.abs(action[0]), jnp.zeros((), bool)

    def step(self, state: State, action: jax.Array) -> State:
        clipped = super().step(state, action)
        return clipped.replace(obs=action, reward=clipped.obs[0])  # what was given, and what was executed


@pytest.mark.parametrize("likelihood", ["gaussian", "censored"])
def test_a_censored_policy_records_the_actions_that_the_task_executes(likelihood: str) -> None:
    env = Echo(action_bound=0.5, max_episode_steps=7)
    demonstrations = walk_demonstrations()
    demonstrations = dataclasses.replace(demonstrations, obs=demonstrations.obs[:, :1])
    config = build.resolve(
        walk_config(method="ccil", action_likelihood=likelihood, batch_size=400), env, demonstrations
    )
    parts = on_policy.make_parts(config, env, expert_data(demonstrations))

    @jax.jit
    @full_precision
    def one() -> Transition:
        state = on_policy.init(parts, jax.random.key(0))
        return on_policy.generator_step(parts, state, jax.random.key(1))[1].transition

    transition = one()
    given, executed = (np.asarray(x)[..., 0] for x in (transition.next_obs, transition.reward[..., None]))
    recorded = np.asarray(transition.action)[..., 0]
    np.testing.assert_array_equal(recorded, given)
    assert executed.min() == -0.5
    assert executed.max() == 0.5
    assert 0.1 < np.mean(np.abs(executed) < 0.5) < 0.9  # some inside, some at either bound
    np.testing.assert_array_equal(np.clip(recorded, -0.5, 0.5), executed)
    assert np.array_equal(recorded, executed) is (likelihood == "censored")
