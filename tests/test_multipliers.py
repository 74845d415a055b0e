"""The optimal multiplier of one step against general solvers, and the PID controller by hand."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from ccil_jax.config import Config, validate
from ccil_jax.errors import ConfigError
from ccil_jax.learning import constraints, multipliers
from ccil_jax.learning.multipliers import Gains, Pid

NUM_PROBLEMS, MAX_KL = 400, 0.01


class Problem(NamedTuple):
    """Maximise reward.s subject to gap + cost.s <= 0 and s.fisher s / 2 <= MAX_KL."""

    reward: np.ndarray
    cost: np.ndarray
    fisher: np.ndarray
    gap: float

    def step(self) -> tuple[np.ndarray, np.ndarray]:
        """Our weights, and the step that they mean."""
        x = np.linalg.solve(self.fisher, np.stack([self.reward, self.cost], axis=1))
        with jax.enable_x64(True):
            gram = jnp.asarray(x.T @ self.fisher @ x)
            weights = np.asarray(multipliers.optimal_weights(gram, jnp.asarray(self.gap), MAX_KL))
        direction = x @ weights
        return weights, np.sqrt(2 * MAX_KL / (direction @ self.fisher @ direction)) * direction

    def least_cost(self) -> float:
        """What gap + cost.s can come down to within the radius."""
        return self.gap - float(np.sqrt(2 * MAX_KL * self.cost @ np.linalg.solve(self.fisher, self.cost)))


def problems() -> list[Problem]:
    rng = np.random.default_rng(0)
    found = []
    for _ in range(NUM_PROBLEMS):
        root = rng.normal(size=(4, 4))
        reward, cost = rng.normal(size=(2, 4))
        fisher = root @ root.T + 0.1 * np.eye(4)
        reach = np.sqrt(2 * MAX_KL * cost @ np.linalg.solve(fisher, cost))
        found.append(Problem(reward, cost, fisher, float(rng.uniform(-1.5, 1.5) * reach)))
    return found


def solve(problem: Problem) -> np.ndarray:
    """By a general solver (SLSQP), in coordinates in which the Fisher matrix is the identity and the radius is 1."""
    root = np.linalg.cholesky(problem.fisher)
    to_step = np.sqrt(2 * MAX_KL) * np.linalg.inv(root.T)
    reward, cost = to_step.T @ problem.reward, to_step.T @ problem.cost
    inside = [
        {"type": "ineq", "fun": lambda z: 1 - z @ z, "jac": lambda z: -2 * z},
        {"type": "ineq", "fun": lambda z: -problem.gap - cost @ z, "jac": lambda z: -cost},
    ]
    scale = np.linalg.norm(reward)
    start = -cost / np.linalg.norm(cost) * 0.9
    settings = {"ftol": 1e-15, "maxiter": 500}
    solution = scipy.optimize.minimize(
        lambda z: -reward @ z / scale, start, jac=lambda z: -reward / scale, constraints=inside, options=settings
    )
    return to_step @ solution.x


def bisect(problem: Problem) -> float:
    """The multiplier at which the step on the radius just meets the limit, to float64's precision."""
    x_r, x_c = np.linalg.solve(problem.fisher, np.stack([problem.reward, problem.cost], axis=1)).T

    def excess(angle: float) -> float:  # nu = tan(angle)
        direction = np.cos(angle) * x_r - np.sin(angle) * x_c
        length = np.sqrt(2 * MAX_KL / (direction @ problem.fisher @ direction))
        return problem.gap + length * float(problem.cost @ direction)

    return float(np.tan(scipy.optimize.brentq(excess, 0.0, np.pi / 2 - 1e-9, xtol=1e-15, rtol=1e-15)))


def test_the_optimal_multiplier_solves_400_random_problems() -> None:
    kinds = {"plain": 0, "bound": 0, "recovery": 0}
    for problem in problems():
        weights, step = problem.step()
        if problem.least_cost() > 0:
            kinds["recovery"] += 1
            np.testing.assert_array_equal(weights, [0.0, -1.0])
            np.testing.assert_allclose(problem.gap + problem.cost @ step, problem.least_cost(), rtol=1e-10)
            continue
        kinds["plain" if weights[1] == 0 else "bound"] += 1
        assert problem.gap + problem.cost @ step < 1e-10
        general = solve(problem)
        np.testing.assert_allclose(problem.reward @ step, problem.reward @ general, rtol=1e-5, atol=1e-7)
        if weights[1] != 0:
            np.testing.assert_allclose(-weights[1], bisect(problem), rtol=1e-9)
            np.testing.assert_allclose(problem.gap + problem.cost @ step, 0.0, atol=1e-10)
    assert min(kinds.values()) > 40, kinds


def test_a_cost_that_no_step_changes_is_left_out() -> None:
    weights = multipliers.optimal_weights(jnp.array([[2.0, 0.0], [0.0, 0.0]]), jnp.asarray(3.0), 0.01)
    np.testing.assert_array_equal(weights, [1.0, 0.0])


def test_parallel_gradients_are_solved_too() -> None:
    """Reward and cost rise together, the cost is at its limit: nothing can be gained, and nothing becomes NaN."""
    weights = multipliers.optimal_weights(jnp.array([[1.0, 2.0], [2.0, 4.0]]), jnp.asarray(0.0), 0.01)
    np.testing.assert_allclose(weights, [1.0, -0.5], rtol=1e-6)


@pytest.mark.parametrize("gram", [[[1.0, 2.0], [2.0, 4.0]], [[0.0, 0.0], [0.0, 1.0]]])
def test_above_the_limit_with_nothing_to_gain_the_cost_is_descended(gram: list[list[float]]) -> None:
    """Reward and cost rise together, or there is no reward at all."""
    np.testing.assert_array_equal(multipliers.optimal_weights(jnp.array(gram), jnp.asarray(0.05), 0.5), [0.0, -1.0])


def test_a_standardised_cost_has_not_the_unit_of_the_gap() -> None:
    for choice in ({"method": "cpo_il"}, {"method": "ccil", "multiplier_update": "optimal"}):
        with pytest.raises(ConfigError, match="standardize_cost_advantage"):
            validate(Config(**choice, standardize_cost_advantage=True))


GAINS = Gains(proportional=0.5, integral=0.1, derivative=2.0, smoothing=0.5)


def test_the_pid_controller_by_hand() -> None:
    """Errors 1, 1, -2 smooth to 0.5, 0.75, -0.625; the integral is 0.3 (its start) + 0.1, + 0.1, - 0.2."""
    state, found = multipliers.pid_init(0.3), []
    for error in (1.0, 1.0, -2.0):
        state = multipliers.pid_step(state, jnp.asarray(error), GAINS, 100.0)
        found.append(float(state.multiplier))
    expected = [0.25 + 0.4 + 2 * 0.5, 0.375 + 0.5 + 2 * 0.25, max(0.0, -0.3125 + 0.3)]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_integral_does_not_wind_up() -> None:
    """After long times at either end a few updates bring the multiplier back, not as many as it was there."""

    def after(error: float, number: int, state: Pid) -> Pid:
        for _ in range(number):
            state = multipliers.pid_step(state, jnp.asarray(error), GAINS, 2.0)
        return state

    top = after(1.0, 300, multipliers.pid_init(0.0))
    assert float(top.multiplier) == float(top.integral) == 2.0
    assert float(after(-1.0, 25, top).multiplier) == 0.0
    bottom = after(-1.0, 300, top)
    assert float(bottom.multiplier) == float(bottom.integral) == 0.0
    assert float(after(1.0, 5, bottom).multiplier) > 0.4


def test_the_controller_sees_the_gap_relative_to_the_limit() -> None:
    found = []
    for limit in (10.0, 1000.0):
        constraint = constraints.pid(Config(method="pid_il", cost_limit=limit))
        state, _ = constraint.update(constraint.init(), jnp.asarray(0.3 * limit), None)
        found.append(float(constraint.multiplier(state)))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6)
    assert found[0] > 0.01


@pytest.mark.parametrize("choice", ["pid", "optimal"])
def test_malm_needs_a_multiplier_with_a_parameter(choice: str) -> None:
    with pytest.raises(ConfigError, match="multiplier_update"):
        validate(Config(method="malm", multiplier_update=choice))
