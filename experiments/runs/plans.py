"""What a training run is to do, decided and checked before JAX is imported; shared by all launchers that train."""

import argparse
import dataclasses
from collections.abc import Callable, Mapping
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

_EVALUATION_SEED_OFFSET = 10_000_019  # keeps evaluation episodes apart from training with the same --seed


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """Everything that was decided, and checked, before JAX is imported."""

    config: Config  # with its cost limit resolved
    preset: str
    task: str
    physics: str
    env_options: dict[str, Any]  # of `envs.make`: cost_threshold (per step), contact_cost, max_episode_steps
    demonstrations: Demonstrations | None
    demonstrations_path: Path | None
    num_seeds: int
    seed: int
    one_by_one: bool
    folder: Path
    resume: bool
    eval_episodes: int
    command: str
    moved: tuple[str, ...] = ()  # fields of `config` that are not those of the training that is resumed

    @property
    def evaluation_seed(self) -> int:
        """Seed of the evaluation episodes."""
        return (self.seed + _EVALUATION_SEED_OFFSET) % 2**32


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
