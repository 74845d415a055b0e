"""The claims of Theorem 1, each computed exactly and compared with the largest error allowed."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from experiments.theory import tabular
from experiments.theory.tabular import Array, Solution
from experiments.theory.theorem1_methods import NUM_ROUNDS, Run
from experiments.theory.theorem1_problem import BETA, Problem, random_occupancies

BOUNDS = np.geomspace(1e-2, 1e2, 41)  # L: upper bounds of the multiplier
BETAS = np.geomspace(1e-4, 1e-2, 9)


@dataclasses.dataclass(frozen=True)
class Check:
    """One claim: `measured` must be at most `tolerance`."""

    claim: str
    measured: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the claim holds; a NaN does not."""
        return bool(self.measured <= self.tolerance)


def check_discriminator(problem: Problem) -> list[Check]:
    """Equation 2, maximised numerically entry by entry (bounded scalar search), for 20 random learners."""
    from scipy.optimize import minimize_scalar

    value_error = argument_error = 0.0
    for rho in random_occupancies(problem, 20):
        found = np.empty_like(rho)
        for index, (learner, expert) in enumerate(zip(rho.ravel(), problem.cheap.ravel(), strict=True)):
            result = minimize_scalar(
                lambda d, learner=learner, expert=expert: -learner * np.log(d) - expert * np.log1p(-d),
                bounds=(1e-12, 1 - 1e-12),
                method="bounded",
                options={"xatol": 1e-12},
            )
            found.flat[index] = result.x
        value = np.sum(rho * np.log(found)) + np.sum(problem.cheap * np.log1p(-found))
        value_error = max(value_error, abs(value - tabular.divergence(rho, problem.cheap)))
        argument_error = max(
            argument_error, float(np.max(np.abs(found - tabular.best_discriminator(rho, problem.cheap))))
        )
    return [
        Check("max over D of the objective = 2 JS - log 4, 20 learners: largest error", value_error, 1e-10),
        Check("its maximiser D* = rho / (rho + rho_E): largest error", argument_error, 1e-5),
    ]


def bounded_learners(problem: Problem) -> list[Solution]:
    """The learner of the cheap expert for each bound L of the multiplier."""
    return [tabular.saddle(problem.process, problem.cheap, BETA, bound) for bound in BOUNDS]


def check_bounded_multiplier(problem: Problem, learners: Sequence[Solution]) -> list[Check]:
    """With lambda in [0, L], psi* is 2 JS - log 4 + L [J - J_E]_+, which is an exact penalty for L >= lambda*."""
    process, solution = problem.process, problem.bound_by_cheap
    expert_cost = process.episode_cost(problem.cheap)
    worst = 0.0
    for learner, bound in zip(learners, BOUNDS, strict=True):
        penalised = tabular.divergence(learner.rho, problem.cheap) - BETA * tabular.entropy(learner.rho)
        penalised += bound * max(0.0, process.episode_cost(learner.rho) - expert_cost)
        for rho in random_occupancies(problem, 20):  # it is the penalised problem's minimum
            other = tabular.divergence(rho, problem.cheap) - BETA * tabular.entropy(rho)
            worst = max(worst, penalised - other - bound * max(0.0, process.episode_cost(rho) - expert_cost))
        worst = max(worst, abs(penalised - learner.value))
    large = [x.rho for x, bound in zip(learners, BOUNDS, strict=True) if bound > solution.multiplier]
    small = [x for x, bound in zip(learners, BOUNDS, strict=True) if bound < 0.99 * solution.multiplier]
    least_excess = min(process.episode_cost(x.rho) - expert_cost for x in small)
    return [
        Check("lambda in [0, L] adds L [J - J_E]_+, 41 bounds: largest error of the minimum", worst, 1e-9),
        Check(
            "L above lambda* changes nothing: largest difference of occupancy",
            max(float(np.max(np.abs(rho - solution.rho))) for rho in large),
            1e-9,
        ),
        Check("L below lambda* is too little: cost left above J_E, negated", -least_excess, -1e-6),
    ]


def check_minimax(problem: Problem) -> list[Check]:
    """min max = max min: the dual function at (D*, lambda*), by soft value iteration, has the value of the minimum."""
    checks = []
    for name, expert, solution in (
        ("cheap", problem.cheap, problem.bound_by_cheap),
        ("costly", problem.costly, problem.bound_by_costly),
    ):
        best = tabular.best_discriminator(solution.rho, expert)
        dual = tabular.dual_value(problem.process, expert, BETA, best, solution.multiplier)
        checks.append(
            Check(f"min max = max min, {name} expert: duality gap at (D*, lambda*)", abs(solution.value - dual), 1e-9)
        )
        reward = -np.log(best) - solution.multiplier * problem.process.cost
        policy, _ = tabular.soft_optimum(problem.process, reward, BETA)
        difference = np.max(np.abs(policy - tabular.policy_of(solution.rho)))
        checks.append(Check(f"RL on what IRL found is the learner, {name} expert (proposition 3)", difference, 1e-8))
        others = (
            tabular.dual_value(
                problem.process,
                expert,
                BETA,
                problem.random.uniform(0.05, 0.95, expert.shape),
                problem.random.uniform(0, 5),
            )
            for _ in range(50)
        )
        above = max(others) - solution.value
        checks.append(Check(f"50 other (D, lambda) guarantee less, {name} expert: most, less the value", above, 0.0))
    return checks


def check_slackness(problem: Problem) -> list[Check]:
    """Complementary slackness, lambda* (J - J_E) = 0: the multiplier is positive only if J = J_E."""
    excess = {
        name: problem.process.episode_cost(solution.rho) - problem.process.episode_cost(expert)
        for name, expert, solution in (
            ("cheap", problem.cheap, problem.bound_by_cheap),
            ("costly", problem.costly, problem.bound_by_costly),
        )
    }
    return [
        Check("cheap expert: |J - J_E| at the solution", abs(excess["cheap"]), 1e-9),
        Check("cheap expert: -lambda* (must be negative)", -problem.bound_by_cheap.multiplier, -0.01),
        Check("costly expert: lambda*", problem.bound_by_costly.multiplier, 0.0),
        Check("costly expert: J - J_E (must be negative)", excess["costly"], -0.001),
    ]


def distances(problem: Problem) -> Array:
    """The largest difference of occupancy between learner and cheap expert, for each of `BETAS`."""
    learners = (tabular.saddle(problem.process, problem.cheap, beta) for beta in BETAS)
    return np.array([np.max(np.abs(x.rho - problem.cheap)) for x in learners])


def check_small_entropy(found: Array) -> list[Check]:
    """As beta goes to 0, the learner goes to the expert, and the distance is proportional to beta."""
    slope = np.polyfit(np.log(BETAS), np.log(found), 1)[0]
    return [
        Check("beta -> 0 recovers the expert: distance at beta = 1e-4", float(found[0]), 1e-2),
        Check("linearly in beta: |slope - 1| in log-log scale", abs(float(slope) - 1), 0.05),
    ]


def check_methods(problem: Problem, ccil: Run, cvag: Run, settled: Solution) -> list[Check]:
    """CCIL converges to the saddle point; CVAG stays close to J = J_E, on alternating sides of it."""
    expert_cost, half = problem.process.episode_cost(problem.cheap), NUM_ROUNDS // 2
    error = abs(ccil.multiplier[-1] - problem.bound_by_cheap.multiplier)
    sliding = float(np.mean(cvag.cost[half:])) - expert_cost
    return [
        Check("CCIL ends at the saddle: largest difference of occupancy", float(ccil.distance[-1]), 1e-6),
        Check("CCIL's multiplier ends at lambda*", float(error), 1e-5),
        Check("CVAG slides along J = J_E: |mean J - J_E|, second half", abs(sliding), 2e-3),
        Check(
            "its share a of reward steps: |(1 - a) / a - lambda*|, relative",
            abs(float(cvag.multiplier[-1]) / settled.multiplier - 1),
            0.05,
        ),
        Check("and it stays near that saddle: occupancy, second half", float(np.max(cvag.distance[half:])), 1e-2),
    ]
