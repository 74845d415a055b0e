"""Times the original safety-gymnasium 1.0.0 on random actions: the other side of the benchmark's ratio.

Needs the environment of `record_safety_gym.py`. One process, as the package runs:

    .venv310/bin/python tests/golden/time_safety_gym.py PointGoal1 CarGoal1 DoggoGoal1 PointButton1

Prints control steps per second of stepping alone and of whole 1000-step episodes with their resets, which build and
compile a world anew; medians over the episodes.
"""

import argparse
import time
from typing import Any

import numpy as np


def time_episode(env: Any, seed: int) -> tuple[int, float, float]:
    """Steps of one episode of random actions, the seconds that they took, and those of the reset before."""
    start = time.perf_counter()
    env.reset(seed=seed)
    begun = time.perf_counter()
    random, num_steps, done = np.random.default_rng(seed), 0, False
    space = env.action_space
    while not done:
        *_, terminated, truncated, _ = env.step(random.uniform(space.low, space.high))
        num_steps, done = num_steps + 1, terminated or truncated
    return num_steps, time.perf_counter() - begun, begun - start


def main() -> None:
    """Entry point."""
    import safety_gymnasium  # type: ignore[import-not-found]

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="+", metavar="TASK")
    parser.add_argument("--episodes", type=int, default=5)
    arguments = parser.parse_args()
    for task in arguments.tasks:
        env = safety_gymnasium.make(f"Safety{task}-v0")
        env.reset(seed=0)  # imports and caches
        times = [time_episode(env, seed) for seed in range(arguments.episodes)]
        stepping = float(np.median([steps / seconds for steps, seconds, _ in times]))
        whole = float(np.median([steps / (seconds + reset) for steps, seconds, reset in times]))
        reset = float(np.median([reset for *_, reset in times]))
        print(f"{task}: {stepping:,.0f} steps/s, {whole:,.0f} with resets ({reset:.2f} s each)", flush=True)


if __name__ == "__main__":
    main()
