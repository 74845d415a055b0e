"""One training run from checked choices to a finished run folder; shared by `train` and `expert`."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccil_jax import locking
from ccil_jax.config import Config
from ccil_jax.demonstrations import Demonstrations
from experiments import devices, faults, run_folder, summary
from experiments.interruption import Interruption
from experiments.progress import Display

if TYPE_CHECKING:
    from ccil_jax.evaluation import Evaluation
    from ccil_jax.runner import History, Progress, Result

_EVALUATION_SEED_OFFSET = 10_000_019  # keeps evaluation episodes apart from training with the same --seed


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """Everything that was decided, and checked, before JAX is imported."""

    config: Config
    preset: str
    task: str
    physics: str
    env_options: dict[str, Any]  # of `envs.make`: cost_threshold (per step), contact_cost, max_episode_steps
    demonstrations: Demonstrations | None
    demonstrations_path: Path | None
    num_seeds: int
    seed: int
    folder: Path
    resume: bool
    eval_episodes: int
    command: str

    @property
    def cost_limit(self) -> float | None:
        """The episode cost that training is held against: the prescribed limit, else J_E of the demonstrations."""
        if self.config.cost_limit is not None or self.demonstrations is None:
            return self.config.cost_limit
        return self.demonstrations.mean_episode_cost

    @property
    def evaluation_seed(self) -> int:
        """Seed of the evaluation episodes."""
        return (self.seed + _EVALUATION_SEED_OFFSET) % 2**32


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """A finished run: what was learnt and how it did."""

    plan: Plan  # as carried out
    result: "Result"
    env: Any
    evaluation: "Evaluation"  # [num_seeds, num_episodes]
    random: "Evaluation"  # [1, num_episodes]
    summary: dict[str, Any]

    @property
    def status(self) -> int:
        """Exit status: 1 where a seed had to be given up."""
        return int(self.result.stopped.any())


def execute(plan: Plan) -> Outcome:
    """Trains, evaluates, writes the whole run folder and prints the table.

    Raises:
        LockedError: another process works in the run folder.
        SystemExit: a signal ended the run; its state is saved.
    """
    with (
        locking.hold(plan.folder / "checkpoints" / ".run.lock"),
        Display(f"{plan.config.method} {plan.task}", plan.config.num_iterations, plan.cost_limit) as display,
        Interruption() as interruption,
    ):
        display.message(
            f"{plan.config.method} on {plan.task}: {plan.num_seeds} seed(s), {plan.config.env_steps:,} steps each, "
            f"into {plan.folder}; compiling ..."
        )
        devices.spread_seeds(plan.num_seeds)
        import envs  # with JAX behind it: not before the input has been checked

        env = envs.make(plan.task, physics=plan.physics, **plan.env_options)
        # A resumed run was made by all its commands: the first, and those that continued it.
        earlier = [run_folder.read_run(plan.folder).facts["command"]] if plan.resume else []
        plan = dataclasses.replace(plan, command="\n".join([*earlier, plan.command]))
        run_folder.write_config(plan.folder, plan.config, _facts(plan, env))
        result, rate = _train(plan, env, display, interruption)
        for seed in np.flatnonzero(result.stopped):
            display.message(f"seed {seed} stopped: {faults.write(plan.folder, result, int(seed))}")
        display.message(f"evaluating {plan.eval_episodes} episodes per seed ...")
        from ccil_jax import evaluation

        evaluated = evaluation.evaluate(
            result.config, result.agent, env, num_episodes=plan.eval_episodes, seed=plan.evaluation_seed
        )
        random = evaluation.random_policy(env, num_episodes=plan.eval_episodes, seed=plan.evaluation_seed)
        content = _finish(plan, result, rate, evaluated, random)
    return Outcome(plan=plan, result=result, env=env, evaluation=evaluated, random=random, summary=content)


def _train(plan: Plan, env: Any, display: Display, interruption: Interruption) -> tuple["Result", float | None]:
    """The result, and environment steps per second of all seeds, compilation aside (None if nothing was left to do)."""
    from ccil_jax import runner

    steps = seconds = 0.0

    with run_folder.MetricsWriter(plan.folder) as writer:

        def on_start(history: "History") -> None:
            writer.begin(history)
            interruption.defer()

        def on_progress(progress: "Progress") -> None:
            nonlocal steps, seconds
            new_steps = progress.metrics["env_steps"].size * plan.config.steps_per_iteration
            steps += new_steps
            seconds += new_steps / progress.env_steps_per_second
            writer.write(progress.iteration, progress.metrics)
            display.update(progress)

        result = runner.train(
            plan.config,
            env,
            plan.demonstrations,
            num_seeds=plan.num_seeds,
            seed=plan.seed,
            checkpoint_dir=plan.folder.resolve() / "checkpoints",  # orbax fails in the background on a relative path
            resume=plan.resume,
            on_start=on_start,
            on_progress=on_progress,
            should_stop=interruption.requested,
        )
    done = result.env_steps // plan.config.steps_per_iteration
    interruption.settle(
        f"stopped and saved after iteration {done} of {plan.config.num_iterations}; continue with --resume"
    )
    return result, steps / seconds if seconds else None


def _facts(plan: Plan, env: Any) -> dict[str, Any]:
    import jax

    demonstrations = None
    if plan.demonstrations is not None and plan.demonstrations_path is not None:
        demonstrations = {
            "file": str(plan.demonstrations_path.resolve()),
            "sha256": run_folder.sha256(plan.demonstrations_path),
            "num_episodes": plan.demonstrations.num_episodes,
        }
    device = jax.devices()[0]
    return {
        "task": plan.task,
        "physics": env.physics_name,
        "env_options": plan.env_options,
        "preset": plan.preset,
        "command": plan.command,
        "seed": plan.seed,
        "num_seeds": plan.num_seeds,
        "eval_episodes": plan.eval_episodes,
        "demonstrations": demonstrations,
        "expert_return": plan.demonstrations.mean_episode_return if plan.demonstrations else None,
        "expert_cost": plan.demonstrations.mean_episode_cost if plan.demonstrations else None,
        "expert_length": plan.demonstrations.mean_episode_length if plan.demonstrations else None,
        "device": {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count()},
    }


def _finish(
    plan: Plan, result: "Result", rate: float | None, evaluated: "Evaluation", random: "Evaluation"
) -> dict[str, Any]:
    """Writes summary and figures, prints the table, returns the summary."""
    from experiments import figures  # imports matplotlib: no argument error should wait for it

    reference = summary.Reference(
        expert_return=plan.demonstrations.mean_episode_return if plan.demonstrations else None,
        expert_cost=plan.demonstrations.mean_episode_cost if plan.demonstrations else None,
        random_return=float(np.mean(random.episode_return)),
        random_cost=float(np.mean(random.episode_cost)),
        cost_limit=plan.config.cost_limit,
    )
    metrics = run_folder.read_metrics(plan.folder)
    rows = summary.per_seed_scores(evaluated, metrics["cost_rate"][-1], reference)
    aggregate = summary.aggregate_scores(rows)
    content = {
        "task": plan.task,
        "method": plan.config.method,
        "num_seeds": plan.num_seeds,
        **dataclasses.asdict(reference),
        "evaluation": {"simulator": "ours", "num_episodes": plan.eval_episodes, "deterministic": False},
        "per_seed": rows,
        "aggregate": aggregate,
        "env_steps": result.env_steps,
        "env_steps_per_second": rate,
        "wall_seconds": result.wall_seconds,
        "compile_seconds": result.compile_seconds,
    }
    run_folder.write_json(plan.folder / "summary.json", content)
    figure = figures.draw_run(plan.folder)
    title = f"{plan.config.method} on {plan.task}, {plan.eval_episodes} evaluation episodes per seed"
    summary.print_table(title, rows, aggregate, reference)
    print(f"figure  {figure}\nrun     {plan.folder}")
    return content
