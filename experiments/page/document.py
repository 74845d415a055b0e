"""The HTML document of a report: curves, tables of metrics, every seed, episodes, and how the runs differ."""

import html
from collections.abc import Callable, Iterable, Sequence
from importlib import resources
from pathlib import Path

from experiments.cli.tables import BEYOND_ERROR
from experiments.page import tables
from experiments.page.entries import Entry
from experiments.page.tables import text
from experiments.policies.policy_file import PolicyFile

_PAGE = "<meta name=generator content='ccil_jax report'>"
_NOTE = (
    "Runs: interquartile mean over seeds with its 95% bootstrap interval, [-] where there are too few seeds for one. "
    "Seeds, expert and random policy: mean &plusmn; standard error over episodes. A dash: not known. Marked (*): a "
    f"violation {html.escape(BEYOND_ERROR)}. What each number means is defined in docs/metrics.md of ccil_jax."
)


def is_page(path: Path) -> bool:
    """Whether the file is a page of a report, which a newer page may replace."""
    try:
        with path.open("rb") as file:
            return _PAGE.encode() in file.read(500)
    except OSError:
        return False


def tasks_of(entries: Iterable[Entry]) -> dict[str, list[Entry]]:
    """The runs of each task."""
    found: dict[str, list[Entry]] = {}
    for e in entries:
        found.setdefault(e.task, []).append(e)
    return found


def draw_task(entries: Sequence[Entry]) -> bytes:
    """The learning curves of all runs of a task in one figure, as the bytes of a PNG file."""
    from experiments.runs import figures  # imports matplotlib

    curves = [figures.read_curve(e.run.folder, e.label) for e in entries]
    return figures.png(figures.draw_panels(curves, entries[0].task))


def page(
    entries: Sequence[Entry],
    *,
    seed: int = 0,
    play_run: Callable[[Entry], str] | None = None,
    files: Sequence[PolicyFile] = (),
    play_policy: Callable[[PolicyFile, int], str] | None = None,
) -> str:
    """The whole page.

    Args:
        entries: the runs.
        seed: of the bootstrap intervals.
        play_run: makes the HTML of an episode of a run, or of a sentence why there is none; None leaves both out.
        files: policies that are shown too.
        play_policy: the same for a policy of a file.
    """
    tasks = tasks_of(entries)
    title = f"{', '.join(tasks)}: imitation under cost constraints" if tasks else "Policies under cost constraints"
    style = resources.files("experiments.page").joinpath("style.css").read_text(encoding="utf-8")
    parts = [
        "<!DOCTYPE html><html lang=en><head><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width, initial-scale=1'>",
        _PAGE,
        f"<title>{text(title)}</title>",
        f"<style>{style}</style></head><body>",
        f"<h1>{text(title)}</h1>",
    ]
    if tasks:
        parts.append(f"<p class=note>{_NOTE}</p>")
    if len(tasks) > 1:
        parts += ["<h2>Across tasks</h2>", tables.across_tasks(entries, seed)]
    for task, runs in tasks.items():
        parts += _task_section(task, runs, seed, play_run)
    if files:
        parts += _policies_section(files, play_policy)
    if any(part.startswith("<figure class='player") for part in parts):
        from experiments.page import player  # imports MuJoCo

        parts.append(player.script())
    return "\n".join([*parts, "</body></html>\n"])


def _task_section(
    task: str, entries: Sequence[Entry], seed: int, play_run: Callable[[Entry], str] | None
) -> Iterable[str]:
    from experiments.page import plots  # imports matplotlib

    yield f"<h2>{text(task)}</h2>"
    yield tables.metrics(entries, seed)
    yield plots.of_curves(entries)
    yield from (play_run(e) for e in entries if play_run)
    yield f"<details><summary>Every seed</summary>{tables.seeds(entries)}</details>"
    yield "<details><summary>How the runs differ, and where they were made</summary>"
    yield f"{tables.differences(entries)}</details>"


def _policies_section(files: Sequence[PolicyFile], play: Callable[[PolicyFile, int], str] | None) -> Iterable[str]:
    """A table of policies, their returns against costs, and an episode of each."""
    from experiments.page import plots  # imports matplotlib

    yield "<h2>Policies</h2>"
    yield "<p class=note>Means &plusmn; standard errors over the episodes that were played when a file was written.</p>"
    yield tables.policies(files)
    by_task: dict[str, list[plots.Results]] = {}
    for file in files:
        results = plots.of_file(file, f"{file.training['method']} ({file.path.name})")
        if results:
            by_task.setdefault(file.training["task"], []).append(results)
    if by_task:
        yield plots.of_policies(by_task)
    shown = ((file, index) for file in files for index in range(file.num_policies))
    yield from (play(file, index) for file, index in shown if play)
