"""Options that the training launchers share: the fields of `Config`, and the choices besides hyperparameters."""

import argparse
import dataclasses
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from ccil_jax.config import CHOICES, Config, validate
from ccil_jax.errors import ConfigError
from ccil_jax.methods import METHODS
from ccil_jax.presets import PRESETS
from ccil_jax.uses import Use
from envs import registry
from envs.registry import PHYSICS, TASKS, TaskInfo
from envs.task_info import physics_name
from experiments.cli.command_line import Parser, UsageError, boolean, integer, natural, positive

CONFIG_FIELDS = tuple(f.name for f in dataclasses.fields(Config))
TASK_OPTIONS = ("cost_threshold", "contact_cost", "max_episode_steps")  # of some tasks; None: the task's default
DEFAULTS: Mapping[str, Any] = {
    "num_seeds": 3,
    "seed": 0,
    "one_by_one": False,
    "physics": "auto",
    **dict.fromkeys(TASK_OPTIONS),
    "preset": "default",
    "eval_episodes": 50,
    "wandb": None,
}


def add_run_options(parser: Parser, defaults: Mapping[str, Any] = DEFAULTS) -> None:
    """Adds --env and the options in `DEFAULTS`. An option that is not given is absent from the parsed arguments."""

    def add(name: str, text: str, **settings: Any) -> None:
        default = defaults.get(name)
        suffix = "" if default is None else f" (default: {str(default).lower()})"
        parser.add_argument("--" + name.replace("_", "-"), default=argparse.SUPPRESS, help=text + suffix, **settings)

    add("env", f"task: {', '.join(TASKS)}; or package.module:function, which builds your own", metavar="TASK")
    add("num_seeds", "seeds trained side by side in one program", type=positive, metavar="S")
    add(
        "seed",
        "base seed: the same seed, number of seeds and versions give the same results, bit for bit",
        type=natural,
        metavar="N",
    )
    add(
        "one_by_one",
        "train the seeds of a device one after the other: then the results of a seed are the same, bit for bit, for "
        "any number of seeds and cores (slow on a GPU, which a single seed does not fill)",
        type=boolean,
        metavar="BOOL",
    )
    add("preset", "hyperparameters to start from", choices=tuple(PRESETS))
    add("physics", "engine; auto: native on CPUs, warp on NVIDIA GPUs if installed, else mjx", choices=PHYSICS)
    add("cost_threshold", "per-step threshold of the 0/1 cost (default: the task's)", type=float, metavar="X")
    add(
        "contact_cost",
        "whether contacts count in the cost (Ant, Humanoid; default: true)",
        type=boolean,
        metavar="BOOL",
    )
    add("max_episode_steps", "time limit of an episode (default: the task's, mostly 1000)", type=positive, metavar="T")
    add("eval_episodes", "evaluation episodes per seed after training", type=positive, metavar="N")
    add(
        "wandb",
        "also log the metrics in this project of Weights & Biases (with WANDB_MODE=offline they are kept "
        "in the run folder, to be sent later)",
        metavar="PROJECT",
    )


def add_config_options(parser: Parser, preset: str, *, methods: Sequence[str] = tuple(METHODS)) -> None:
    """Adds an option for each field of `Config` except the method, grouped by the methods that use the fields.

    `--help` shows the values of the preset as defaults, and leaves out fields that none of `methods` uses. Such an
    option is accepted here, so that the check of the configuration can say why it has no effect. An option that is not
    given is absent from the parsed arguments.
    """
    parser.epilog = (
        "static: the value shapes the compiled program, so that another value needs another compilation; "
        "all other values are numbers inside the program"
    )
    groups: dict[Use, Any] = {}
    defaults = Config(**PRESETS[preset])
    for field in dataclasses.fields(Config):
        if field.name == "method":
            continue
        use: Use = field.metadata["use"]
        if use not in groups:
            groups[use] = parser.add_argument_group(f"hyperparameters of {use.who}")
        choices = f"; one of {', '.join(CHOICES[field.name])}" if field.name in CHOICES else ""
        value = getattr(defaults, field.name)
        default = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
        static = "" if field.metadata["traced"] else "; static"
        text = f"{field.metadata['help']}{choices} (default: {default.lower()}{static})".replace("%", "%%")
        groups[use].add_argument(
            "--" + field.name.replace("_", "-"),
            dest=field.name,
            type=_parser_of(field.type),
            default=argparse.SUPPRESS,
            metavar="X",
            help=text if not set(use.methods).isdisjoint(methods) else argparse.SUPPRESS,
        )


def config_from(given: Mapping[str, Any], preset: str, saved: Mapping[str, Any] = MappingProxyType({})) -> Config:
    """The configuration of a run, checked.

    Args:
        given: the options that a person gave; they come before all else.
        preset: the hyperparameters to start from.
        saved: the options of a run that is resumed; they come before the preset.

    Raises:
        ConfigError: a value is wrong, or a given option makes no difference to the run.
    """
    if preset not in PRESETS:  # a task or method of the user's own names one, too
        raise ConfigError(f"--preset {preset!r}: unknown; choose one of {', '.join(PRESETS)}")
    base, changes = ({k: v for k, v in fields.items() if k in CONFIG_FIELDS} for fields in (saved, given))
    config = Config.from_base({**PRESETS[preset], **base}, changes)
    validate(config)
    return config


def find_task(name: str | None, option: str = "--env") -> TaskInfo:
    """The description of a task. Raises `UsageError`, which suggests the nearest name, for an unknown one."""
    if name is None:
        raise UsageError(f"{option}: required; one of {', '.join(TASKS)}, or package.module:function")
    try:
        return registry.find_task(name)
    except ValueError as error:
        raise UsageError(f"{option} {error}") from None


def env_options(choices: Mapping[str, Any], task: TaskInfo) -> dict[str, Any]:
    """What `envs.make` gets besides the task and the physics.

    Defaults are written out, so that they stay the same for a run even if those of the task change. Only a default that
    JSON cannot hold, which a user's task may have, is left to the task. A run that is resumed has its options in
    `choices` as "env_options"; these come before the task's defaults.

    Raises:
        UsageError: the task has no such option, or the option cannot have that value.
    """
    threshold = choices["cost_threshold"]
    if threshold is not None and not 0 <= threshold < float("inf"):
        raise UsageError(f"--cost-threshold {threshold}: must be finite and not negative")
    if choices["physics"] != DEFAULTS["physics"] and not has_option(task, "physics"):
        raise UsageError(f"--physics {choices['physics']}: {task.name} has no such option; leave it out")
    given = {name: choices[name] for name in TASK_OPTIONS if choices[name] is not None}
    for name in given:
        if not has_option(task, name):
            raise UsageError(f"--{name.replace('_', '-')}: {task.name} has no such option; leave it out")
    defaults = {name: value for name, value in task.options.items() if isinstance(value, bool | int | float | str)}
    if has_option(task, "max_episode_steps") and task.max_episode_steps is not None:
        defaults["max_episode_steps"] = task.max_episode_steps
    saved = choices.get("env_options", {})
    if strange := [name for name in saved if not has_option(task, name)]:
        raise UsageError(f"--resume: the run has option {strange[0]!r}, which {task.name} no longer has; restore it")
    return {**defaults, **saved, **given}


def has_option(task: TaskInfo, name: str) -> bool:
    """Whether `envs.make` takes the option `name` for a task."""
    return name in task.options or name in task.common


def engine_of(task: str, env: Any) -> str:
    """The engine that an environment of the task runs on, as --physics names it; "auto" where there is no choice."""
    has_choice = has_option(registry.find_task(task), "physics")
    return physics_name(env) if has_choice else str(DEFAULTS["physics"])


def _parser_of(annotation: Any) -> Callable[[str], Any]:
    if typing.get_origin(annotation) is tuple:
        return _sizes
    if isinstance(annotation, types.UnionType):
        return _number
    parsers: dict[type, Callable[[str], Any]] = {int: integer, bool: boolean, float: float, str: str}
    return parsers[annotation]


def _sizes(text: str) -> tuple[int, ...]:
    try:
        return tuple(integer(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: give sizes such as 100,100") from None


def _number(text: str) -> float | None:
    try:
        return None if text.lower() == "none" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: give a number or none") from None
