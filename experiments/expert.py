"""Trains a constrained expert on the task's own reward and records demonstrations.

The policy of one seed is recorded: among the seeds whose mean evaluation cost is at most the limit, the one with the
highest mean return. If no seed keeps the limit, nothing is recorded and the exit status is 1. With --unconstrained
there is no limit, and the seed with the highest mean return is recorded. The policy samples its actions, as it did in
training. With --export, the policy itself is written too, for `evaluate --policy` and for programs without JAX.
Hyperparameters start from the preset that the task names: `safety_gym_expert` for Safety Gym tasks, `expert` for all
others.
"""

import argparse
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ccil_jax.demonstrations.trajectories import save_demonstrations
from envs.registry import TaskInfo
from experiments.cli import command_line, options
from experiments.cli.command_line import Parser, UsageError
from experiments.policies import evaluating
from experiments.policies.evaluating import Loaded, Settings
from experiments.runs import recording, run_folder, wandb_log
from experiments.runs.execution import execute
from experiments.runs.plans import RunPlan, Setup, make_setup
from experiments.runs.recording import choose_seed
from experiments.runs.resuming import resumed

DEFAULTS = {**options.DEFAULTS, "preset": "expert"}
# Fields that may change with --resume: an expert that misses its limit can be trained on with another limit, with a
# multiplier that reacts more strongly, with smaller steps, where its cost scatters from one policy to the next, or with
# another horizon of the cost.
MOVABLE = (
    "cost_limit",
    "cost_gamma",
    "max_kl",
    "multiplier_learning_rate",
    "multiplier_max",
    "pid_proportional_gain",
    "pid_integral_gain",
    "pid_derivative_gain",
    "pid_smoothing",
)


def make_parser() -> Parser:
    """The options of this launcher, `Config` fields included."""
    parser = Parser("expert", __doc__ or "")
    options.add_run_options(parser, DEFAULTS)
    parser.add_argument("--out", required=True, type=Path, metavar="FILE.npz", help="demonstrations file to write")
    parser.add_argument(
        "--export", type=Path, metavar="FILE.npz", help="also write the policy that is recorded, as NumPy arrays"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing files of --out and --export")
    parser.add_argument(
        "--unconstrained", action="store_true", help="plain TRPO, which ignores the cost (no --cost-limit)"
    )
    parser.add_argument(
        "--num-trajectories",
        default=10,
        type=command_line.positive,
        metavar="N",
        help="episodes to record (default: 10)",
    )
    parser.add_argument(
        "--run-dir", type=Path, metavar="DIR", help="run folder of the training (default: runs/<task>_<method>_<time>)"
    )
    parser.add_argument("--resume", action="store_true", help="continue the run in --run-dir from its last checkpoint")
    options.add_config_options(parser, DEFAULTS["preset"], methods=("expert", "trpo"))
    return parser


def make_plan(arguments: argparse.Namespace) -> RunPlan:
    """Turns the options into the plan of a run. Raises a `UserError` for wrong input."""
    own = ("out", "export", "overwrite", "unconstrained", "num_trajectories", "run_dir", "resume")
    given = {k: v for k, v in vars(arguments).items() if k not in own}
    given["method"] = method = "trpo" if arguments.unconstrained else "expert"
    if arguments.unconstrained and given.get("cost_limit") is not None:
        raise UsageError("--cost-limit: --unconstrained has no limit; give one or the other")
    written = {"--out": arguments.out, **({"--export": arguments.export} if arguments.export else {})}
    for option, file in written.items():
        if file.suffix != ".npz":
            raise UsageError(f"{option} {file}: the file is named *.npz")
        command_line.check_new_file(file, option, overwrite=arguments.overwrite)
    if len({file.resolve() for file in written.values()}) < len(written):
        raise UsageError(f"--export {arguments.export}: is the file of --out; give each a name of its own")
    saved = _resumed(arguments.run_dir, given) if arguments.resume else {}
    choices = {**DEFAULTS, "env": None, **saved, **given}
    task = options.find_task(choices["env"])
    limit = {} if arguments.unconstrained or "cost_limit" in choices else {"cost_limit": _limit_of(task)}
    preset = {**saved, **given}.get("preset", task.expert_preset)
    config = options.config_from({**given, **limit}, preset, saved)
    env_options = options.env_options(choices, task)
    if choices["wandb"]:
        wandb_log.check(choices["wandb"])
    for option, file in written.items():
        command_line.check_writable(file.parent, option)
    folder = arguments.run_dir or command_line.default_folder(task.name, method, "--run-dir")
    command_line.check_output_folder(folder, resume=arguments.resume, option="--run-dir")
    return RunPlan(
        setup=make_setup(choices, task, env_options, moved=MOVABLE if arguments.resume else ()),
        config=config,
        preset=preset,
        folder=folder,
        resume=arguments.resume,
        command=command_line.command(),
        wandb=choices["wandb"],
    )


def _limit_of(task: TaskInfo) -> float:
    """The cost limit of a task's experts, where none is given. Raises `UsageError` for a task without a default."""
    if task.cost_limit is None:
        raise UsageError(
            f"--cost-limit: required, as {task.name} has no default; give the mean cost that an episode may have, or "
            "add --unconstrained"
        )
    return task.cost_limit


def _resumed(folder: Path | None, given: Mapping[str, Any]) -> dict[str, Any]:
    """The options of the run in `folder`. Raises `UsageError` where `given` differs in one that may not change."""
    saved = resumed(folder, {k: v for k, v in given.items() if k != "method"}, "--run-dir", MOVABLE)
    if saved["method"] != given["method"]:
        with_limit = "leave --unconstrained out" if given["method"] == "trpo" else "add --unconstrained"
        raise UsageError(f"--resume: the run in {folder} is of method {saved['method']}; {with_limit} to resume it")
    ended = folder is not None and (folder / "summary.json").is_file()
    if ended and given.get("env_steps", saved.get("env_steps")) == saved.get("env_steps"):
        for name in MOVABLE:
            if name != "cost_limit" and given.get(name, saved.get(name)) != saved.get(name):
                option = f"--{name.replace('_', '-')} {given[name]}"
                raise UsageError(
                    f"{option}: the run in {folder} has ended, so nothing would be trained; add --env-steps"
                )
    return saved


def run(arguments: argparse.Namespace) -> int:
    """Trains, chooses a seed and records it. Returns the exit status, 1 if no seed keeps the limit."""
    plan = make_plan(arguments)
    outcome = execute(plan)
    seed = choose_seed(outcome.summary["per_seed"], plan.config.prescribed_limit)
    if seed is None:
        lowest = min(outcome.summary["per_seed"], key=lambda row: row["episode_cost"])
        remedy = [str(plan.folder), "--record", str(arguments.out), "--seed-index", str(lowest["seed"])]
        remedy += ["--num-trajectories", str(arguments.num_trajectories)]
        faster = ""
        if plan.config.reads("multiplier_learning_rate"):
            rate = plan.config.multiplier_learning_rate
            faster = f", --multiplier-learning-rate above the present {rate:g} where the cost stays above the limit"
        print(
            f"no seed keeps --cost-limit {plan.config.cost_limit:g} (lowest cost {lowest['episode_cost']:g}): nothing "
            f"was recorded; train longer (--resume --run-dir {shlex.quote(str(plan.folder))} --env-steps N{faster}, "
            "--cost-limit for a higher limit), use more seeds in a new run, or record that policy all the same: "
            f"{command_line.launcher_command('evaluate')} {shlex.join(remedy)}",
            file=sys.stderr,
        )
        return 1
    trained, result = run_folder.read_run(plan.folder), outcome.result
    loaded = evaluating.of_run(trained, outcome.env, result.config, result.actor, result.env_steps)
    demonstrations = recording.record(
        loaded.config,
        loaded.actor,
        loaded.env,
        num_trajectories=arguments.num_trajectories,
        episode_seed=(plan.setup.evaluation_seed + 1) % 2**32,
        seed_index=seed,
        facts=recording.facts(
            recording.training(trained, result.env_steps),
            outcome.summary,
            seed,
            plan.setup.eval_episodes,
            loaded.command,
        ),
    )
    save_demonstrations(arguments.out, demonstrations)
    recording.print_demonstrations(demonstrations, arguments.out)
    if arguments.export:
        _export(arguments.export, loaded.only(seed), evaluating.only(outcome.evaluation, seed), plan.setup)
    return 0


def _export(file: Path, loaded: Loaded, episodes: Any, setup: Setup) -> None:
    from experiments.policies import exporting  # imports JAX

    settings = Settings(
        simulator="ours",
        num_episodes=setup.eval_episodes,
        seed=setup.evaluation_seed,
        deterministic=loaded.config.acts_by_mode(),
        shared_episodes=False,
    )
    facts = {**evaluating.facts_of(loaded, settings), "command": loaded.command}
    exporting.export_numpy(file, loaded.config, loaded.actor, loaded.env, episodes, facts)
    print(f"policy  {file}")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
