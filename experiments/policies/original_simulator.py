"""Episodes of a learnt policy in gymnasium's own `-v5` environments, in one process and without our physics.

Reward and cost are computed by the task's rule (`envs.locomotion`) from the reward terms that gymnasium reports.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ccil_jax.config import Config
from envs.registry import TASKS
from experiments.policies.numpy_policy import NumpyPolicy, policies

_TERMS = {
    "forward": "reward_forward",
    "healthy": "reward_survive",
    "control": "reward_ctrl",
    "contact": "reward_contact",
}


@dataclasses.dataclass(frozen=True)
class Totals:
    """Undiscounted totals of whole episodes, [num_seeds, num_episodes] each."""

    episode_return: np.ndarray
    episode_cost: np.ndarray
    episode_length: np.ndarray


def evaluate(
    config: Config,
    actor: Any,
    env: Any,
    *,
    num_episodes: int,
    seed: int = 0,
    deterministic: bool | None = None,
    draws: Sequence[int] | None = None,
    contact_cost: bool = True,
    on_progress: Callable[[int, int], None] | None = None,
) -> Totals:
    """The same as `ccil_jax.acting.evaluation.evaluate`, in gymnasium's simulator. `actor` is [num_seeds]-leading.

    `contact_cost` is the option of that name with which `env` was made. `on_progress` counts episodes.
    """
    simulator, learnt, results = make_simulator(env), policies(config, actor, env), []
    by_mode = config.acts_by_mode(deterministic)
    for draw, policy in zip(range(len(learnt)) if draws is None else draws, learnt, strict=True):
        random = np.random.default_rng([seed, draw])
        for episode in range(num_episodes):
            (start,) = np.random.SeedSequence([seed, draw, episode]).generate_state(1)
            steps = run_episode(simulator, policy, random, int(start), by_mode)
            results.append(score(env, steps, contact_cost))
            if on_progress is not None:
                on_progress(len(results), len(learnt) * num_episodes)
    simulator.close()
    totals = np.array(results).reshape(len(learnt), num_episodes, 3)
    return Totals(totals[..., 0], totals[..., 1], totals[..., 2])


def make_simulator(env: Any) -> Any:
    """Gymnasium's own environment of the task of `env`, with the same observations and time limit."""
    import gymnasium

    task = TASKS[env.name]
    if task.original is None:
        raise ValueError(f"{task.name}: has no original in gymnasium; evaluate it in our own simulator")
    return gymnasium.make(task.original, max_episode_steps=env.max_episode_steps, **task.original_options)


def run_episode(
    simulator: Any, policy: NumpyPolicy, random: np.random.Generator, seed: int, deterministic: bool
) -> dict[str, np.ndarray]:
    """What gymnasium reports at each of T steps: `velocity [T, 2]` and the four reward terms `[T]`."""
    obs, _ = simulator.reset(seed=seed)
    rows = []
    done = False
    while not done:
        action = policy.mode(obs) if deterministic else policy.sample(obs, random)
        obs, _, terminated, truncated, info = simulator.step(action)
        done = terminated or truncated
        velocity = [info["x_velocity"], info.get("y_velocity", 0.0)]
        rows.append(velocity + [info.get(key, 0.0) for key in _TERMS.values()])
    table = np.array(rows)
    return {"velocity": table[:, :2], **{name: table[:, 2 + i] for i, name in enumerate(_TERMS)}}


def score(env: Any, steps: dict[str, np.ndarray], contact_cost: bool) -> tuple[float, float, int]:
    """Return, cost and length of an episode under the task's rule."""
    import jax
    import jax.numpy as jnp

    from envs.locomotion_tasks import CostInputs

    reward = sum(steps[name] for name in env.task.reward_terms)
    inputs = CostInputs(
        velocity=jnp.asarray(steps["velocity"]),
        control_cost=jnp.asarray(-steps["control"]),
        contact_cost=jnp.asarray(-steps["contact"] * contact_cost),
    )
    cost = np.asarray(jax.vmap(env.task.cost_quantity)(inputs)) > env.cost_threshold
    return float(np.sum(reward)), float(np.sum(cost)), len(cost)
