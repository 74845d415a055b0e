"""The episodes that a page plays: the learner's, and beside it the expert's where that is at hand.

Where there is no episode to play, a sentence says why.
"""

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ccil_jax.demonstrations.trajectories import Demonstrations, load_demonstrations
from ccil_jax.errors import UserError
from ccil_jax.training.filesystem import file_sha256
from envs.registry import TASKS
from experiments.page import film, player
from experiments.page.entries import Entry, choose_seed
from experiments.page.film import Film
from experiments.page.tables import policy_label
from experiments.policies import evaluating, policy_file
from experiments.policies.evaluating import Loaded
from experiments.policies.policy_file import PolicyFile
from experiments.runs import run_folder


def of_run(entry: Entry) -> str:
    """The HTML of an episode of the seed with the highest return, beside one of the expert.

    It is a sentence where there is nothing to play: the run has no checkpoint, or its task cannot be built or drawn.
    """
    if not (entry.run.folder / "checkpoints").is_dir():
        return _nothing(entry.label, "its folder holds no checkpoint")
    try:
        env = evaluating.build(run_folder.task_of(entry.run), entry.run.facts)
    except UserError as error:
        return _nothing(entry.label, f"its task cannot be built here ({error})")
    if reason := film.obstacle(env):
        return _nothing(entry.label, f"its task cannot be drawn, because {reason}")
    loaded = evaluating.load(entry.run, env)
    best, caption = choose_seed(entry)
    films = [(f"{entry.label}, seed {best}", film.record(loaded, best))]
    facts = entry.run.facts["demonstrations"]
    if facts is None:
        return player.figure(films, caption)
    expert, note = _expert(loaded, facts)
    return player.figure([*films, *expert], f"{caption} {note}")


def of_policy(file: PolicyFile, index: int) -> str:
    """The HTML of an episode of a policy, beside one of the shipped expert; a sentence for a task of a user's own."""
    label, task = policy_label(file, index), TASKS.get(file.training["task"])
    if task is None:  # a module that a file names is not imported: it would run its code
        name = file.training["task"]
        return _nothing(label, f"{name} is no task of this package; the page of its run's folder shows it")
    env = evaluating.build(task, file.training)
    if reason := film.obstacle(env):
        return _nothing(label, f"its task cannot be drawn, because {reason}")
    loaded = evaluating.load_file(file, task, env)
    films = [(label, film.record(loaded, index))]
    shipped = _shipped(task.name)
    if shipped is not None and file.path.resolve() != shipped.resolve():
        films.append(("the shipped expert", _of_shipped(shipped, loaded)))
    return player.figure(films, f"One episode of {label}.")


def _nothing(label: str, reason: str) -> str:
    return f"<p class=note>{html.escape(f'No episode of {label} is shown: {reason}.')}</p>"


def _expert(loaded: Loaded, facts: dict[str, Any]) -> tuple[Sequence[tuple[str, Film]], str]:
    """A film of the expert under its title, if it can be made, and a sentence that says what it is or why it is not.

    `facts` says which file of demonstrations the run learnt from.
    """
    task = loaded.task
    demonstrations, missing = _demonstrations(facts)
    found = demonstrations and film.of_demonstration(loaded.env, demonstrations)
    if found:
        note = "Beside it, the first of its demonstrations; where its root is follows from the recorded velocities."
        return [("the expert, as demonstrated", found)], note
    missing = missing or (
        f"the observations in the demonstrations of {task.name} do not say where the robot and the objects are"
    )
    if shipped := _shipped(task.name):
        note = f"Beside it, the expert's policy that is shipped for {task.name}, in the same start: {missing}."
        return [("the shipped expert", _of_shipped(shipped, loaded))], note
    return [], f"The expert is not shown: {missing}, and no policy of an expert is shipped for {task.name}."


def _demonstrations(facts: dict[str, Any]) -> tuple[Demonstrations | None, str]:
    """The demonstrations that a run learnt from; or None, and why they are not at hand."""
    path = Path(str(facts["file"]))
    try:
        if not path.is_file():
            return None, f"its demonstrations, {path.name}, are no longer where they were"
        if file_sha256(path) != facts["sha256"]:
            return None, f"its demonstrations, {path.name}, have changed since"
        return load_demonstrations(path), ""
    except (UserError, OSError):
        return None, f"its demonstrations, {path.name}, cannot be read"


def _shipped(task: str) -> Path | None:
    path = policy_file.shipped() / f"{task}.npz"
    return path if path.is_file() else None


def _of_shipped(path: Path, loaded: Loaded) -> Film:
    """An episode of a shipped expert on the environment of `loaded`, with the same start."""
    return film.record(evaluating.load_file(policy_file.read(path), loaded.task, loaded.env), 0)
