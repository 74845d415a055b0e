"""The runs that a page shows, each with a label that tells it from the others."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.command_line import UsageError
from experiments.runs import run_folder
from experiments.runs.labels import distinct_names
from experiments.runs.run_folder import Run

_NEEDED = {"num_seeds", "per_seed", "env_steps", "env_steps_per_second", "expert_cost"}  # keys of summary.json


@dataclasses.dataclass(frozen=True)
class Entry:
    """One finished run."""

    run: Run
    summary: dict[str, Any]
    label: str  # differs from those of all other runs of the task
    number: int  # differs from those of all other runs on the page

    @property
    def task(self) -> str:
        """Name of the task."""
        return str(self.run.facts["task"])


def read_entries(folders: Sequence[Path]) -> list[Entry]:
    """Reads the runs. Raises `UsageError` for a folder that is not a finished run, or is given twice."""
    entries: list[Entry] = []
    for folder in folders:
        if folder.resolve() in [e.run.folder.resolve() for e in entries]:
            raise UsageError(f"RUN_DIR {folder}: the same folder twice; give each run once")
        if not folder.is_dir():
            raise UsageError(f"RUN_DIR {folder}: no such folder; give a folder that `train` wrote")
        run = run_folder.read_run(folder)
        if not (folder / "summary.json").is_file():
            raise UsageError(f"RUN_DIR {folder}: not finished (no summary.json); finish it with `train --resume`")
        entries.append(Entry(run, _read_summary(run), run.config.method, len(entries)))
    alike = ([other for other in entries if (other.task, other.label) == (e.task, e.label)] for e in entries)
    return [_distinct(e, others) for e, others in zip(entries, alike, strict=True)]


def _read_summary(run: Run) -> dict[str, Any]:
    path = run.folder / "summary.json"
    summary = run_folder.read_json(path)
    if missing := sorted(_NEEDED - summary.keys()):
        raise UsageError(f"{path}: '{missing[0]}' is missing; the run folder is damaged, restore or repeat the run")
    if run_folder.was_continued(run, summary):
        raise UsageError(f"RUN_DIR {run.folder}: continued and not finished; finish it with `train --resume`")
    return summary


def _distinct(entry: Entry, alike: Sequence[Entry]) -> Entry:
    """The entry with its folder's name in its label, where several entries, `alike`, would have the same label."""
    if len(alike) == 1:
        return entry
    names = distinct_names([e.run.folder for e in alike])
    return dataclasses.replace(entry, label=f"{entry.label} ({names[alike.index(entry)]})")


def choose_seed(entry: Entry) -> tuple[int, str]:
    """The seed whose episode is shown, and a caption that says why."""
    rows = entry.summary["per_seed"]
    best = max(rows, key=lambda row: -np.inf if row["episode_return"] is None else row["episode_return"])["seed"]
    why = f", which has the highest mean return of {len(rows)} seeds" if len(rows) > 1 else ""
    return best, f"One episode of {entry.label}, seed {best}{why}."
