"""CCIL and CVAG with exact gradients, on the process of Theorem 1."""

import dataclasses

import numpy as np

from experiments.theory import tabular
from experiments.theory.tabular import Array, Solution
from experiments.theory.theorem1_problem import BETA, Problem

NUM_ROUNDS = 6000


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """An iterative method on the cheap expert, after each round."""

    cost: Array  # [rounds] J
    multiplier: Array  # [rounds] lambda; for CVAG (1 - a) / a, where a is its share of reward steps
    distance: Array  # [rounds] largest difference between the occupancy and that of the solution


def imitation_reward(problem: Problem, policy: Array) -> tuple[Array, Array]:
    """The occupancy of the policy, and its reward -log D* - beta log pi, which includes the slope of the entropy."""
    rho = problem.process.occupancy(policy)
    return rho, -np.log(tabular.best_discriminator(rho, problem.cheap)) - BETA * np.log(policy)


def run_ccil(problem: Problem, size: float = 0.2, rate: float = 0.5) -> Run:
    """CCIL: each round is a natural gradient step on reward - lambda cost, then dual ascent on the gap J - J_E."""
    process, expert_cost = problem.process, problem.process.episode_cost(problem.cheap)
    policy, multiplier, rows = np.full(problem.cheap.shape, 1 / problem.cheap.shape[1]), 0.0, []
    for _ in range(NUM_ROUNDS):
        rho, reward = imitation_reward(problem, policy)
        cost = process.episode_cost(rho)
        rows.append((cost, multiplier, np.max(np.abs(rho - problem.bound_by_cheap.rho))))
        policy = tabular.natural_step(process, policy, reward - multiplier * process.cost, size)
        multiplier = max(0.0, multiplier + rate * (cost - expert_cost))
    costs, multipliers, away = np.array(rows).T
    return Run(cost=costs, multiplier=multipliers, distance=away)


def run_cvag(problem: Problem, size: float = 0.01) -> tuple[Run, Solution]:
    """CVAG: each round is a step on the reward if J <= J_E, otherwise on the negative cost; both with entropy.

    The second value is the solution that it should stay close to. With a share a of reward steps, the mean step is
    a (reward) - (1 - a) (cost) + beta (entropy). So lambda = (1 - a) / a, and the weight of the entropy is beta / a.
    """
    process, expert_cost = problem.process, problem.process.episode_cost(problem.cheap)
    policy, rows = np.full(problem.cheap.shape, 1 / problem.cheap.shape[1]), []
    for _ in range(NUM_ROUNDS):
        rho, reward = imitation_reward(problem, policy)
        cost = process.episode_cost(rho)
        within = cost <= expert_cost
        rows.append((cost, within, rho))
        policy = tabular.natural_step(
            process, policy, reward if within else -process.cost - BETA * np.log(policy), size
        )
    rewarded = np.array([row[1] for row in rows], float)
    share = np.cumsum(rewarded[NUM_ROUNDS // 2 :]) / np.arange(1, NUM_ROUNDS - NUM_ROUNDS // 2 + 1)
    settled = tabular.saddle(process, problem.cheap, BETA / share[-1])
    window = 200
    recent = np.convolve(rewarded, np.ones(window) / window, mode="valid")
    recent = np.concatenate([np.full(window - 1, np.nan), recent])
    with np.errstate(divide="ignore"):
        multiplier = (1 - recent) / recent
    multiplier[-1] = (1 - share[-1]) / share[-1]
    away = np.array([np.max(np.abs(row[2] - settled.rho)) for row in rows])
    return Run(cost=np.array([row[0] for row in rows]), multiplier=multiplier, distance=away), settled
