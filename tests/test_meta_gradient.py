"""MALM's outer step: the derivative of the inner policy step, and of the held-out loss through it."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from ccil_jax.acting import networks, running_statistics
from ccil_jax.agents import build, on_policy
from ccil_jax.agents.expert import expert_data
from ccil_jax.config import Config, validate
from ccil_jax.errors import ConfigError
from ccil_jax.learning import constraints, policy_step, reward_models, trust_region
from ccil_jax.learning.constraints import Multiplier, Outer
from ccil_jax.learning.policy_step import ExpertSteps, PolicyStep
from ccil_jax.learning.reward_models import RewardModel
from ccil_jax.learning.trust_region import Directions
from ccil_jax.types import Batch, PyTree
from tests.probe_envs import (
    PolicyProblem,
    Walk,
    gae_by_loop,
    numpy_log_prob,
    policy_problem,
    same_bits,
    walk_config,
    walk_demonstrations,
)

pytestmark = pytest.mark.once

KINDS = ("full", "direct", "indirect")
STEP = 1e-5  # of the central differences: their error is about STEP^2 + 1e-16 / STEP


class Learner:
    """The inner step and the outer gradient of random problems, each compiled once. Use within float64."""

    def __init__(self, expert: ExpertSteps | None = None, **changes: Any) -> None:
        template = policy_problem(0, np.float64, **changes)
        config, apply = template.config, template.policy.apply
        constraint = constraints.meta_lagrangian(config)

        @jax.jit
        def improve(
            params: PyTree, training: Batch, held_out: Batch, multiplier: jax.Array, kl_tolerance: jax.Array
        ) -> tuple[PyTree, PolicyStep]:
            changed = config.replace(kl_tolerance=kl_tolerance)
            arguments = (changed, apply, constraint, params, training, multiplier, jnp.zeros(()), held_out)
            return policy_step.improve(*arguments, expert)[:2]

        @jax.jit
        def gradients(taken: PolicyStep, multiplier: jax.Array, after_dual: jax.Array) -> list[jax.Array]:
            outer = policy_step.outer_problem(config, apply, constraint, taken)
            return [constraints.outer_gradient(kind, multiplier, after_dual, outer) for kind in KINDS]

        @jax.jit
        def lagrangian(taken: PolicyStep, multiplier: jax.Array, weight: jax.Array) -> jax.Array:
            outer = policy_step.outer_problem(config, apply, constraint, taken)
            return constraints.lagrangian_gradient(multiplier, weight, outer)

        @jax.jit
        def step_derivative(taken: PolicyStep, multiplier: jax.Array) -> jax.Array:
            def replay(multiplier: jax.Array) -> jax.Array:
                weights = constraint.combine(multiplier, taken.step_gap, taken.directions.gram)
                params = ravel_pytree(taken.policy_params)[0]
                return trust_region.propose(params, taken.directions, weights, config.max_kl, taken.fraction)

            return jax.jvp(replay, (multiplier,), (jnp.ones_like(multiplier),))[1]

        self._improve, self._gradients, self._lagrangian = improve, gradients, lagrangian
        self.step_derivative = step_derivative

    def improve(self, problem: PolicyProblem, multiplier: float, kl_tolerance: float) -> tuple[PyTree, PolicyStep]:
        """The step actually taken."""
        numbers = (jnp.asarray(multiplier), jnp.asarray(kl_tolerance))
        return self._improve(problem.params, problem.training, problem.held_out, *numbers)

    def gradients(self, taken: PolicyStep, multiplier: float, after_dual: float) -> dict[str, float]:
        """The outer gradient of every kind."""
        found = self._gradients(taken, jnp.asarray(multiplier), jnp.asarray(after_dual))
        return {kind: float(value) for kind, value in zip(KINDS, found, strict=True)}

    def lagrangian_gradient(self, taken: PolicyStep, multiplier: float, weight: float) -> float:
        """That of the outer loss `lagrangian`."""
        return float(self._lagrangian(taken, jnp.asarray(multiplier), jnp.asarray(weight)))


@pytest.fixture(scope="module")
def learner() -> Learner:
    """Conjugate gradients truncated at 4 of 28 iterations, on every second sample."""
    with jax.enable_x64(True):
        return Learner()


def numpy_loss(problem: PolicyProblem, new_params: PyTree | None, multiplier: float) -> float:
    """The held-out loss in NumPy, from the parameters of a step that was taken; w = 1 without."""
    held_out = problem.held_out
    weights = np.ones(len(held_out.cost))
    if new_params is not None:
        weights = np.exp(numpy_log_prob(new_params, held_out) - numpy_log_prob(problem.params, held_out))
    residual = weights * np.asarray(held_out.reward_advantage) - multiplier * np.asarray(held_out.cost)
    return float(np.mean(residual**2))


CASES = [
    # seed, lambda, KL tolerance: the radius 0.02 is met by the full step, so 0.4 of it by the half
    (0, 0.01, 1.5, 1.0),
    (1, 0.8, 1.5, 1.0),
    (2, 2.5, 1.5, 1.0),
    (3, 1.2, 0.4, 0.5),
]


@pytest.mark.parametrize(("seed", "multiplier", "kl_tolerance", "fraction"), CASES)
def test_the_steps_derivative_is_the_central_difference_of_the_step_taken(
    learner: Learner, seed: int, multiplier: float, kl_tolerance: float, fraction: float
) -> None:
    with jax.enable_x64(True):
        problem = policy_problem(seed, np.float64)
        taken = learner.improve(problem, multiplier, kl_tolerance)[1]
        assert taken.fraction == fraction
        after, before = (learner.improve(problem, multiplier + s * STEP, kl_tolerance)[0] for s in (1, -1))
        difference = np.asarray(ravel_pytree(after)[0] - ravel_pytree(before)[0]) / (2 * STEP)
        derivative = np.asarray(learner.step_derivative(taken, jnp.asarray(multiplier)))
    assert np.linalg.norm(difference) > 1e-3  # there is something to find
    np.testing.assert_allclose(derivative, difference, rtol=0, atol=1e-6 * np.linalg.norm(difference))


@pytest.mark.parametrize(("seed", "multiplier", "kl_tolerance", "fraction"), CASES)
def test_the_outer_gradient_is_the_central_difference_of_the_loss_of_the_step_taken(
    learner: Learner, seed: int, multiplier: float, kl_tolerance: float, fraction: float
) -> None:
    after_dual = multiplier + 0.07
    with jax.enable_x64(True):
        problem = policy_problem(seed, np.float64)
        new, taken = learner.improve(problem, multiplier, kl_tolerance)
        assert taken.fraction == fraction
        moved = [learner.improve(problem, multiplier + s * STEP, kl_tolerance)[0] for s in (1, -1)]
        found = learner.gradients(taken, multiplier, after_dual)
        losses = {  # d lambda / d lambda' = 1: both move together in the total derivative
            "full": [numpy_loss(problem, moved[i], after_dual + s * STEP) for i, s in enumerate((1, -1))],
            "direct": [numpy_loss(problem, None, after_dual + s * STEP) for s in (1, -1)],
            "indirect": [numpy_loss(problem, params, after_dual) for params in moved],
        }
        held_out, log_ratio = problem.held_out, numpy_log_prob(new, problem.held_out)
        weights = np.exp(log_ratio - numpy_log_prob(problem.params, problem.held_out))
    for kind, (up, down) in losses.items():
        np.testing.assert_allclose(found[kind], (up - down) / (2 * STEP), rtol=1e-6, atol=1e-9, err_msg=kind)
    assert abs(found["indirect"]) > 1e-4  # there is something to find
    # The total derivative is that path plus the explicit one at the step's own importance weights.
    reward, cost = np.asarray(held_out.reward_advantage), np.asarray(held_out.cost)
    explicit = np.mean(-2 * cost * (weights * reward - after_dual * cost))
    np.testing.assert_allclose(found["full"], explicit + found["indirect"], rtol=1e-10)


def test_the_closed_form_in_two_dimensions() -> None:
    """F = [[2, 1], [1, 2]], g_r = (3, 0), g_c = (0, 3), radius 1, lambda 1, all by hand.

    x_r = (2, -1), x_c = (-1, 2); a = 6, b = -3, c = 6; x = (3, -3), q = 6 + 6 + 6 = 18; sqrt(2 / 18) = 1/3.
    theta' - theta = (1, -1); d theta' / d lambda = -1/3 [(-1, 2) - (3, -3) (-3 - 6) / 18] = (-1/6, -1/6).
    """
    fisher, gradients = jnp.array([[2.0, 1.0], [1.0, 2.0]]), jnp.array([[3.0, 0.0], [0.0, 3.0]])
    along = trust_region.directions(lambda v: v @ fisher, gradients, 2)
    np.testing.assert_allclose(along.x, [[2, -1], [-1, 2]], rtol=1e-5)
    np.testing.assert_allclose(along.gram, [[6, -3], [-3, 6]], rtol=1e-5)
    constraint, theta = constraints.lagrangian(Config()), jnp.array([10.0, 20.0])

    def step(multiplier: jax.Array, fraction: float) -> jax.Array:
        weights = constraint.combine(multiplier, jnp.zeros(()), along.gram)
        return trust_region.propose(theta, along, weights, 1.0, fraction)

    one = jnp.ones(())
    np.testing.assert_allclose(step(one, 1.0), [11, 19], rtol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(step)(one, 1.0), [-1 / 6, -1 / 6], rtol=1e-5)
    np.testing.assert_allclose(jax.jacfwd(step)(one, 0.5), [-1 / 12, -1 / 12], rtol=1e-5)  # eta is a constant factor
    assert np.all(jax.jacfwd(step)(one, 0.0) == 0)


# A step that was rejected --------------------------------------------------------------------------------------------


def test_a_rejected_step_has_no_indirect_gradient(learner: Learner) -> None:
    with jax.enable_x64(True):
        problem = policy_problem(1, np.float64)
        new, taken = learner.improve(problem, 0.8, 0.0)  # no KL is within 0
        found = learner.gradients(taken, 0.8, 0.9)
        assert float(taken.fraction) == 0
    assert same_bits(new, problem.params)
    assert found["indirect"] == 0.0
    np.testing.assert_allclose(found["full"], found["direct"], rtol=1e-12)  # w = 1


@pytest.mark.parametrize("field", ["reward_advantage", "cost_advantage", "action"])
def test_a_non_finite_step_has_no_indirect_gradient_and_keeps_the_direct_one(learner: Learner, field: str) -> None:
    """A NaN in the training samples alone: the held-out loss itself is sound."""
    with jax.enable_x64(True):
        problem = policy_problem(1, np.float64)
        numbers = (jnp.asarray(0.8), jnp.asarray(1.5))
        bad = problem.training.replace(**{field: getattr(problem.training, field).at[0].set(jnp.nan)})
        new, taken = learner._improve(problem.params, bad, problem.held_out, *numbers)
        found = learner.gradients(taken, 0.8, 0.9)
        assert float(taken.fraction) == 0
    assert same_bits(new, problem.params)
    assert found["indirect"] == 0.0
    np.testing.assert_allclose(found["full"], found["direct"], rtol=1e-12)


def test_cancelling_directions_have_a_finite_derivative() -> None:
    x = jnp.array([[1.0, 2.0], [1.0, 2.0]])
    along, constraint = Directions(x=x, gram=x @ x.T), constraints.lagrangian(Config())

    def step(multiplier: jax.Array) -> jax.Array:
        weights = constraint.combine(multiplier, jnp.zeros(()), along.gram)
        return trust_region.propose(jnp.zeros(2), along, weights, 0.01, 1.0)

    assert np.all(jax.jacfwd(step)(jnp.ones(())) == 0)


# The Lagrangian as outer loss ----------------------------------------------------------------------------------------


def numpy_lagrangian(problem: PolicyProblem, new_params: PyTree, weight: float) -> float:
    """-mean w (A_r - weight A_c) in NumPy, on the held-out samples, from the parameters of a step that was taken."""
    held_out = problem.held_out
    weights = np.exp(numpy_log_prob(new_params, held_out) - numpy_log_prob(problem.params, held_out))
    gain = np.asarray(held_out.reward_advantage) - weight * np.asarray(held_out.cost_advantage)
    return -float(np.mean(weights * gain))


def test_the_lagrangian_loss_by_hand() -> None:
    """w (A_r - 2 A_c) is 1 (3 - 2) = 1 and 2 (-1 - 1) = -4: mean -1.5."""
    columns = (jnp.array([1.0, 2.0]), jnp.array([3.0, -1.0]), jnp.array([1.0, 0.5]))
    np.testing.assert_allclose(constraints.lagrangian_loss(*columns, jnp.asarray(2.0)), 1.5, rtol=1e-6)


@pytest.mark.parametrize("cloning_weight", [None, 0.4])
def test_the_lagrangian_gradient_is_the_central_difference_of_the_loss_of_the_step_taken(
    cloning_weight: float | None,
) -> None:
    """Through the policy step itself, also where the demonstrations take part in it."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(7)
        obs, action = (jnp.asarray(rng.normal(size=(40, size))) for size in (3, 2))
        expert = None if cloning_weight is None else ExpertSteps(obs=obs, action=action)
        learner = Learner(expert, cloning_weight=cloning_weight or 0.0)
        for seed, multiplier, kl_tolerance, fraction in CASES:
            problem = policy_problem(seed, np.float64)
            taken = learner.improve(problem, multiplier, kl_tolerance)[1]
            assert taken.fraction == fraction
            moved = [learner.improve(problem, multiplier + s * STEP, kl_tolerance)[0] for s in (1, -1)]
            for weight in (0.0, multiplier + 0.5):
                up, down = (numpy_lagrangian(problem, params, weight) for params in moved)
                if expert is not None and cloning_weight is not None:
                    up, down = (
                        loss - cloning_weight * float(np.mean(numpy_log_prob(params, expert)))
                        for loss, params in zip((up, down), moved, strict=True)
                    )
                found = learner.lagrangian_gradient(taken, multiplier, weight)
                np.testing.assert_allclose(found, (up - down) / (2 * STEP), rtol=1e-6, atol=1e-9)
                assert abs(found) > 1e-4  # there is something to find


@pytest.mark.parametrize("cloning_weight", [None, 0.4])
def test_on_the_samples_of_the_step_the_lagrangian_gradient_leads_to_the_weight(cloning_weight: float | None) -> None:
    """It has the sign of lambda - weight, and vanishes where they are equal: such a step is the best for that weight.

    So it does where the demonstrations' likelihood is an objective of the step.

    That holds for an exact step that is so small that the surrogates are linear. What is left is of the order of
    sqrt(max_kl) = 1e-7 and of what conjugate gradients leave, 1e-5, beside the gradient elsewhere.
    """
    with jax.enable_x64(True):
        rng = np.random.default_rng(7)
        obs, action = (jnp.asarray(rng.normal(size=(40, size))) for size in (3, 2))
        expert = None if cloning_weight is None else ExpertSteps(obs=obs, action=action)
        zero = 1e-3 if expert is None else 1e-2  # the likelihood's gradient is larger, and so is what is left of it
        small = {"cg_iterations": 80, "fisher_stride": 1, "max_kl": 1e-14}
        learner = Learner(expert, **small, cloning_weight=cloning_weight or 0.0)
        for seed, weight in ((0, 0.6), (1, 2.0), (2, 0.05)):
            problem = policy_problem(seed, np.float64)
            problem = dataclasses.replace(problem, held_out=problem.training)
            found = {}
            for multiplier in (0.2 * weight, 0.9 * weight, weight, 1.1 * weight, 5.0 * weight):
                taken = learner.improve(problem, multiplier, 1.5)[1]
                assert taken.fraction == 1.0
                found[multiplier - weight] = learner.lagrangian_gradient(taken, multiplier, weight)
            for distance, gradient in found.items():
                if distance == 0:
                    assert abs(gradient) < zero * min(abs(other) for other in found.values() if other != gradient)
                else:
                    assert gradient * distance > 0
            assert max(abs(gradient) for gradient in found.values()) > 1e-10  # steps have a length of about 1e-7


def test_where_the_cost_does_not_change_the_lagrangian_gradient_is_0(learner: Learner) -> None:
    """Without cost advantages no step depends on lambda; nor does one that was rejected."""
    with jax.enable_x64(True):
        problem = policy_problem(1, np.float64)
        free = problem.training.replace(cost_advantage=jnp.zeros_like(problem.training.cost_advantage))
        taken = learner.improve(dataclasses.replace(problem, training=free), 0.8, 1.5)[1]
        assert taken.fraction == 1.0
        assert learner.lagrangian_gradient(taken, 0.8, 3.0) == 0.0
        rejected = learner.improve(problem, 0.8, 0.0)[1]
        assert rejected.fraction == 0.0
        assert learner.lagrangian_gradient(rejected, 0.8, 3.0) == 0.0


LAGRANGIAN = Config(
    outer_loss="lagrangian",
    multiplier_update="sgd",
    multiplier_learning_rate=0.05,
    meta_update="sgd",
    meta_learning_rate=0.25,
    outer_penalty=1.5,
    cost_limit=10.0,
)


def squared_weights() -> Outer:
    """An outer problem whose importance weights are lambda^2, so that their slope at lambda = 1 is 2."""
    return dataclasses.replace(constant_weights(1.0), importance_weights=lambda multiplier: multiplier**2 * jnp.ones(4))


@pytest.mark.parametrize(
    ("gap", "limit", "weight"),
    [
        (2.0, 10.0, 1.1 + 1.5 * 2.0 / 10.0),  # lambda' = 1 + 0.05 * 2
        (-4.0, 10.0, 0.8 - 1.5 * 4.0 / 10.0),
        (-9.0, 10.0, 0.0),  # 0.55 - 1.35 is below 0
        (0.5, 0.25, 1.025 + 1.5 * 0.5),  # a limit below 1 is no unit
        (0.5, 0.0, 1.025 + 1.5 * 0.5),
    ],
)
def test_the_outer_step_of_the_lagrangian_by_hand(gap: float, limit: float, weight: float) -> None:
    """dL/dlambda = -2 mean(A_r - weight A_c) at lambda = 1, from where the inner step was taken, not at lambda'."""
    gradient = -2 * np.mean(REWARD - weight * COST_ADVANTAGE)
    multiplier, metrics = meta_step(LAGRANGIAN.replace(cost_limit=limit), 1.0, gap, squared_weights())
    np.testing.assert_allclose(metrics["meta_gradient"], gradient, rtol=1e-5)
    np.testing.assert_allclose(multiplier, 1 + 0.05 * gap - 0.25 * gradient, rtol=1e-5)


def test_in_units_of_the_limit_the_weight_follows_the_dual_step() -> None:
    """lambda' = 1 + 0.05 * 2 / 10 = 1.01, weight 1.01 + 1.5 * 0.2 = 1.31."""
    multiplier, metrics = meta_step(LAGRANGIAN.replace(gap_unit="limit"), 1.0, 2.0, squared_weights())
    gradient = -2 * np.mean(REWARD - 1.31 * COST_ADVANTAGE)
    np.testing.assert_allclose(metrics["meta_gradient"], gradient, rtol=1e-5)
    np.testing.assert_allclose(multiplier, 1.01 - 0.25 * gradient, rtol=1e-5)


def test_a_non_finite_gradient_of_the_lagrangian_moves_nothing() -> None:
    broken = dataclasses.replace(
        constant_weights(1.0), importance_weights=lambda multiplier: jnp.nan * multiplier * jnp.ones(4)
    )
    multiplier, metrics = meta_step(LAGRANGIAN, 1.0, 2.0, broken)
    assert metrics["meta_gradient"] == 0
    np.testing.assert_allclose(multiplier, 1.1, rtol=1e-6)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"meta_gradient": "direct"}, "meta_gradient direct: the lagrangian outer loss depends on the multiplier thr"),
        ({"meta_gradient": "none"}, "outer_loss lagrangian: makes no difference to this run of method malm"),
        ({"method": "ccil"}, "outer_loss lagrangian: makes no difference to this run of method ccil"),
    ],
)
def test_the_lagrangian_loss_is_refused_where_it_cannot_matter(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        validate(Config(outer_loss="lagrangian", **fields))
    validate(Config(outer_loss="lagrangian"))
    with pytest.raises(ConfigError, match=r"^outer_penalty 2\.0: makes no difference .*whose outer_loss is lagr"):
        validate(Config(outer_penalty=2.0))


# The outer step ------------------------------------------------------------------------------------------------------


REWARD, COST = np.array([1.0, -2.0, 3.0, 0.5]), np.array([1.0, 0.0, 1.0, 2.0])
COST_ADVANTAGE = np.array([0.5, -1.0, 2.0, 1.5])
FIXED_POINT = (1 + 3 + 1) / (1 + 1 + 4)  # mean(A_r d) / mean(d^2)


def constant_weights(value: float) -> Outer:
    """An outer problem whose importance weights do not depend on the multiplier."""
    return Outer(
        reward_advantage=jnp.asarray(REWARD),
        cost_advantage=jnp.asarray(COST_ADVANTAGE),
        cost=jnp.asarray(COST),
        importance_weights=lambda multiplier: jnp.full(4, value) + 0 * multiplier,
    )


def meta_step(config: Config, multiplier: float, gap: float, outer: Outer) -> tuple[float, dict[str, float]]:
    constraint = constraints.meta_lagrangian(config)
    state = constraint.init()
    written = jnp.log(jnp.expm1(multiplier)) if config.multiplier_update == "adam" else jnp.asarray(multiplier)
    state, metrics = constraint.update(state.replace(parameter=written), jnp.asarray(gap), outer)
    return float(constraint.multiplier(state)), {name: float(value) for name, value in metrics.items()}


def test_direct_vanishes_at_its_least_squares_fixed_point_and_leads_there() -> None:
    gradient = jax.jit(lambda after: constraints.outer_gradient("direct", after, after, constant_weights(5.0)))
    np.testing.assert_allclose(gradient(jnp.asarray(FIXED_POINT)), 0, atol=1e-6)
    assert gradient(jnp.asarray(FIXED_POINT - 0.1)) < 0 < gradient(jnp.asarray(FIXED_POINT + 0.1))
    config = Config(
        meta_gradient="direct",
        multiplier_update="sgd",
        meta_update="sgd",
        meta_learning_rate=0.2,
        initial_multiplier=0.0,
    )
    constraint = constraints.meta_lagrangian(config)
    update = jax.jit(lambda state: constraint.update(state, jnp.zeros(()), constant_weights(5.0))[0])
    state: Multiplier = constraint.init()
    for _ in range(60):
        state = update(state)
    np.testing.assert_allclose(constraint.multiplier(state), FIXED_POINT, rtol=1e-4)


def test_the_outer_step_follows_the_dual_step() -> None:
    """lambda 1, gap 2: lambda' = 1 + 0.05 * 2 = 1.1. dL/dlambda' = -2 mean(d (A_r - 1.1 d)) = -2 (5 - 6.6) / 4 = 0.8.

    lambda'' = 1.1 - 0.25 * 0.8 = 0.9.
    """
    config = Config(meta_gradient="direct", multiplier_update="sgd", meta_update="sgd", meta_learning_rate=0.25)
    multiplier, metrics = meta_step(config, 1.0, 2.0, constant_weights(1.0))
    np.testing.assert_allclose(metrics["meta_gradient"], 0.8, rtol=1e-5)
    np.testing.assert_allclose(multiplier, 0.9, rtol=1e-5)
    # Full, with w = 3 whatever lambda: -2 (15 - 6.6) / 4 = -4.2, lambda'' = 1.1 + 1.05.
    multiplier, metrics = meta_step(config.replace(meta_gradient="full"), 1.0, 2.0, constant_weights(3.0))
    np.testing.assert_allclose(metrics["meta_gradient"], -4.2, rtol=1e-5)
    np.testing.assert_allclose(multiplier, 2.15, rtol=1e-5)
    # Indirect: such weights have no path through theta'.
    multiplier, metrics = meta_step(config.replace(meta_gradient="indirect"), 1.0, 2.0, constant_weights(3.0))
    assert metrics["meta_gradient"] == 0
    np.testing.assert_allclose(multiplier, 1.1, rtol=1e-6)


@pytest.mark.parametrize("step", ["adam", "sgd"])
def test_both_outer_steps_go_through_softplus(step: str) -> None:
    """From lambda 1 and gap 2. The gradient is positive, so Adam's first step lowers xi by its rate, 0.25."""
    config = Config(meta_gradient="direct", multiplier_update="adam", meta_update=step, meta_learning_rate=0.25)
    xi = np.log(np.expm1(1.0)) + 0.05  # after the dual step: Adam's first step is its rate
    dual = np.log1p(np.exp(xi))
    gradient = -2 * np.mean(COST * (REWARD - dual * COST))
    assert gradient > 0
    multiplier, metrics = meta_step(config, 1.0, 2.0, constant_weights(1.0))
    np.testing.assert_allclose(metrics["meta_gradient"], gradient, rtol=1e-4)
    expected = {"adam": np.log1p(np.exp(xi - 0.25)), "sgd": dual - 0.25 * gradient}[step]
    np.testing.assert_allclose(multiplier, expected, rtol=1e-5)


@pytest.mark.parametrize("form", ["adam", "sgd"])
def test_the_outer_step_keeps_the_multiplier_within_its_bounds(form: str) -> None:
    config = Config(meta_gradient="direct", multiplier_update=form, meta_learning_rate=1e4, multiplier_max=5.0)
    lowest = 0.0 if form == "sgd" else 1e-3  # no xi reaches 0
    np.testing.assert_allclose(meta_step(config, 2.0, 0.0, constant_weights(1.0))[0], lowest, rtol=1e-4)
    assert meta_step(config, 0.2, 0.0, constant_weights(1.0))[0] == 5.0


def test_adams_outer_steps_descend_along_the_slope_of_softplus() -> None:
    """Kingma and Ba's Adam, line by line, on xi with gradient dL/dlambda sigmoid(xi)."""
    rate, gradients = 0.3, [2.0, -1.0, 0.5, 0.5]
    multiplier = constraints.ascent(Config(initial_multiplier=0.5, meta_learning_rate=rate))
    step, state = jax.jit(multiplier.outer), multiplier.init()
    xi, m, v = np.log(np.expm1(0.5)), 0.0, 0.0
    for t, gradient in enumerate(gradients, 1):
        slope = gradient / (1 + np.exp(-xi))
        m, v = 0.9 * m + 0.1 * slope, 0.999 * v + 0.001 * slope**2
        xi -= rate * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
        state = step(state, jnp.asarray(gradient))
        np.testing.assert_allclose(multiplier.read(state), np.log1p(np.exp(xi)), rtol=1e-4)


@pytest.mark.parametrize("form", ["adam", "sgd"])
@pytest.mark.parametrize("maximum", [2.0, 3.3, 100.0])
def test_adams_outer_step_leaves_the_cap_at_once(form: str, maximum: float) -> None:
    """Where lambda is capped its slope must not vanish."""
    config = Config(multiplier_update=form, multiplier_max=maximum, initial_multiplier=maximum, meta_learning_rate=0.1)
    multiplier = constraints.ascent(config)
    state = multiplier.outer(multiplier.init(), jnp.ones(()))
    assert multiplier.read(state) < maximum - 0.05


@pytest.mark.parametrize("kind", ["full", "indirect"])
def test_a_non_finite_outer_gradient_moves_nothing(kind: str) -> None:
    config = Config(meta_gradient=kind, multiplier_update="sgd", meta_update="sgd", meta_learning_rate=0.25)
    multiplier, metrics = meta_step(config, 1.0, 2.0, constant_weights(np.nan))
    assert metrics["meta_gradient"] == 0
    np.testing.assert_allclose(multiplier, 1.1, rtol=1e-6)  # the dual step alone


def test_meta_gradient_none_is_the_lagrangian() -> None:
    config = Config(meta_gradient="none", multiplier_update="sgd")
    multiplier, metrics = meta_step(config, 1.0, 2.0, constant_weights(1.0))
    np.testing.assert_allclose(multiplier, 1.1, rtol=1e-6)
    assert not metrics


# The split -----------------------------------------------------------------------------------------------------------


def numbered(size: int) -> Batch:
    rows = jnp.arange(float(size))
    columns = dict.fromkeys(("reward_advantage", "cost_advantage", "cost"), rows)
    return Batch(obs=rows[:, None], action=rows[:, None], returns=jnp.stack([rows, rows], 1), **columns)


def test_the_split_is_a_random_partition_with_rows_kept_together() -> None:
    held_out, training = policy_step.split(
        numbered(20), 6, policy_step.random_order(Config(batch_size=20, num_envs=4), jax.random.key(0))
    )
    assert held_out.cost.shape == (6,)
    assert training.cost.shape == (14,)
    np.testing.assert_array_equal(np.sort(np.concatenate([held_out.cost, training.cost])), np.arange(20))
    for part in (held_out, training):
        for column in jax.tree.leaves(part):
            np.testing.assert_array_equal(column.reshape(len(part.cost), -1)[:, 0], part.cost)
    other, _ = policy_step.split(
        numbered(20), 6, policy_step.random_order(Config(batch_size=20, num_envs=4), jax.random.key(1))
    )
    assert not np.array_equal(held_out.cost, other.cost)


def test_without_held_out_samples_the_batch_stays_as_it_is() -> None:
    held_out, training = policy_step.split(numbered(20), 0, jnp.arange(20))
    assert held_out.cost.shape == (0,)
    assert same_bits(training, numbered(20))


def test_a_split_by_trajectory_holds_out_whole_simulations() -> None:
    """Of 5 simulations with 4 steps each 0.5 are held out: 2, with all their steps, and others under another key."""
    config = Config(method="malm", batch_size=20, num_envs=5, held_out_unit="trajectory", held_out_fraction=0.5)
    assert config.num_held_out == 8
    chosen = set()
    for seed in range(20):
        order = policy_step.random_order(config, jax.random.key(seed))
        held_out, training = policy_step.split(numbered(20), config.num_held_out, order)
        simulations = np.asarray(held_out.cost).astype(int) % 5  # samples are [T, N] in C order
        assert np.bincount(simulations, minlength=5).tolist().count(4) == 2
        assert not set(simulations) & set(np.asarray(training.cost).astype(int) % 5)
        chosen.add(frozenset(simulations.tolist()))
    assert len(chosen) > 4


def test_re_evaluated_advantages_against_a_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """One iteration step by step: what the outer loss sees is the last batch as the updated networks judge it.

    The reward is twice, then three times the second observation; critics and statistics are those after the iteration.
    """
    seen: dict[str, Any] = {}

    def update(state: Any, transition: Any, key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        seen["transition"] = transition
        return state + 1.0, {}

    model = RewardModel(
        init=lambda key: jnp.asarray(2.0),
        reward=lambda state, transition: state * transition.obs[..., 1],
        update=update,
    )
    outer_problem = policy_step.outer_problem

    def watched(config: Config, apply: Any, constraint: Any, taken: policy_step.PolicyStep) -> Any:
        seen["held_out"] = taken.held_out
        return outer_problem(config, apply, constraint, taken)

    monkeypatch.setattr(reward_models, "discriminator", lambda *arguments: model)
    monkeypatch.setattr(policy_step, "outer_problem", watched)
    demonstrations = walk_demonstrations()
    config = walk_config(method="malm", outer_advantage="re-evaluated", held_out_fraction=0.5)
    config = build.resolve(config, Walk(), demonstrations)
    agent = on_policy.make(config, Walk(), expert_data(demonstrations))
    state, _ = agent.step(agent.init(jax.random.key(5)))  # not jitted, so that what is seen are numbers

    transition, held_out = jax.tree.map(np.asarray, (seen["transition"], seen["held_out"]))
    critic = networks.make_scalar(config, Walk().obs_dim)
    reward_critic = jax.tree.map(lambda leaf: leaf[on_policy.REWARD], state.critics.params)
    obs, next_obs = (
        running_statistics.normalize(state.actor.obs_statistics, jnp.asarray(x))
        for x in (transition.obs, transition.next_obs)
    )
    advantage = gae_by_loop(
        3.0 * transition.obs[..., 1],
        np.asarray(critic.apply(reward_critic, obs)),
        np.asarray(critic.apply(reward_critic, next_obs)),
        transition.terminated,
        transition.done,
        config.gamma,
        config.gae_lambda,
    )
    advantage = ((advantage - advantage.mean()) / advantage.std()).ravel()
    actions = transition.action.reshape(len(advantage), -1)
    assert held_out.action.shape == (config.num_held_out, Walk().action_dim)
    rows = [int(np.flatnonzero((actions == action).all(axis=1)).item()) for action in held_out.action]
    assert len(set(rows)) == config.num_held_out
    np.testing.assert_allclose(held_out.reward_advantage, advantage[rows], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(held_out.obs, np.asarray(obs).reshape(len(advantage), -1)[rows], rtol=1e-5)
