"""The folder of one training run, and its files config.json and summary.json.

A run folder has config.json, metrics.csv, summary.json, checkpoints, figures and TensorBoard events.
"""

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax import earlier_versions
from ccil_jax.config import Config, check_types, relevant
from ccil_jax.errors import ConfigError
from ccil_jax.methods import find_method
from ccil_jax.training.versions import versions
from envs import registry
from envs.registry import TASKS, TaskInfo
from experiments.cli.command_line import UsageError
from experiments.runs.provenance import git_commit

_FACTS = frozenset(
    {"task", "physics", "env_options", "preset", "seed", "num_seeds", "eval_episodes", "demonstrations"}
    | {"expert_return", "expert_cost", "expert_length"}
)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes strict JSON: numbers that are not finite become null. The file is replaced as a whole or not at all."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(json.dumps(_plain(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    temporary.replace(path)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in `path`. Raises `UsageError` if it is missing or damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror}); give a folder that `train` wrote") from None
    except ValueError:
        raise UsageError(f"{path}: not JSON; the run folder is damaged, restore or repeat the run") from None
    if not isinstance(content, dict):
        raise UsageError(f"{path}: not a JSON object; the run folder is damaged, restore or repeat the run")
    return content


@dataclasses.dataclass(frozen=True)
class Run:
    """The content of a run's config.json."""

    folder: Path
    config: Config
    facts: dict[str, Any]  # task, physics, env_options, seeds, demonstrations, ...
    gone: Mapping[str, Any]  # fields that `Config` no longer has, of an earlier version's run

    @property
    def settings(self) -> dict[str, Any]:
        """The fields that tell this run from another, by name; see `relevant`."""
        unset = {earlier_versions.GONE[name].instead for name in self.gone}
        return {name: value for name, value in relevant(self.config).items() if name not in unset} | {**self.gone}


def read_run(folder: Path) -> Run:
    """Reads config.json. Raises `UsageError` if it is missing, damaged or of another version."""
    path = folder / "config.json"
    return parse_run(path, read_json(path))


def parse_run(path: Path, facts: dict[str, Any]) -> Run:
    """The run that the content of a config.json describes.

    Runs of earlier versions are read too. What they do not say has its default, which is what these versions did.

    Args:
        path: of the file that has the content; its folder is that of the run.
        facts: the content; `config` is taken out of it.

    Raises:
        UsageError: a key is missing or unknown, or a value has a wrong type.
    """
    fields = facts.pop("config", None)
    names = {f.name for f in dataclasses.fields(Config)}
    if not isinstance(fields, dict) or not _FACTS.issubset(facts):
        raise UsageError(f"{path}: keys are missing; give a folder that this version's `train` or `expert` wrote")
    if unknown := sorted(set(fields) - names - earlier_versions.GONE.keys()):
        raise UsageError(f"{path}: field '{unknown[0]}' is not known to this version; use the version that wrote it")
    task = TASKS.get(str(facts["task"]))
    if task:  # an earlier version wrote options that make no difference to these tasks
        known = {*task.options, "max_episode_steps"}
        facts["env_options"] = {name: value for name, value in facts["env_options"].items() if name in known}
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()}
    gone = {name: values.pop(name) for name in earlier_versions.GONE if name in values}
    config = Config(**values)
    try:
        gone = earlier_versions.without_unread(gone, find_method(config.method))
    except ConfigError as error:  # one of the user's own, whose module is not found from here, is no damage
        raise UsageError(f"{path}: {error.on_command_line()}") from None
    try:
        check_types(config)
    except ConfigError as error:
        raise UsageError(f"{path}: {error}; the run folder is damaged, restore or repeat the run") from None
    return Run(path.parent, config, facts, gone)


def check_continues(run: Run, option: str) -> None:
    """Raises `UsageError`, which begins with `option`, where this version would train a run in another way.

    Such a run of an earlier version can still be evaluated and reported.
    """
    for name, value in run.gone.items():
        raise UsageError(f"{option}: {earlier_versions.refusal(name, value)}")


def task_of(run: Run) -> TaskInfo:
    """The task of a run. Raises `UsageError` where it is not known here, or its module cannot be imported."""
    try:
        return registry.find_task(run.facts["task"])
    except ValueError as error:
        task = run.facts["task"]
        raise UsageError(f"RUN_DIR {run.folder}: of task {task}, which is not known here ({error})") from None


def was_continued(run: Run, summary: Mapping[str, Any]) -> bool:
    """Whether a run has been continued for longer since `summary`, the content of summary.json, was written.

    Then its policies may be newer than the summary. config.json says how long the run is to be; the summary says how
    long it was. A run whose seeds were all given up ends earlier, and each of its seeds has left a diagnostic file.
    """
    if summary["env_steps"] >= run.config.num_iterations * run.config.steps_per_iteration:
        return False
    return not all((run.folder / f"fault_seed_{row['seed']}.npz").is_file() for row in summary["per_seed"])


def write_config(folder: Path, config: Config, facts: Mapping[str, Any]) -> None:
    """Writes config.json: `facts` (task, physics, command, seeds, ...), versions, commit, and all hyperparameters."""
    made_by = {"versions": versions(), "git_commit": git_commit()}
    content = {**facts, **made_by, "config": dataclasses.asdict(config)}
    write_json(folder / "config.json", content)
