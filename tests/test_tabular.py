"""The exact solver against a simulation, a general solver and finite differences."""

import numpy as np
import pytest
import scipy.optimize

from experiments.theory import tabular
from experiments.theory.tabular import Array, Process

BETA = 0.1


@pytest.fixture(scope="module")
def process() -> Process:
    return tabular.random_process(np.random.default_rng(3))


def some_policy(seed: int = 0) -> Array:
    return np.random.default_rng(seed).dirichlet(np.ones(3), 5)


def test_occupancies_are_discounted_visits(process: Process) -> None:
    """The sum over time, step by step, until the discount has swallowed the rest."""
    policy = some_policy()
    states, expected = process.initial, np.zeros((5, 3))
    for t in range(400):
        visits = states[:, None] * policy
        expected += (1 - process.gamma) * process.gamma**t * visits
        states = np.einsum("sa,sat->t", visits, process.transition)
    rho = process.occupancy(policy)
    np.testing.assert_allclose(rho, expected, atol=1e-12)
    np.testing.assert_allclose(rho.sum(), 1.0)
    np.testing.assert_allclose(tabular.policy_of(rho), policy)
    matrix, right = process.flow()
    np.testing.assert_allclose(matrix @ rho.ravel(), right, atol=1e-14)


@pytest.mark.parametrize("multiplier", [0.0, 0.7])
def test_the_learner_is_what_a_general_solver_finds(process: Process, multiplier: float) -> None:
    """BFGS over the logits of policies, with its own finite differences."""
    expert = process.occupancy(some_policy(1))

    def objective(logits: Array) -> float:
        policy = np.exp(logits.reshape(5, 3))
        rho = process.occupancy(policy / policy.sum(axis=1, keepdims=True))
        excess = process.episode_cost(rho - expert)
        return tabular.divergence(rho, expert) + multiplier * excess - BETA * tabular.entropy(rho)

    found = tabular.learner(process, expert, BETA, multiplier)
    general = scipy.optimize.minimize(objective, np.zeros(15), options={"gtol": 1e-9})
    np.testing.assert_allclose(found.value, general.fun, atol=1e-9)
    np.testing.assert_allclose(found.value, objective(np.log(tabular.policy_of(found.rho)).ravel()), atol=1e-12)


def test_soft_value_iteration_is_the_best_of_all_policies(process: Process) -> None:
    reward = np.random.default_rng(5).normal(size=(5, 3))

    def value(policy: Array) -> float:
        rho = process.occupancy(policy)
        return float(np.sum(rho * reward)) + BETA * tabular.entropy(rho)

    policy, best = tabular.soft_optimum(process, reward, BETA)
    np.testing.assert_allclose(value(policy), best, atol=1e-10)
    assert all(value(some_policy(seed)) < best for seed in range(50))
    assert value(0.99 * policy + 0.01 / 3) < best


def test_advantages_are_the_policys_gradient(process: Process) -> None:
    """d/d epsilon of the return of pi (1 + epsilon h), h of mean 0 under pi, is the occupancy's mean of A h."""
    policy, reward = some_policy(), np.random.default_rng(6).normal(size=(5, 3))
    h = np.random.default_rng(7).normal(size=(5, 3))
    h -= np.sum(policy * h, axis=1, keepdims=True)
    returns = [np.sum(process.occupancy(policy * (1 + e * h)) * reward) for e in (-1e-5, 1e-5)]
    advantages = tabular.advantages(process, policy, reward)
    expected = np.sum(process.occupancy(policy) * advantages * h)
    # The occupancy sums to 1: per episode it would be divided by 1 - gamma, as the advantages are not.
    np.testing.assert_allclose((returns[1] - returns[0]) / 2e-5, expected, rtol=1e-6)
    np.testing.assert_allclose(np.sum(policy * advantages, axis=1), 0.0, atol=1e-12)
