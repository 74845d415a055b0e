"""Plans of training runs: options that were checked, before JAX is imported. All launchers that train share them."""

import argparse
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

from ccil_jax.config import Config, field_names, with_limit_of
from ccil_jax.demonstrations.trajectories import Demonstrations, check_matches, check_time_limit, load_demonstrations
from ccil_jax.methods import METHODS, find_method
from envs.registry import TaskInfo
from experiments.cli import command_line, options
from experiments.cli.command_line import Parser, UsageError
from experiments.runs import demonstration_files, wandb_log

_EVALUATION_SEED_OFFSET = 10_000_019  # so that evaluation draws other random numbers than training with the same --seed


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setup:
    """The experimental setup of a run. Runs with equal setups can be trained in one program."""

    task: str
    physics: str
    env_options: Mapping[str, Any] = dataclasses.field(hash=False)  # of `envs.make`, besides the physics
    demonstrations_path: Path | None
    num_demonstrations: int  # trajectories of that file which are used; 0 without a file
    demonstrations: Demonstrations | None = dataclasses.field(compare=False)  # follow from the two fields above
    num_seeds: int
    seed: int
    one_by_one: bool
    eval_episodes: int
    moved: tuple[str, ...] = ()  # fields of `Config` that may differ from those of the training that is resumed

    @property
    def evaluation_seed(self) -> int:
        """Seed of the evaluation episodes."""
        return (self.seed + _EVALUATION_SEED_OFFSET) % 2**32


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunPlan:
    """One run with all its seeds: its setup, its hyperparameters and where its results go."""

    setup: Setup
    config: Config  # with its cost limit resolved
    preset: str
    folder: Path
    resume: bool
    command: str
    wandb: str | None = None  # project at Weights & Biases that the metrics go to as well


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProgramPlan:
    """Runs that one compiled program trains together: they have the same setup and the same static fields."""

    runs: tuple[RunPlan, ...]
    checkpoint_dir: Path  # holds the checkpoints of all runs together; in the end each run's folder has its own
    resume: bool  # whether training goes on from the newest checkpoint there, if there is one
    finished: frozenset[Path] = frozenset()  # folders of runs that are complete: these stay as they are

    @property
    def setup(self) -> Setup:
        """The setup of all runs."""
        (setup,) = {run.setup for run in self.runs}
        return setup

    @property
    def config(self) -> Config:
        """The static fields of all runs; the traced fields, in which runs may differ, have their defaults."""
        (values,) = {static_values(run.config) for run in self.runs}
        return Config(**dict(zip(field_names(traced=False), values, strict=True)))

    @property
    def cost_limit(self) -> float | None:
        """The cost limit of all runs; None where they have none, or different ones."""
        limits = {run.config.cost_limit for run in self.runs}
        return limits.pop() if len(limits) == 1 else None

    @property
    def num_runs(self) -> int:
        """Seeds of all runs together."""
        return len(self.runs) * self.setup.num_seeds


def static_values(config: Config) -> tuple[Any, ...]:
    """The values of the static fields, which shape a program."""
    return tuple(getattr(config, name) for name in field_names(traced=False))


def add_options(parser: Parser, *, with_method: bool = True) -> None:
    """The options of a training run, except those that say where its results go."""
    absent = argparse.SUPPRESS
    if with_method:
        text = f"one of {', '.join(METHODS)}; or package.module:VARIABLE, your own"
        parser.add_argument("--method", default=absent, metavar="NAME", help=text)
    options.add_run_options(parser)
    parser.add_argument(
        "--demos",
        default=absent,
        type=demonstration_files.to_read,
        metavar="FILE",
        help=f"demonstrations: {demonstration_files.TO_READ} (default: those shipped for --env)",
    )
    parser.add_argument(
        "--num-demos", default=absent, type=command_line.positive, metavar="K", help="use the first K trajectories only"
    )
    options.add_config_options(parser, options.DEFAULTS["preset"])


class _OptionParser(Parser):
    """A parser for options that stand in a file: errors are raised, and do not end the process."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(" ".join(message.split()).removeprefix("argument "))


def parse_options(given: Sequence[str]) -> dict[str, Any]:
    """Options of `train` as they are typed, `--name=value` each, by name. Raises `UsageError` for a wrong one."""
    parser = _OptionParser("train", "")
    add_options(parser)
    return vars(parser.parse_args(given))


def plan_of(
    given: Mapping[str, Any],
    folder: Path | None,
    *,
    resume: bool,
    saved: Mapping[str, Any] = MappingProxyType({}),
    load: Callable[[Path], Demonstrations] = load_demonstrations,
) -> RunPlan:
    """Turns the options of a training run into its plan.

    Everything is checked except the folder: whether it may be written is for the caller to check.

    Args:
        given: the options that a person gave, by name. One that makes no difference to the run is refused.
        folder: of the run. None makes a new one, named after the task, the method and the time.
        resume: whether the run goes on from its last checkpoint.
        saved: the options of the run that is resumed. They hold where `given` says nothing.
        load: reads a file of demonstrations.

    Raises:
        UserError: an option is wrong, missing or without effect, or the demonstrations do not fit.
    """
    named = {**saved, **given}
    if "method" not in named:
        raise UsageError(f"--method: required; one of {', '.join(METHODS)}, or package.module:VARIABLE")
    preset = find_method(named["method"]).preset
    choices = {**options.DEFAULTS, "preset": preset, "env": None, "demos": None, "num_demos": None, **named}
    config = options.config_from(given, choices["preset"], saved)
    if choices["wandb"]:
        wandb_log.check(choices["wandb"])
    task = options.find_task(choices["env"])
    env_options = options.env_options(choices, task)
    path, demonstrations = find_demonstrations(config, task, choices["demos"], choices["num_demos"], env_options, load)
    if demonstrations is not None:
        config = with_limit_of(config, demonstrations.mean_episode_cost)
    return RunPlan(
        setup=make_setup(choices, task, env_options, path, demonstrations),
        config=config,
        preset=choices["preset"],
        folder=folder or command_line.default_folder(task.name, config.method),
        resume=resume,
        command=command_line.command(),
        wandb=choices["wandb"],
    )


def make_setup(
    choices: Mapping[str, Any],
    task: TaskInfo,
    env_options: Mapping[str, Any],
    path: Path | None = None,
    demonstrations: Demonstrations | None = None,
    moved: tuple[str, ...] = (),
) -> Setup:
    """The setup that options, `choices`, describe; `demonstrations` are those of the file `path` that are used."""
    return Setup(
        task=task.name,
        physics=choices["physics"],
        env_options=env_options,
        demonstrations_path=path,
        num_demonstrations=demonstrations.num_episodes if demonstrations else 0,
        demonstrations=demonstrations,
        num_seeds=choices["num_seeds"],
        seed=choices["seed"],
        one_by_one=choices["one_by_one"],
        eval_episodes=choices["eval_episodes"],
        moved=moved,
    )


def find_demonstrations(
    config: Config,
    task: TaskInfo,
    path: Path | None,
    count: int | None,
    env_options: Mapping[str, Any],
    load: Callable[[Path], Demonstrations] = load_demonstrations,
) -> tuple[Path | None, Demonstrations | None]:
    """Loads the demonstrations that the method needs and checks that they fit the task and its options.

    Args:
        config: of the run; its method says whether demonstrations are needed.
        task: of the run.
        path: of the file; None stands for the file that is shipped for the task.
        count: use the first trajectories only, so many; None uses all.
        env_options: of `envs.make`.
        load: reads a file.

    Returns:
        The file and the trajectories of it that are used; None and None for a method that needs none.

    Raises:
        UsageError: there is no file for the task, or an option does not go with it.
        DemonstrationsError: the file is damaged, of another task, or its episodes are longer than those of the run.
    """
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
    for name, used in env_options.items():  # with another definition of the cost, the expert's cost would be no limit
        recorded = _recorded_options(demonstrations).get(name, used)
        if recorded != used:
            option = f"--{name.replace('_', '-')} {recorded}".lower()
            remedy = f"use {option}" if name in options.TASK_OPTIONS else "use demonstrations of the task as it is now"
            raise UsageError(f"{path}: recorded with {name} {recorded}, this run has {used}; {remedy}")
    if count is not None and count > demonstrations.num_episodes:
        raise UsageError(f"--num-demos {count}: {path} holds {demonstrations.num_episodes}; give at most that many")
    if count is not None:
        demonstrations = demonstrations.take_episodes(count)
    if "max_episode_steps" in env_options:  # otherwise it is checked when the task has been built
        check_time_limit(demonstrations, path, env_options["max_episode_steps"])
    return path, demonstrations


def _recorded_options(demonstrations: Demonstrations) -> Mapping[str, Any]:
    """The options of the task that was recorded, as far as the file names them."""
    metadata = demonstrations.metadata
    if isinstance(named := metadata.get("env_options"), Mapping):
        return named
    return {name: metadata[name] for name in options.TASK_OPTIONS if name in metadata}  # written by an earlier version


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
