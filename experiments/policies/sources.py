"""Where policies to evaluate come from, found and checked before JAX is imported: the folder of a run, or a file."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ccil_jax.config import Config
from envs import registry
from envs.registry import TaskInfo
from experiments.cli.command_line import UsageError
from experiments.policies import evaluating, policy_file
from experiments.policies.evaluating import Loaded
from experiments.runs import run_folder
from experiments.runs.run_folder import Run


@dataclasses.dataclass(frozen=True, kw_only=True)
class Source:
    """Where policies come from, before JAX is imported: a run or a file."""

    title: str
    task: TaskInfo
    config: Config
    seeds: Sequence[int]  # of the policies, as the user calls them
    build: Callable[[], Any]  # builds the task
    load: Callable[[Any], Loaded]  # takes the policies, of the task that `build` has returned
    run: Run | None  # None for a file


def of_run(folder: Path) -> Source:
    """The policies of a run. Raises `UserError` where the folder is not that of a run, or holds no checkpoint."""
    if not folder.is_dir():
        raise UsageError(f"RUN_DIR {folder}: no such folder; give a folder that `train` wrote")
    stored = run_folder.read_run(folder)
    task = run_folder.task_of(stored)
    checkpoints = folder / "checkpoints"
    if not checkpoints.is_dir() or not any(checkpoints.iterdir()):
        raise UsageError(f"RUN_DIR {folder}: holds no checkpoint; train first, or resume with `train --resume`")
    return Source(
        title=f"{stored.config.method} on {task.name}",
        task=task,
        config=stored.config,
        seeds=range(stored.facts["num_seeds"]),
        build=lambda: evaluating.build(task, stored.facts),
        load=lambda env: evaluating.load(stored, env),
        run=stored,
    )


def of_file(named: Path) -> Source:
    """The policies of a file, or of a shipped expert by the name of its task. Raises `UserError` if it is unsound."""
    file = policy_file.read(policy_file.find(named, "--policy"))
    training = file.training
    if training["task"] not in registry.TASKS:  # a module that a file names is not imported: it would run its code
        raise UsageError(
            f"--policy {named}: of task {training['task']}, which is none of this package; give the folder of its run"
        )
    task = registry.TASKS[training["task"]]
    return Source(
        title=f"{training['method']} on {task.name}",
        task=task,
        config=file.config,
        seeds=training["seed_indices"],
        build=lambda: evaluating.build(task, training),
        load=lambda env: evaluating.load_file(file, task, env),
        run=None,
    )
