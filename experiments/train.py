"""Trains one method on one task, all seeds in one program, and writes a run folder with figures and a table."""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ccil_jax.config import Config, with_limit_of
from ccil_jax.demonstrations.trajectories import Demonstrations, check_matches, check_time_limit, load_demonstrations
from ccil_jax.methods import METHODS
from envs.registry import TaskInfo
from experiments.cli import command_line, options
from experiments.cli.command_line import Parser, UsageError
from experiments.runs.execution import Plan, execute
from experiments.runs.resuming import resumed


def make_parser() -> Parser:
    """Options that are not given stay absent, so that --resume can tell them from their defaults."""
    parser = Parser("train", __doc__ or "")
    add_options(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="run folder (default: runs/<task>_<method>_<time>)")
    parser.add_argument("--resume", action="store_true", help="continue the run in --out from its last checkpoint")
    return parser


def add_options(parser: Parser, *, with_method: bool = True) -> None:
    """What a run is: all but where it goes."""
    absent = argparse.SUPPRESS
    if with_method:
        parser.add_argument("--method", default=absent, metavar="NAME", help=f"one of {', '.join(METHODS)}")
    options.add_run_options(parser)
    parser.add_argument(
        "--demos", default=absent, type=Path, metavar="FILE", help="demonstrations (default: those shipped for --env)"
    )
    parser.add_argument(
        "--num-demos", default=absent, type=command_line.positive, metavar="K", help="use the first K trajectories only"
    )
    options.add_config_options(parser, options.DEFAULTS["preset"])


def make_plan(arguments: argparse.Namespace) -> Plan:
    """Turns the options into a `Plan`. Raises `UsageError`, `ConfigError` or `DemonstrationsError` for wrong input."""
    given = {k: v for k, v in vars(arguments).items() if k not in ("out", "resume")}
    saved = resumed(arguments.out, given) if arguments.resume else {}
    plan = plan_of(given, arguments.out, resume=arguments.resume, saved=saved)
    command_line.check_output_folder(plan.folder, resume=plan.resume)
    return plan


def plan_of(
    given: Mapping[str, Any],
    folder: Path | None,
    *,
    resume: bool,
    saved: Mapping[str, Any] = MappingProxyType({}),
    load: Callable[[Path], Demonstrations] = load_demonstrations,
) -> Plan:
    """The `Plan` of the options given, checked, but for its folder (a new one where it is None).

    Args:
        given: the options that a person gave. One that makes no difference to the run is refused.
        folder: of the run.
        resume: whether the run goes on from its last checkpoint.
        saved: the choices of the run that is resumed, for what is not given.
        load: reads a file of demonstrations.
    """
    named = {**saved, **given}
    if "method" not in named:
        raise UsageError(f"--method: required; one of {', '.join(METHODS)}")
    preset = options.METHOD_PRESETS.get(named["method"], options.DEFAULTS["preset"])
    choices = {**options.DEFAULTS, "preset": preset, "env": None, "demos": None, "num_demos": None, **named}
    config = options.config_from(given, choices["preset"], saved)
    task = options.find_task(choices["env"])
    env_options = options.env_options(choices, task)
    path, demonstrations = find_demonstrations(config, task, choices["demos"], choices["num_demos"], env_options, load)
    if demonstrations is not None:
        config = with_limit_of(config, demonstrations.mean_episode_cost)
    return Plan(
        config=config,
        preset=choices["preset"],
        task=task.name,
        physics=choices["physics"],
        env_options=env_options,
        demonstrations=demonstrations,
        demonstrations_path=path,
        num_seeds=choices["num_seeds"],
        seed=choices["seed"],
        one_by_one=choices["one_by_one"],
        folder=folder or command_line.default_folder(task.name, config.method),
        resume=resume,
        eval_episodes=choices["eval_episodes"],
        command=command_line.command(),
    )


def find_demonstrations(
    config: Config,
    task: TaskInfo,
    path: Path | None,
    count: int | None,
    env_options: Mapping[str, Any],
    load: Callable[[Path], Demonstrations] = load_demonstrations,
) -> tuple[Path | None, Demonstrations | None]:
    """Loads and checks the demonstrations that the method needs; the shipped file where `path` is None."""
    if path is None:
        if not config.row.imitates:
            if count is not None:
                raise UsageError(
                    f"--num-demos {count}: method {config.method} learns from no demonstrations; leave it out"
                )
            return None, None
        path = _shipped(task.name)
    demonstrations = load(path)
    check_matches(demonstrations, path, task)
    for name, used in env_options.items():  # the expert's cost means nothing under another definition of cost
        recorded = demonstrations.metadata.get(name, used)
        if recorded != used:
            option = f"--{name.replace('_', '-')} {recorded}".lower()
            raise UsageError(f"{path}: recorded with {name} {recorded}, this run has {used}; use {option}")
    if count is not None and count > demonstrations.num_episodes:
        raise UsageError(f"--num-demos {count}: {path} holds {demonstrations.num_episodes}; give at most that many")
    if count is not None:
        demonstrations = demonstrations.take_episodes(count)
    check_time_limit(demonstrations, path, env_options["max_episode_steps"])
    return path, demonstrations


def _shipped(task: str) -> Path:
    folder = Path(str(resources.files("experiments"))) / "demonstrations"
    path = folder / f"{task}.npz"
    if not path.is_file():
        names = ", ".join(sorted(p.stem for p in folder.glob("*.npz"))) or "none"
        raise UsageError(
            f"--demos: no demonstrations are shipped for {task} (shipped: {names}); "
            f"record some with `{command_line.launcher_command('expert')} --env {task}` and give the file"
        )
    return path


def run(arguments: argparse.Namespace) -> int:
    """Checks everything, then trains; status 1 where a seed had to be given up."""
    return execute(make_plan(arguments)).status


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
