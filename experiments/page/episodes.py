"""The episodes that a page plays: the learner's, and beside it the expert's where that is at hand."""

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


def of_run(entry: Entry) -> str:
    """The HTML of an episode of the seed with the highest return, beside one of the expert.

    It is empty for a run without checkpoints, and for a task that cannot be drawn or is not known here.
    """
    if not (entry.run.folder / "checkpoints").is_dir() or entry.view is None:
        return ""
    loaded = evaluating.load(entry.run)
    best, caption = choose_seed(entry)
    films = [(f"{entry.label}, seed {best}", film.record(loaded, best))]
    facts = entry.run.facts["demonstrations"]
    if facts is None:
        return player.figure(films, caption)
    expert, note = _expert(loaded, facts)
    return player.figure([*films, *expert], f"{caption} {note}")


def of_policy(file: PolicyFile, index: int) -> str:
    """The HTML of an episode of a policy, beside one of the shipped expert; empty for a task that cannot be drawn."""
    task = TASKS.get(file.training["task"])
    if task is None or task.view is None:
        return ""
    loaded, label = evaluating.load_file(file, task), policy_label(file, index)
    films = [(label, film.record(loaded, index))]
    shipped = _shipped(task.name)
    if shipped is not None and file.path.resolve() != shipped.resolve():
        films.append(("the shipped expert", _of_shipped(shipped, loaded)))
    return player.figure(films, f"One episode of {label}.")


def _expert(loaded: Loaded, facts: dict[str, Any]) -> tuple[Sequence[tuple[str, Film]], str]:
    """A film of the expert under its title, if it can be made, and a sentence that says what it is or why it is not.

    `facts` says which file of demonstrations the run learnt from.
    """
    task = loaded.task
    assert task.view is not None  # or nothing is drawn of it
    demonstrations, missing = _demonstrations(facts)
    found = demonstrations and film.of_demonstration(loaded.env, task.view, demonstrations)
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
    return film.record(evaluating.on_environment(policy_file.read(path), loaded.task, loaded.env), 0)
