"""The options of an earlier run: for `--resume`, which checks that those given agree with them, and to do it again."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from ccil_jax.config import relevant
from ccil_jax.training.filesystem import content_sha256
from experiments.cli import options
from experiments.cli.command_line import UsageError
from experiments.runs import run_folder
from experiments.runs.run_folder import Run


def resumed(
    folder: Path | None, given: Mapping[str, Any], option: str = "--out", movable: Collection[str] = ()
) -> dict[str, Any]:
    """The options of the run in `folder`, by name; `demos` is a path.

    Args:
        folder: of the run.
        given: the options that a person gave. `env_steps` may be larger than before, which trains the run for longer.
        option: names the folder in error messages.
        movable: fields of `Config` that may differ, too.

    Raises:
        UsageError: there is no run, or an option in `given` differs from that of the run.
    """
    if folder is None:
        raise UsageError(f"--resume: needs {option} with the folder of the run to continue")
    if not (folder / "config.json").is_file():
        raise UsageError(f"--resume: {folder} holds no run (no config.json); leave --resume out or correct {option}")
    run = run_folder.read_run(folder)
    run_folder.check_continues(run, f"--resume: {folder}")
    demos, saved = run.facts["demonstrations"], options_of(run)
    for name, value in given.items():
        if name in ("demos", *movable) or name not in saved:  # an option without effect is refused later
            continue
        longer = name == "env_steps" and value > saved[name]
        if value != saved[name] and not longer:
            raise UsageError(
                f"--{name.replace('_', '-')} {value}: the run in {folder} has {saved[name]}; leave it out to resume"
            )
    # The file may have been moved. It is the same file if its digest is the same.
    path: Path | None = given.get("demos", saved["demos"])
    if path and path.exists() and demos and content_sha256(path) != demos["sha256"]:
        raise UsageError(f"--demos {path}: not the file that the run in {folder} began with; give that file")
    return {**saved, "demos": path}


def options_of(run: Run) -> dict[str, Any]:
    """The options with which a run was started, by name; `demos` is a path."""
    demos = run.facts["demonstrations"]
    return {
        **relevant(run.config),
        **{name: run.facts[name] for name in ("num_seeds", "seed", "preset", "physics", "eval_episodes")},
        "one_by_one": run.facts.get("one_by_one", False),  # older runs do not say
        **{name: run.facts["env_options"].get(name) for name in options.TASK_OPTIONS},
        "env_options": run.facts["env_options"],  # apart, as a user's task may name an option like one of the run
        "env": run.facts["task"],
        "demos": Path(demos["file"]) if demos else None,
        "num_demos": demos["num_episodes"] if demos else None,
    }


def repeated(path: Path, content: dict[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The options of the run whose config.json is `path`, for another run with the same ones.

    Args:
        path: of the file.
        content: of the file.
        given: the options that a person gave, which come before those of the run.

    Raises:
        UsageError: the file is damaged, or its demonstrations are no longer what they were.
    """
    run = run_folder.parse_run(path, content)
    run_folder.check_continues(run, f"--config {path}")
    demos, saved = run.facts["demonstrations"], options_of(run)
    if demos and "demos" not in given:
        file: Path = saved["demos"]
        if content_sha256(file) != demos["sha256"]:
            raise UsageError(
                f"--config {path}: {file} is no longer the file that this run learnt from; give it by --demos"
            )
    return saved
