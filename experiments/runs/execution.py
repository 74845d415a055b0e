"""Carries out plans: from checked options to finished run folders. Launchers and the sweeps' workers share it."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ccil_jax.training import filesystem
from ccil_jax.training.progress import Display
from experiments.cli import xla
from experiments.cli.command_line import RUN_LOCK
from experiments.cli.interruption import Interruption
from experiments.runs import demonstration_files, fault_files, run_folder, summary
from experiments.runs.environments import build_environment
from experiments.runs.metrics_file import read_metrics
from experiments.runs.plans import ProgramPlan, RunPlan, Setup
from experiments.runs.run_log import RunLog, write_config

if TYPE_CHECKING:
    from ccil_jax.acting.evaluation import Evaluation
    from ccil_jax.training.loop import History, Progress
    from ccil_jax.training.runner import Result


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """A finished run: what was learnt and how well it does."""

    plan: RunPlan  # as carried out
    result: "Result"
    env: Any
    evaluation: "Evaluation"  # [num_seeds, num_episodes]
    random: "Evaluation"  # of the random policy, [1, num_episodes]
    summary: dict[str, Any]  # the content of summary.json

    @property
    def status(self) -> int:
        """Exit status: 1 where a seed had to be given up."""
        return int(self.result.stopped.any())


def execute(plan: RunPlan) -> Outcome:
    """Trains, evaluates, writes the whole run folder and prints the table. Raises as `execute_together` does."""
    alone = ProgramPlan(runs=(plan,), checkpoint_dir=plan.folder / "checkpoints", resume=plan.resume)
    return execute_together(alone)[0]


def execute_together(program: ProgramPlan) -> list[Outcome]:
    """Trains and evaluates all runs of a program, completes their folders and prints a table for each.

    Returns:
        An outcome for each run that was not finished before, in the order of the runs.

    Raises:
        UserError: what can be known only now does not fit, such as the sizes of a task, or the checkpoints cannot be
            continued or written.
        LockedError: another process works in the run folder.
        SystemExit: a signal ended the run; its state is saved.
    """
    setup, config = program.setup, program.config
    with (
        filesystem.hold(program.checkpoint_dir / RUN_LOCK),
        Display(
            f"{config.method} {setup.task}",
            config.num_iterations,
            program.cost_limit,
            has_multiplier=config.has_multiplier,
        ) as display,
        Interruption() as interruption,
        contextlib.ExitStack() as stack,
    ):
        if note := demonstration_files.note_on_rewards(setup.demonstrations, setup.task):
            display.message(f"note: {note}")
        display.message(f"{_announcement(program)}; compiling ...")
        xla.spread_seeds(program.num_runs)
        # This imports JAX, so that it has to wait until the input has been checked.
        from ccil_jax.agents.build import resolve
        from ccil_jax.training import combining

        env = build_environment(setup.task, setup.physics, setup.env_options)
        for run in program.runs:  # what does not fit is refused before anything is written
            resolve(run.config, env, setup.demonstrations)
        todo = {
            i: _with_earlier_commands(run) for i, run in enumerate(program.runs) if run.folder not in program.finished
        }
        for plan in todo.values():
            if not plan.resume:  # of a resumed run it is written once it is certain that the run goes on
                write_config(plan, env)
        columns = combining.columns(len(program.runs), setup.num_seeds)
        log = RunLog(config, [(plan, columns[i]) for i, plan in todo.items()], env, stack)
        for place in log.places:
            display.message(f"Weights & Biases: {place}")
        results = _train(program, todo, log, env, display, interruption)
        trained = [(plan, results[i]) for i, plan in todo.items()]
        for plan, result in trained:
            for seed in np.flatnonzero(result.stopped):
                display.message(f"seed {seed} stopped: {fault_files.write(plan.folder, result, int(seed))}")
            for capped in _at_largest_multiplier(result):
                display.message(
                    f"seed {capped}: the multiplier ended at its largest value, {plan.config.multiplier_max:g}, and "
                    "the cost above its limit: the cost does not follow it"
                )
        display.message(f"evaluating {setup.eval_episodes} episodes per seed, and of the random policy ...")
        evaluations, random = _evaluate(setup, [result for _, result in trained], env)
        rate = log.env_steps_per_second
        outcomes = [
            Outcome(
                plan=plan,
                result=result,
                env=env,
                evaluation=evaluated,
                random=random,
                summary=_finish(plan, result, rate, program.num_runs, evaluated, random),
            )
            for (plan, result), evaluated in zip(trained, evaluations, strict=True)
        ]
        log.finish({outcome.plan.folder: outcome.summary for outcome in outcomes})
        return outcomes


def _at_largest_multiplier(result: "Result") -> list[int]:
    """The seeds whose multiplier could not rise any further while the cost was above its limit."""
    config, metrics = result.config, result.metrics
    if not config.has_multiplier or config.cost_limit is None or not metrics:
        return []
    above = np.asarray(metrics["episode_cost"])[-1] > config.cost_limit
    return [int(i) for i in np.flatnonzero(above & (np.asarray(metrics["multiplier"])[-1] >= config.multiplier_max))]


def _announcement(program: ProgramPlan) -> str:
    setup, config = program.setup, program.config
    several = f"{len(program.runs)} configurations of " if len(program.runs) > 1 else ""
    length = f"{config.cloning_updates:,} updates" if not config.reads("env_steps") else f"{config.env_steps:,} steps"
    return (
        f"{config.method} on {setup.task}: {several}{setup.num_seeds} seed(s), {length} each, into "
        f"{program.checkpoint_dir.parent}"
    )


def _with_earlier_commands(plan: RunPlan) -> RunPlan:
    """The plan with all commands that made the run: those before this process, one a line, and that of this process."""
    earlier = [run_folder.read_run(plan.folder).facts["command"]] if plan.resume else []
    return dataclasses.replace(plan, command="\n".join([*earlier, plan.command]))


def _train(
    program: ProgramPlan,
    todo: Mapping[int, RunPlan],
    log: RunLog,
    env: Any,
    display: Display,
    interruption: Interruption,
) -> list["Result"]:
    """Trains all runs of a program. Only those in `todo`, by their places among all, are written to their folders.

    Returns:
        The results of all runs.
    """
    from ccil_jax.training import runner

    setup, config = program.setup, program.config

    def on_start(history: "History") -> None:
        log.begin(history)
        interruption.defer()

    def on_progress(progress: "Progress") -> None:
        log.write(progress)
        display.update(progress)

    results = runner.train_runs(
        [plan.config for plan in program.runs],
        env,
        setup.demonstrations,
        num_seeds=setup.num_seeds,
        seed=setup.seed,
        one_by_one=setup.one_by_one,
        checkpoint_dir=program.checkpoint_dir.resolve(),  # orbax fails in the background on a relative path
        resume=program.resume,
        moved=setup.moved,
        on_start=on_start,
        on_progress=on_progress,
        should_stop=interruption.requested,
    )
    done = len(results[0].metrics["env_steps"])
    interruption.settle(f"stopped and saved after iteration {done} of {config.num_iterations}; continue with --resume")
    for i, plan in todo.items():
        if (directory := plan.folder / "checkpoints") != program.checkpoint_dir:
            runner.save(results[i], directory)
    return results


def _evaluate(setup: Setup, results: Sequence["Result"], env: Any) -> tuple[list["Evaluation"], "Evaluation"]:
    """Evaluations of all runs, in one program, and that of the random policy."""
    import jax

    from ccil_jax.acting import evaluation
    from ccil_jax.training import combining

    settings: Any = {"num_episodes": setup.eval_episodes, "seed": setup.evaluation_seed}
    # Each seed of a run plays episodes of its own. They are the same whatever is evaluated beside the run.
    draws = list(range(setup.num_seeds)) * len(results)
    agents = jax.tree.map(lambda *leaves: jax.numpy.concatenate(leaves), *[result.actor for result in results])
    together = evaluation.evaluate(results[0].config, agents, env, draws=draws, **settings)
    own = combining.columns(len(results), setup.num_seeds)
    evaluations = [jax.tree.map(lambda leaf, rows=rows: leaf[rows], together) for rows in own]
    return evaluations, evaluation.random_policy(env, **settings)


def _finish(
    plan: RunPlan,
    result: "Result",
    rate: float | None,
    num_runs: int,
    evaluated: "Evaluation",
    random: "Evaluation",
) -> dict[str, Any]:
    """Writes figures and summary, prints the table, returns the summary.

    The summary is the last file to be written: its presence says that the run folder is complete.
    """
    from experiments.runs import figures  # imports matplotlib, which is slow

    setup = plan.setup
    reference = summary.make_reference(
        summary.expert_levels(setup.demonstrations), random, plan.config.prescribed_limit
    )
    metrics = read_metrics(plan.folder)
    rows = summary.per_seed_scores(evaluated, metrics["cost_rate"][-1] if "cost_rate" in metrics else None, reference)
    aggregate = summary.aggregate_scores(rows)
    content = {
        "task": setup.task,
        "method": plan.config.method,
        "num_seeds": setup.num_seeds,
        **dataclasses.asdict(reference),
        "evaluation": {
            "simulator": "ours",
            "num_episodes": setup.eval_episodes,
            "deterministic": plan.config.acts_by_mode(),
        },
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
    title = f"{plan.config.method} on {setup.task}, {setup.eval_episodes} evaluation episodes per seed"
    summary.print_table(title, rows, aggregate, reference)
    print(f"figure  {figure}\nrun     {plan.folder}")
    return content
