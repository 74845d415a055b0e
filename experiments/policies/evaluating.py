"""Evaluates policies, of a run or of a file: they play fresh episodes, in our simulator or in the original one."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ccil_jax.config import Config
from envs.registry import TaskInfo
from experiments.cli.command_line import command
from experiments.policies.policy_file import PolicyFile
from experiments.runs import recording, run_folder, summary
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
    """Policies of one training, ready to act."""

    source: Path  # the folder of the run, or the file of the policies
    task: TaskInfo
    env: Any
    config: Config  # of the policies; of a file it says no more than what their networks are
    actor: Any  # `ccil_jax.acting.rollout.Actor`, [num_policies]-leading
    training: Mapping[str, Any]  # `recording.training`, and `seed_indices`: the seed of each policy
    levels: Mapping[str, float | None]  # of the demonstrations, see `summary.levels_of`
    command: str  # those that made the policies, one a line

    @property
    def num_policies(self) -> int:
        """How many policies there are."""
        return len(self.training["seed_indices"])

    def only(self, index: int) -> "Loaded":
        """The policy `index` alone."""
        import jax

        training = {**self.training, "seed_indices": [self.training["seed_indices"][index]]}
        actor = jax.tree.map(lambda leaf: leaf[index : index + 1], self.actor)
        return dataclasses.replace(self, actor=actor, training=training)


def build(task: TaskInfo, facts: Mapping[str, Any]) -> Any:
    """Builds `task` as the policies of a run or a file know it: with the `physics` and `env_options` in `facts`.

    Raises:
        UserError: the task cannot be built.
    """
    return build_environment(task.name, facts["physics"], facts["env_options"])


def load(run: Run, env: Any) -> Loaded:
    """Reads the policies of a run on `env`, its task, from the newest checkpoint.

    Raises:
        UserError: the task is not known here, or the checkpoint cannot be read.
    """
    from ccil_jax.training import runner

    loaded = runner.load(run.config, env, run.folder.resolve() / "checkpoints", run.facts["num_seeds"])
    return of_run(run, env, loaded.config, loaded.actor, loaded.env_steps)


def of_run(run: Run, env: Any, config: Config, actor: Any, env_steps: int) -> Loaded:
    """The policies `actor` of a run on `env`, whose training took `env_steps` for each seed."""
    return Loaded(
        source=run.folder.resolve(),
        task=run_folder.task_of(run),
        env=env,
        config=config,
        actor=actor,
        training={**recording.training(run, env_steps), "seed_indices": list(range(run.facts["num_seeds"]))},
        levels=summary.levels_of(run.facts),
        command=run.facts["command"],
    )


def load_file(file: PolicyFile, task: TaskInfo, env: Any) -> Loaded:
    """The policies of a file on `env`, an environment of `task`. Raises `UserError` where they do not fit it."""
    file.check_sizes(env.obs_dim, env.action_dim)
    training = file.training
    return Loaded(
        source=file.path.resolve(),
        task=task,
        env=env,
        config=file.config,
        actor=file.actor(),
        training=training,
        levels=summary.levels_of(file.metadata["levels"]),
        command=str(file.metadata.get("command")),
    )


def play(loaded: Loaded, settings: Settings, on_progress: Callable[[int, int], None] | None = None) -> Any:
    """Plays the episodes: `episode_return`, `episode_cost` and `episode_length`, [num_seeds, num_episodes] each.

    `on_progress` is told now and then how much of how much is done: steps of all episodes together in our simulator,
    episodes in the original one.
    """
    from ccil_jax.acting import evaluation
    from experiments.policies import original_simulator

    of_episodes: dict[str, Any] = {
        "num_episodes": settings.num_episodes,
        "seed": settings.seed,
        "deterministic": settings.deterministic,
        "draws": [0] * loaded.num_policies if settings.shared_episodes else None,
        "on_progress": on_progress,
    }
    if settings.simulator == "ours":
        return evaluation.evaluate(loaded.config, loaded.actor, loaded.env, **of_episodes)
    contact_cost = loaded.training["env_options"].get("contact_cost", True)
    return original_simulator.evaluate(
        loaded.config, loaded.actor, loaded.env, contact_cost=contact_cost, **of_episodes
    )


def only(episodes: Any, index: int) -> Any:
    """The episodes of the policy `index` alone, [1, num_episodes]."""
    return dataclasses.replace(
        episodes,
        **{f.name: getattr(episodes, f.name)[index : index + 1] for f in dataclasses.fields(episodes)},
    )


def judge(loaded: Loaded, settings: Settings, episodes: Any) -> tuple[dict[str, Any], summary.Reference]:
    """The entry of the result file for `episodes`, as `play` returns them, and the levels that they are compared with.

    The level of the random policy comes from episodes in our simulator.
    """
    from ccil_jax.acting import evaluation

    random = evaluation.random_policy(loaded.env, num_episodes=settings.num_episodes, seed=settings.seed)
    reference = summary.make_reference(loaded.levels, random, _prescribed_limit(loaded))
    rows = summary.per_seed_scores(episodes, None, reference)
    return {
        "run": str(loaded.source),
        **dataclasses.asdict(settings),
        **provenance(),
        **dataclasses.asdict(reference),
        "per_seed": rows,
        "aggregate": summary.aggregate_scores(rows),
        "violation_beyond_error": summary.mean_violation_beyond_error(rows, reference),
    }, reference


def _prescribed_limit(loaded: Loaded) -> float | None:
    """The limit that the user gave for the training; None where it had none, or took it from demonstrations."""
    limit: float | None = loaded.training["cost_limit"] if loaded.levels["expert_cost"] is None else None
    return limit


def facts_of(loaded: Loaded, settings: Settings) -> dict[str, Any]:
    """The metadata of exported policies: how they were trained, and how the episodes in the file were played."""
    return {
        "task": loaded.task.name,
        "original": loaded.task.original,
        **dataclasses.asdict(settings),
        **provenance(),
        "command": f"{loaded.command}\n{command()}",
        "training": dict(loaded.training),
        "levels": dict(loaded.levels),
    }
