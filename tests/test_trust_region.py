"""The trust-region step: Fisher product, conjugate gradient, and what a step may and may not do."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from ccil_jax.acting import distributions
from ccil_jax.learning import constraints, policy_step, trust_region
from ccil_jax.learning.trust_region import Directions
from ccil_jax.types import Metrics, PyTree
from tests.probe_envs import PolicyProblem, assert_same_bits, numpy_log_prob, numpy_policy, policy_problem, same_bits

pytestmark = pytest.mark.once


def matrix_product(matrix: Any) -> Callable[[jax.Array], jax.Array]:
    return lambda vectors: vectors @ jnp.asarray(matrix)


def damped_fisher(problem: PolicyProblem, stride: int, damping: float) -> np.ndarray:
    """E[score score^T] + damping I, the expectation over actions by Gauss-Hermite quadrature, exact for a Gaussian."""
    flat, unravel = ravel_pytree(problem.params)
    obs = problem.training.obs[::stride]
    nodes, weights = np.polynomial.hermite_e.hermegauss(3)
    mean, log_std = numpy_policy(problem.params, obs)

    def log_prob(params: jax.Array, action: jax.Array) -> jax.Array:
        return distributions.log_prob(problem.policy.apply(unravel(params), obs), action)

    scores = jax.jit(jax.jacrev(log_prob))
    total = np.zeros((flat.size, flat.size))
    for (i, z0), (j, z1) in itertools.product(enumerate(nodes), enumerate(nodes)):
        score = np.asarray(scores(flat, jnp.asarray(mean + np.exp(log_std) * np.array([z0, z1]))))
        total += weights[i] * weights[j] / (2 * np.pi) * score.T @ score / len(obs)
    return total + damping * np.eye(flat.size)


# Fisher product ------------------------------------------------------------------------------------------------------


def test_the_fisher_product_is_the_dense_fisher_matrix_of_scores_and_of_kl() -> None:
    with jax.enable_x64(True):
        problem = policy_problem(0, np.float64)
        flat, unravel = ravel_pytree(problem.params)

        def policy(params: jax.Array) -> distributions.Gaussian:
            return distributions.gaussian_of(problem.policy.apply(unravel(params), problem.training.obs))

        def divergence(params: jax.Array) -> jax.Array:
            return jnp.mean(distributions.kl_divergence(policy(flat), policy(params)))

        identity = jnp.eye(flat.size)
        product = jax.jit(lambda v: trust_region.fisher_vector_product(policy, flat, 0.1)(v))(identity)
        hessian = jax.jit(jax.hessian(divergence))(flat)
        np.testing.assert_allclose(product, damped_fisher(problem, 1, 0.1), atol=1e-11)
        np.testing.assert_allclose(product, hessian + 0.1 * identity, atol=1e-11)


def test_improve_solves_with_the_damped_fisher_matrix_of_every_nth_sample() -> None:
    """With as many iterations as parameters: F x is the gradient of each surrogate, E[score advantage]."""
    with jax.enable_x64(True):
        problem = policy_problem(1, np.float64, cg_iterations=60, fisher_stride=3, cg_damping=0.2)
        taken = improve(problem, 0.5)[1]
        training = problem.training
        flat, unravel = ravel_pytree(problem.params)

        def log_prob(params: jax.Array) -> jax.Array:
            return distributions.log_prob(problem.policy.apply(unravel(params), training.obs), training.action)

        scores = np.asarray(jax.jit(jax.jacrev(log_prob))(flat))
        advantages = np.stack([training.reward_advantage, training.cost_advantage])
        fisher, gradients = damped_fisher(problem, 3, 0.2), advantages @ scores / len(scores)
        directions = np.linalg.solve(fisher, gradients.T).T
        np.testing.assert_allclose(taken.directions.x, directions, atol=1e-5 * np.abs(directions).max())
        np.testing.assert_allclose(taken.directions.gram, gradients @ directions.T, rtol=1e-6)


# Conjugate gradient --------------------------------------------------------------------------------------------------


def positive_definite(size: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(size, size))
    return root @ root.T / size + 0.1 * np.eye(size), rng.normal(size=(2, size))


def test_conjugate_gradient_against_a_dense_solve_with_two_right_hand_sides() -> None:
    a, b = positive_definite(12)
    with jax.enable_x64(True):
        exact, _ = trust_region.conjugate_gradient(matrix_product(a), jnp.asarray(b), 24, tolerance=0.0)
        x, _ = trust_region.conjugate_gradient(matrix_product(a), jnp.asarray(b), 24)
    np.testing.assert_allclose(exact, np.linalg.solve(a, b.T).T, rtol=1e-9, atol=1e-11)
    relative = np.linalg.norm(np.asarray(x) @ a - b, axis=1) / np.linalg.norm(b, axis=1)
    assert np.all(relative <= 1e-5)  # the default tolerance, 1e-10 of the squared norm


def test_truncated_conjugate_gradient_minimises_over_the_krylov_space_and_tells_its_residual() -> None:
    a, b = positive_definite(12)
    with jax.enable_x64(True):
        truncated, residual = trust_region.conjugate_gradient(matrix_product(a), jnp.asarray(b), 4)
        gram = trust_region.directions(matrix_product(a), jnp.asarray(b), 4).gram
    x = np.asarray(truncated)
    np.testing.assert_allclose(residual, b - x @ a, atol=1e-12)
    for row in range(2):
        krylov = np.stack([np.linalg.matrix_power(a, k) @ b[row] for k in range(4)], axis=1)
        best = krylov @ np.linalg.solve(krylov.T @ a @ krylov, krylov.T @ b[row])
        np.testing.assert_allclose(x[row], best, rtol=1e-7)
    # The Gram matrix is that of the truncated x, not of the exact solution.
    np.testing.assert_allclose(gram, x @ a @ x.T, atol=1e-12)
    assert not np.allclose(gram, b @ np.linalg.solve(a, b.T), rtol=1e-4)


def test_a_zero_right_hand_side_is_frozen_and_leaves_the_other_alone() -> None:
    a, b = positive_definite(6)
    product = matrix_product(a.astype(np.float32))
    right = jnp.asarray(b, jnp.float32)
    together, _ = trust_region.conjugate_gradient(product, right.at[0].set(0.0), 30)
    assert np.all(np.asarray(together[0]) == 0)
    alone, _ = trust_region.conjugate_gradient(product, right[1:], 30)
    np.testing.assert_allclose(together[1], alone[0], rtol=1e-5)
    np.testing.assert_allclose(together[1], np.linalg.solve(a, b[1]), rtol=1e-3)


def test_a_solved_right_hand_side_is_frozen_while_the_other_goes_on() -> None:
    a, b = np.diag([2.0, 1.0, 3.0, 4.0]).astype(np.float32), np.ones((2, 4), np.float32)
    b[0] = [1, 0, 0, 0]  # an eigenvector: one iteration, then a residual of exactly 0
    x, residual = trust_region.conjugate_gradient(matrix_product(a), jnp.asarray(b), 50)
    np.testing.assert_array_equal(x[0], [0.5, 0, 0, 0])
    np.testing.assert_allclose(x[1], [1 / 2, 1, 1 / 3, 1 / 4], rtol=1e-5)
    assert np.all(np.isfinite(residual))


def test_a_right_hand_side_is_frozen_once_its_squared_residual_is_within_the_tolerance() -> None:
    """A = diag(2, 3): from b = (1, 1) the first step is 2/5 b and leaves (1/5, -1/5), 4% of |b|^2."""
    product, b = matrix_product(np.diag([2.0, 3.0]).astype(np.float32)), jnp.array([[1.0, 1.0], [0.0, 1.0]])
    x, _ = trust_region.conjugate_gradient(product, b, 10, tolerance=0.05)
    np.testing.assert_allclose(x, [[0.4, 0.4], [0, 1 / 3]], rtol=1e-6)
    x, _ = trust_region.conjugate_gradient(product, b, 10, tolerance=0.03)
    np.testing.assert_allclose(x, [[1 / 2, 1 / 3], [0, 1 / 3]], rtol=1e-6)


@pytest.mark.parametrize(
    ("matrix", "b", "expected"),
    [
        (np.diag([1.0, -1.0]), [0.0, 1.0], [0.0, 0.0]),  # curvature -1 at once
        (np.diag([1.0, -1.0]), [1.0, 1.0], [0.0, 0.0]),  # curvature exactly 0 at once
        # First direction b: curvature 4 * 2 - 1 = 7, alpha = 5 / 7; the second has negative curvature.
        (np.diag([2.0, -1.0]), [2.0, 1.0], [10 / 7, 5 / 7]),
        (np.zeros((2, 2)), [1.0, 2.0], [0.0, 0.0]),
    ],
)
def test_curvature_that_is_not_positive_freezes(matrix: np.ndarray, b: list[float], expected: list[float]) -> None:
    right = jnp.array([b, [1.0, 0.0]])
    x, residual = trust_region.conjugate_gradient(matrix_product(matrix.astype(np.float32)), right, 10)
    np.testing.assert_allclose(x[0], expected, rtol=1e-6)
    np.testing.assert_allclose(residual[0], np.asarray(b) - matrix @ expected, rtol=1e-6, atol=1e-6)


# The step ------------------------------------------------------------------------------------------------------------


def improve(
    problem: PolicyProblem, multiplier: float, **changes: Any
) -> tuple[PyTree, policy_step.PolicyStep, Metrics]:
    """The Lagrangian step of a problem, jitted."""
    config = problem.config.replace(**changes)

    @jax.jit
    def run(params: PyTree, multiplier: jax.Array) -> tuple[PyTree, policy_step.PolicyStep, Metrics]:
        constraint = constraints.lagrangian(config)
        gap, batches = jnp.zeros(()), (problem.training, problem.held_out)
        return policy_step.improve(
            config, problem.policy.apply, constraint, params, batches[0], multiplier, gap, batches[1]
        )

    return run(problem.params, jnp.asarray(multiplier))


def test_steps_stay_within_the_radius_and_do_not_lower_the_surrogate_on_random_problems() -> None:
    """KL and surrogates of the step taken, computed by NumPy and SciPy from the parameters alone."""
    fractions = []
    with jax.enable_x64(True):
        problems = [policy_problem(seed, np.float64, cg_damping=1e-3) for seed in range(40)]
        rng = np.random.default_rng(0)
        multipliers, radii = rng.uniform(0, 3, 40), 10 ** rng.uniform(-4, 1, 40)

        @jax.jit
        @jax.vmap
        def run(params: PyTree, training: Any, multiplier: jax.Array, max_kl: jax.Array) -> tuple[PyTree, Metrics]:
            config, apply = problems[0].config.replace(max_kl=max_kl), problems[0].policy.apply
            constraint, gap = constraints.lagrangian(config), jnp.zeros(())
            new, _, metrics = policy_step.improve(
                config, apply, constraint, params, training, multiplier, gap, problems[0].held_out
            )
            return new, metrics

        stacked = jax.tree.map(lambda *x: jnp.stack(x), *[(p.params, p.training) for p in problems])
        news, metrics = run(*stacked, jnp.asarray(multipliers), jnp.asarray(radii))
        for i, problem in enumerate(problems):
            new, training = jax.tree.map(lambda x, i=i: x[i], news), problem.training
            (mean, log_std), (new_mean, new_log_std) = (numpy_policy(p, training.obs) for p in (problem.params, new))
            spread = np.exp(2 * (log_std - new_log_std)) + ((mean - new_mean) / np.exp(new_log_std)) ** 2
            kl = np.mean(np.sum(new_log_std - log_std + (spread - 1) / 2, axis=-1))
            weights = np.exp(numpy_log_prob(new, training) - numpy_log_prob(problem.params, training))
            advantage = np.asarray(training.reward_advantage - multipliers[i] * training.cost_advantage)
            gain = np.mean((weights - 1) * advantage)
            assert kl <= 1.5 * radii[i] * (1 + 1e-9)
            assert gain >= -1e-12
            np.testing.assert_allclose(metrics["kl"][i], kl, rtol=1e-6, atol=1e-12)
            np.testing.assert_allclose(metrics["surrogate"][i], gain, rtol=1e-6, atol=1e-12)
            fractions.append(float(metrics["step_fraction"][i]))
    assert sum(fraction > 0 for fraction in fractions) >= 30  # most steps were taken,
    assert sum(0 < fraction < 1 for fraction in fractions) >= 3  # and some were shortened: the test is not empty


def line(start: jax.Array, slope: list[float]) -> Directions:
    """Directions for one objective and F = I."""
    x = jnp.asarray([slope], start.dtype)
    return Directions(x=x, gram=x @ x.T)


START = np.array([0.1, 0.0, 0.2], np.float32)
DELICATE = np.array([0.1, -0.0, 3e-39], np.float32)  # a negative zero and a subnormal: arithmetic would change them


def step(
    evaluate: Callable[[jax.Array], tuple[jax.Array, jax.Array]], start: np.ndarray = START
) -> tuple[jax.Array, jax.Array, Metrics]:
    """A step of length 1 along the first axis, tried at 1, 1/2, ..., 1/512; KL accepted up to 0.75."""
    params = jnp.asarray(start)
    along = line(params, [1.0, 0.0, 0.0])
    return trust_region.step(params, along, jnp.ones(1), evaluate, max_kl=0.5, kl_tolerance=1.5, num_halvings=10)


def within(limit: float, inside: Any, outside: Any) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
    """(objective, KL): `inside` for candidates nearer than `limit`, `outside` beyond."""

    def evaluate(params: jax.Array) -> tuple[jax.Array, jax.Array]:
        near = jnp.abs(params[0] - START[0]) < limit
        objective, kl = jnp.where(near, jnp.asarray(inside), jnp.asarray(outside))
        moved = params[0] != START[0]
        return jnp.where(moved, objective, 0.0)[None], jnp.where(moved, kl, 0.0)

    return evaluate


REASONS = ("rejected_not_finite", "rejected_by_kl", "rejected_by_surrogate", "no_direction")


def no_step(reason: str) -> dict[str, float]:
    """The metrics of standing still."""
    return {"kl": 0.0, "surrogate": 0.0, "step_fraction": 0.0, **dict.fromkeys(REASONS, 0.0), reason: 1.0}


@pytest.mark.parametrize(
    ("outcome", "reason"),
    [
        pytest.param((np.nan, 0.0), "rejected_not_finite", id="objective NaN"),
        pytest.param((np.inf, 0.0), "rejected_not_finite", id="objective infinite"),
        pytest.param((-np.inf, 0.0), "rejected_not_finite", id="objective minus infinity"),
        pytest.param((1.0, np.nan), "rejected_not_finite", id="KL NaN"),
        pytest.param((1.0, np.inf), "rejected_not_finite", id="KL infinite"),
        pytest.param((1.0, 0.75001), "rejected_by_kl", id="KL never within"),
        pytest.param((-1e-6, 0.0), "rejected_by_surrogate", id="objective falls"),
    ],
)
def test_a_step_that_nothing_accepts_leaves_the_parameters_bit_for_bit(
    outcome: tuple[float, float], reason: str
) -> None:
    new, fraction, metrics = step(within(0.0, outcome, outcome), DELICATE)
    assert_same_bits(new, DELICATE)
    assert fraction == 0
    assert metrics == no_step(reason)


@pytest.mark.parametrize("outside", [(np.nan, 0.0), (1.0, np.nan), (1.0, 9.0), (-1.0, 0.0), (np.inf, np.inf)])
def test_candidates_are_halved_until_one_is_sound(outside: tuple[float, float]) -> None:
    new, fraction, metrics = step(within(0.3, (1.0, 0.7499), outside))
    assert fraction == 0.25
    np.testing.assert_allclose(new, START + np.array([0.25, 0, 0]), rtol=1e-6)
    np.testing.assert_allclose([metrics["kl"], metrics["surrogate"]], [0.7499, 1.0], rtol=1e-6)
    assert not any(metrics[reason] for reason in REASONS)


def test_the_last_candidate_is_the_ninth_halving() -> None:
    assert step(within(0.003, (1.0, 0.0), (1.0, 9.0)))[1] == 0.5**9  # 1/512 < 0.003 < 1/256
    assert step(within(0.0015, (1.0, 0.0), (1.0, 9.0)))[1] == 0


def test_an_infinite_candidate_is_rejected() -> None:
    start, always = jnp.asarray(START), within(np.inf, (1.0, 0.0), (1.0, 0.0))
    along = Directions(x=jnp.array([[jnp.inf, 0.0, 0.0]]), gram=jnp.ones((1, 1)))
    new, fraction, _ = trust_region.step(
        start, along, jnp.ones(1), always, max_kl=0.5, kl_tolerance=1.5, num_halvings=3
    )
    assert_same_bits(new, START)
    assert fraction == 0


@pytest.mark.parametrize("field", ["reward_advantage", "cost_advantage", "obs", "action"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_non_finite_sample_leaves_the_policy_bit_for_bit(field: str, value: float) -> None:
    problem = policy_problem(2)
    bad = getattr(problem.training, field).at[3].set(value)
    new, taken, metrics = _improve_batch(problem.training.replace(**{field: bad}))
    assert_same_bits(new, problem.params)
    assert taken.fraction == 0
    assert {name: metrics[name] for name in no_step("kl")} == no_step("rejected_not_finite")


@functools.cache
def _compiled_improve() -> Callable[[Any], tuple[PyTree, policy_step.PolicyStep, Metrics]]:
    problem = policy_problem(2)
    constraint = constraints.lagrangian(problem.config)

    @jax.jit
    def run(training: Any) -> tuple[PyTree, policy_step.PolicyStep, Metrics]:
        half, zero = jnp.asarray(0.5), jnp.zeros(())
        return policy_step.improve(
            problem.config, problem.policy.apply, constraint, problem.params, training, half, zero, problem.held_out
        )

    return run


def _improve_batch(training: Any) -> tuple[PyTree, policy_step.PolicyStep, Metrics]:
    return _compiled_improve()(training)


def test_the_same_program_moves_the_policy_when_all_is_finite() -> None:
    problem = policy_problem(2)
    new, taken, metrics = _improve_batch(problem.training)
    assert not same_bits(new, problem.params)
    assert taken.fraction > 0
    assert metrics["surrogate"] > 0


def test_cancelling_directions_give_a_zero_step() -> None:
    """x_r = x_c and lambda = 1, exactly and up to rounding in float32."""
    start = jnp.asarray(START)
    for wobble in (0.0, 1e-7, -1e-7):
        x = jnp.array([[3.0, -2.0, 1.0], [3.0 * (1 + wobble), -2.0, 1.0 * (1 - wobble)]])
        along = Directions(x=x, gram=x @ x.T)
        weights = jnp.array([1.0, -1.0])
        new = trust_region.propose(start, along, weights, 0.01, 1.0)
        np.testing.assert_array_equal(new, START)
        derivative = jax.jacfwd(trust_region.propose, argnums=2)(start, along, weights, 0.01, 1.0)
        assert np.all(np.isfinite(derivative))


def test_a_zero_gradient_gives_a_zero_step() -> None:
    start = jnp.asarray(START)
    along = trust_region.directions(matrix_product(np.eye(3, dtype=np.float32)), jnp.zeros((2, 3)), 10)
    np.testing.assert_array_equal(trust_region.propose(start, along, jnp.array([1.0, -2.0]), 0.01, 1.0), START)
    nothing = Directions(x=jnp.zeros((1, 3)), gram=jnp.zeros((1, 1)))
    always = within(np.inf, (1.0, 0.0), (1.0, 0.0))
    new, fraction, metrics = trust_region.step(
        start, nothing, jnp.ones(1), always, max_kl=0.5, kl_tolerance=1.5, num_halvings=3
    )
    assert_same_bits(new, START)
    assert fraction == 0
    assert metrics == no_step("no_direction")


def test_the_length_of_a_step_is_the_radius_whatever_the_scale_of_the_weights() -> None:
    """(theta' - theta).F(theta' - theta) / 2 = fraction^2 max_kl."""
    a, b = positive_definite(5)
    with jax.enable_x64(True):
        along = trust_region.directions(matrix_product(a), jnp.asarray(b), 20)
        for weights, fraction in itertools.product(([1.0, 0.0], [1.0, -0.7], [0.0, -1.0], [1e4, -3e4]), (1.0, 0.25)):
            moved = np.asarray(trust_region.propose(jnp.zeros(5), along, jnp.array(weights), 0.01, fraction))
            np.testing.assert_allclose(moved @ a @ moved / 2, fraction**2 * 0.01, rtol=1e-8)
            assert moved @ (np.array(weights) @ b) > 0


# What a user's own parts return ---------------------------------------------------------------------------------------


def test_what_the_caller_s_functions_return_must_have_the_right_shape() -> None:
    gradients = jnp.ones((2, 3))
    along = trust_region.directions(matrix_product(np.eye(3, dtype=np.float32)), gradients, 3)

    def step(evaluate: Any, num_objectives: int = 2) -> None:
        weights = jnp.ones(num_objectives)
        trust_region.step(jnp.zeros(3), along, weights, evaluate, max_kl=0.5, kl_tolerance=1.5, num_halvings=3)

    step(lambda params: (params[:2], jnp.sum(params**2)))
    for evaluate in (
        lambda params: (params[:1], jnp.sum(params**2)),  # one objective would be broadcast to both
        lambda params: (params[:2], params[:1]),  # a KL divergence of each sample, not their mean
    ):
        with pytest.raises(AssertionError, match="shape"):
            step(evaluate)
    with pytest.raises(AssertionError, match="shape"):
        step(lambda params: (params[:1], jnp.sum(params**2)), num_objectives=1)
    with pytest.raises(AssertionError, match="shape"):
        trust_region.directions(lambda vectors: vectors[:, :1], gradients, 3)
    with pytest.raises(AssertionError, match="rank"):
        trust_region.directions(lambda vector: vector, gradients[0], 3)
