"""Evaluates a finished run: its policies play fresh episodes, in our simulator or in the original one."""

import dataclasses
from typing import Any

from ccil_jax.config import Config
from envs.registry import TaskInfo
from experiments.runs import run_folder, summary
from experiments.runs.environments import build_environment
from experiments.runs.provenance import provenance
from experiments.runs.run_folder import Run


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """How a run is evaluated. The result file has these fields under the same names."""

    simulator: str  # one of `evaluations.SIMULATORS`
    num_episodes: int  # of each seed
    seed: int  # of the episodes
    deterministic: bool  # whether policies act with their modes instead of sampling
    shared_episodes: bool  # whether all seeds play the same starts, layouts and noise


@dataclasses.dataclass(frozen=True, kw_only=True)
class Loaded:
    """The policies of a run, ready to act."""

    run: Run
    task: TaskInfo
    env: Any
    config: Config
    actor: Any  # `ccil_jax.acting.rollout.Actor`, [num_seeds]-leading


def load(run: Run) -> Loaded:
    """Builds the task of a run and reads the policies from its newest checkpoint.

    Raises:
        UserError: the task is not known here, or the checkpoint cannot be read.
    """
    task = run_folder.task_of(run)
    from ccil_jax.training import runner

    env = build_environment(task.name, run.facts["physics"], run.facts["env_options"])
    loaded = runner.load(run.config, env, run.folder.resolve() / "checkpoints", run.facts["num_seeds"])
    return Loaded(run=run, task=task, env=env, config=loaded.config, actor=loaded.actor)


def play(loaded: Loaded, settings: Settings) -> Any:
    """Plays the episodes: `episode_return`, `episode_cost` and `episode_length`, [num_seeds, num_episodes] each."""
    from ccil_jax.acting import evaluation
    from experiments.policies import original_simulator

    of_episodes: dict[str, Any] = {
        "num_episodes": settings.num_episodes,
        "seed": settings.seed,
        "deterministic": settings.deterministic,
        "draws": [0] * loaded.run.facts["num_seeds"] if settings.shared_episodes else None,
    }
    if settings.simulator == "ours":
        return evaluation.evaluate(loaded.config, loaded.actor, loaded.env, **of_episodes)
    contact_cost = loaded.run.facts["env_options"].get("contact_cost", True)
    return original_simulator.evaluate(
        loaded.config, loaded.actor, loaded.env, contact_cost=contact_cost, **of_episodes
    )


def judge(loaded: Loaded, settings: Settings, episodes: Any) -> tuple[dict[str, Any], summary.Reference]:
    """The entry of the result file for `episodes`, as `play` returns them, and the levels that they are compared with.

    The level of the random policy comes from episodes in our simulator.
    """
    from ccil_jax.acting import evaluation

    random = evaluation.random_policy(loaded.env, num_episodes=settings.num_episodes, seed=settings.seed)
    reference = summary.make_reference(loaded.run.facts, random, loaded.run.config.prescribed_limit)
    rows = summary.per_seed_scores(episodes, None, reference)
    return {
        "run": str(loaded.run.folder.resolve()),
        **dataclasses.asdict(settings),
        **provenance(),
        **dataclasses.asdict(reference),
        "per_seed": rows,
        "aggregate": summary.aggregate_scores(rows),
        "violation_beyond_error": summary.mean_violation_beyond_error(rows, reference),
    }, reference


def facts_of(loaded: Loaded, settings: Settings) -> dict[str, Any]:
    """The metadata of exported policies, which says how the episodes in the file were played."""
    return {
        "task": loaded.task.name,
        "original": loaded.task.original,
        **dataclasses.asdict(settings),
        **provenance(),
    }
