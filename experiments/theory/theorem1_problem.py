"""The decision process on which Theorem 1 is checked, its two experts, and their learners."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from experiments.theory import tabular
from experiments.theory.tabular import Array, Process, Solution

BETA = 0.1  # weight of the entropy. Without it the learner would equal the expert, and no constraint would be active


@dataclasses.dataclass(frozen=True, kw_only=True)
class Problem:
    """A process with a cheap and a costly expert, given by their occupancies, and the learners of both."""

    process: Process
    cheap: Array
    costly: Array
    bound_by_cheap: Solution
    bound_by_costly: Solution
    random: np.random.Generator


def make_problem(seed: int) -> Problem:
    """Draws processes until the constraint is active for the learner of one expert and inactive for that of the other.

    Both experts maximise a random reward and some entropy; one of them avoids costs, the other seeks them.
    """
    random = np.random.default_rng(seed)
    while True:
        process = tabular.random_process(random)
        reward = random.uniform(size=process.cost.shape)
        cheap, costly = (
            process.occupancy(tabular.soft_optimum(process, reward + liking * process.cost, 0.2)[0])
            for liking in (-1.0, 4.0)
        )
        learners = [tabular.saddle(process, expert, BETA) for expert in (cheap, costly)]
        slack = process.episode_cost(costly) - process.episode_cost(learners[1].rho)
        if learners[0].multiplier > 0.05 and slack > 1e-3:
            return Problem(
                process=process,
                cheap=cheap,
                costly=costly,
                bound_by_cheap=learners[0],
                bound_by_costly=learners[1],
                random=random,
            )


def random_occupancies(problem: Problem, number: int) -> Iterator[Array]:
    """Occupancies of random policies."""
    shape = problem.cheap.shape
    for _ in range(number):
        yield problem.process.occupancy(problem.random.dirichlet(np.ones(shape[1]), shape[0]))
