"""CCIL and CVAG as the paper prints them, with exact gradients, on the process of Theorem 1."""

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
    multiplier: Array  # [rounds] lambda, or of CVAG the one that its share of reward steps amounts to
    distance: Array  # [rounds] largest difference of an occupancy from the solution's


def imitation_reward(problem: Problem, policy: Array) -> tuple[Array, Array]:
    """The policy's occupancy, and -log D* less beta log pi: the slope of its entropy is part of the reward."""
    rho = problem.process.occupancy(policy)
    return rho, -np.log(tabular.best_discriminator(rho, problem.cheap)) - BETA * np.log(policy)


def run_ccil(problem: Problem, size: float = 0.2, rate: float = 0.5) -> Run:
    """CCIL: a natural step on reward less lambda times cost, then dual ascent on the gap."""
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
    """CVAG: a step on the reward while J is at most J_E, else on less cost; both with entropy, as printed.

    The second value is what it should settle at. With a share a of reward steps the mean step is a (reward) - (1 - a)
    (cost) + beta (entropy), so lambda = (1 - a) / a, and the entropy weighs beta / a.
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
