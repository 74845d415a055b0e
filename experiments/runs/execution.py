"""Training runs from checked choices to finished run folders; shared by `train`, `expert` and the sweeps' workers."""

import contextlib
import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccil_jax.config import Config
from ccil_jax.training import filesystem
from ccil_jax.training.filesystem import file_sha256
from ccil_jax.training.progress import Display
from experiments.cli import xla
from experiments.cli.interruption import Interruption
from experiments.runs import fault_files, run_folder, summary
from experiments.runs.plans import Plan

if TYPE_CHECKING:
    from ccil_jax.acting.evaluation import Evaluation
    from ccil_jax.training.runner import History, Progress, Result


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
    """Trains, evaluates, writes the whole run folder and prints the table. Raises as `execute_together` does."""
    return execute_together([plan], plan.folder / "checkpoints", resume=plan.resume)[0]


def execute_together(
    plans: Sequence[Plan], checkpoint_dir: Path, *, resume: bool, finished: Collection[Path] = ()
) -> list[Outcome]:
    """Carries out plans that differ in traced hyperparameters and folders alone as one program.

    Args:
        plans: all runs of the program.
        checkpoint_dir: holds the checkpoints of all their runs together; in the end each folder has those of its own.
        resume: whether training goes on from the newest checkpoint there, if there is one.
        finished: run folders that are complete: they stay as they are, and have no outcome.

    Raises:
        LockedError: another process works in the run folder.
        SystemExit: a signal ended the run; its state is saved.
    """
    first = plans[0]
    num_runs = sum(plan.num_seeds for plan in plans)
    title = f"{first.config.method} {first.task}"
    with (
        filesystem.hold(checkpoint_dir / ".run.lock"),
        Display(
            title,
            first.config.num_iterations,
            first.config.cost_limit if len({plan.config.cost_limit for plan in plans}) == 1 else None,
            has_multiplier=first.config.has_multiplier,
        ) as display,
        Interruption() as interruption,
    ):
        several = f"{len(plans)} configurations of " if len(plans) > 1 else ""
        display.message(
            f"{first.config.method} on {first.task}: {several}{first.num_seeds} seed(s), "
            f"{_length(first.config)} each, into {checkpoint_dir.parent}; compiling ..."
        )
        xla.spread_seeds(num_runs)
        import envs  # with JAX behind it: not before the input has been checked

        env = envs.make(first.task, physics=first.physics, **first.env_options)
        missing = {i: _with_earlier_commands(plan) for i, plan in enumerate(plans) if plan.folder not in finished}
        for plan in missing.values():
            if not plan.resume:  # else it is written once it is certain that the run goes on
                run_folder.write_config(plan.folder, plan.config, _facts(plan, env))
        results, rate = _train(plans, missing, env, checkpoint_dir, display, interruption, resume=resume)
        carried_out = [(plan, results[i]) for i, plan in missing.items()]
        for plan, result in carried_out:
            for seed in np.flatnonzero(result.stopped):
                display.message(f"seed {seed} stopped: {fault_files.write(plan.folder, result, int(seed))}")
        display.message(f"evaluating {first.eval_episodes} episodes per seed ...")
        evaluations, random = _evaluate(carried_out, env)
        return [
            Outcome(
                plan=plan,
                result=result,
                env=env,
                evaluation=evaluated,
                random=random,
                summary=_finish(plan, result, rate, num_runs, evaluated, random),
            )
            for (plan, result), evaluated in zip(carried_out, evaluations, strict=True)
        ]


def _length(config: Config) -> str:
    return f"{config.bc_epochs} passes" if config.method == "bc" else f"{config.env_steps:,} steps"


def _with_earlier_commands(plan: Plan) -> Plan:
    """A resumed run was made by all its commands: the first, and those that continued it."""
    earlier = [run_folder.read_run(plan.folder).facts["command"]] if plan.resume else []
    return dataclasses.replace(plan, command="\n".join([*earlier, plan.command]))


def _train(
    plans: Sequence[Plan],
    missing: Mapping[int, Plan],
    env: Any,
    checkpoint_dir: Path,
    display: Display,
    interruption: Interruption,
    *,
    resume: bool,
) -> tuple[list["Result"], float | None]:
    """The results, and environment steps per second of all runs, compilation aside (None if nothing was left to do).

    Only the plans `missing`, by their numbers, are written to their folders.
    """
    from ccil_jax.training import runner

    first, steps, seconds = plans[0], 0.0, 0.0
    columns = runner.columns(len(plans), first.num_seeds)

    with contextlib.ExitStack() as stack:
        writers = [
            (stack.enter_context(run_folder.MetricsWriter(plan.folder)), columns[i]) for i, plan in missing.items()
        ]

        def on_start(history: "History") -> None:
            for plan in missing.values():
                if plan.resume:
                    run_folder.write_config(plan.folder, plan.config, _facts(plan, env))
            for writer, own in writers:
                writer.begin({name: rows[:, own] for name, rows in history.items()})
            interruption.defer()

        def on_progress(progress: "Progress") -> None:
            nonlocal steps, seconds
            new_steps = progress.metrics["env_steps"].size * first.config.steps_per_iteration
            steps += new_steps
            if new_steps:  # behaviour cloning takes none
                seconds += new_steps / progress.env_steps_per_second
            for writer, own in writers:
                writer.write(progress.iteration, {name: rows[:, own] for name, rows in progress.metrics.items()})
            display.update(progress)

        results = runner.train_runs(
            [plan.config for plan in plans],
            env,
            first.demonstrations,
            num_seeds=first.num_seeds,
            seed=first.seed,
            one_by_one=first.one_by_one,
            checkpoint_dir=checkpoint_dir.resolve(),  # orbax fails in the background on a relative path
            resume=resume,
            moved=first.moved,
            on_start=on_start,
            on_progress=on_progress,
            should_stop=interruption.requested,
        )
    done = len(results[0].metrics["env_steps"])
    interruption.settle(
        f"stopped and saved after iteration {done} of {first.config.num_iterations}; continue with --resume"
    )
    for i, plan in missing.items():
        if (directory := plan.folder / "checkpoints") != checkpoint_dir:
            runner.save(results[i], directory)
    return results, steps / seconds if seconds else None


def _evaluate(carried_out: Sequence[tuple[Plan, "Result"]], env: Any) -> tuple[list["Evaluation"], "Evaluation"]:
    """Evaluations of all runs, in one program, and that of the random policy."""
    import jax

    from ccil_jax.acting import evaluation
    from ccil_jax.training import runner

    first, result = carried_out[0]
    settings: Any = {"num_episodes": first.eval_episodes, "seed": first.evaluation_seed}
    # Each seed of a run plays episodes of its own, and the same ones whatever is evaluated beside the run.
    draws = list(range(first.num_seeds)) * len(carried_out)
    agents = jax.tree.map(lambda *leaves: jax.numpy.concatenate(leaves), *[result.agent for _, result in carried_out])
    together = evaluation.evaluate(result.config, agents, env, draws=draws, **settings)
    own = runner.columns(len(carried_out), first.num_seeds)
    evaluations = [jax.tree.map(lambda leaf, rows=rows: leaf[rows], together) for rows in own]
    return evaluations, evaluation.random_policy(env, **settings)


def _facts(plan: Plan, env: Any) -> dict[str, Any]:
    import jax

    demonstrations = None
    if plan.demonstrations is not None and plan.demonstrations_path is not None:
        demonstrations = {
            "file": str(plan.demonstrations_path.resolve()),
            "sha256": file_sha256(plan.demonstrations_path),
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
        "one_by_one": plan.one_by_one,
        "num_seeds": plan.num_seeds,
        "eval_episodes": plan.eval_episodes,
        "demonstrations": demonstrations,
        **summary.expert_levels(plan.demonstrations),
        "expert_length": plan.demonstrations.mean_episode_length if plan.demonstrations else None,
        "device": {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count()},
    }


def _finish(
    plan: Plan,
    result: "Result",
    rate: float | None,
    num_runs: int,
    evaluated: "Evaluation",
    random: "Evaluation",
) -> dict[str, Any]:
    """Writes figures and summary, prints the table, returns the summary.

    The summary is the last file to be written: its presence says that the run folder is complete.
    """
    from experiments.runs import figures  # imports matplotlib: no argument error should wait for it

    reference = summary.make_reference(summary.expert_levels(plan.demonstrations), random, plan.config.prescribed_limit)
    metrics = run_folder.read_metrics(plan.folder)
    rows = summary.per_seed_scores(evaluated, metrics["cost_rate"][-1] if "cost_rate" in metrics else None, reference)
    aggregate = summary.aggregate_scores(rows)
    content = {
        "task": plan.task,
        "method": plan.config.method,
        "num_seeds": plan.num_seeds,
        **dataclasses.asdict(reference),
        "evaluation": {"simulator": "ours", "num_episodes": plan.eval_episodes, "deterministic": False},
        "per_seed": rows,
        "aggregate": aggregate,
        "violation_beyond_error": summary.mean_violation_beyond_error(rows, reference),  # of the mean over seeds
        "env_steps": result.env_steps,
        "env_steps_per_second": rate,  # of all runs that shared the program
        "runs_in_program": num_runs,
        "wall_seconds": result.wall_seconds,
        "compile_seconds": result.compile_seconds,
    }
    figure = figures.draw_run(plan.folder)
    run_folder.write_json(plan.folder / "summary.json", content)
    title = f"{plan.config.method} on {plan.task}, {plan.eval_episodes} evaluation episodes per seed"
    summary.print_table(title, rows, aggregate, reference)
    print(f"figure  {figure}\nrun     {plan.folder}")
    return content
