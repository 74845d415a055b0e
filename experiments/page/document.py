"""The HTML document of a report: curves, tables of metrics, every seed, and how the runs differ."""

import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.demonstrations.trajectories import standard_error
from ccil_jax.earlier_versions import GONE
from envs.registry import TASKS
from experiments.cli.options import CONFIG_FIELDS
from experiments.cli.tables import BEYOND_ERROR, bounds, marked, number
from experiments.page.entries import Entry, choose_seed
from experiments.policies import evaluating
from experiments.policies.numpy_policy import is_known
from experiments.policies.policy_file import PolicyFile
from experiments.runs.intervals import bootstrap_interval

_COLUMNS = (
    ("episode_return", "return"),
    ("episode_cost", "cost"),
    ("recovered_return", "recovered return, %"),
    ("relative_cost_violation", "relative cost violation"),
    ("penalized_return", "penalised return, %"),
    ("cost_rate", "cost rate in training"),
)
_PAGE = "<meta name=generator content='ccil_jax report'>"
_NOTE = (
    "Runs: interquartile mean over seeds with its 95% bootstrap interval, [-] where there are too few seeds for one. "
    "Seeds, expert and random policy: mean &plusmn; standard error over episodes. A dash: not known. Marked (*): a "
    f"violation {html.escape(BEYOND_ERROR)}. What each number means is defined in docs/metrics.md of ccil_jax."
)
_STYLE = """
:root { color-scheme: light; --ink: #22262b; --soft: #5b626c; --line: #e3e6ea; --accent: #0b6e99; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); max-width: 1080px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; margin-bottom: .2rem; }
h2 { font-size: 1.3rem; margin-top: 2.6rem; border-bottom: 2px solid var(--accent); padding-bottom: .2rem; }
h3 { font-size: 1rem; margin: 1.6rem 0 .4rem; }
p.note, figcaption { color: var(--soft); font-size: .9rem; max-width: 48rem; }
figure { margin: 1rem 0; } img, canvas { max-width: 100%; }
div.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } thead th { color: var(--soft); font-weight: 600; }
td .beyond { color: #a0281f; font-weight: 600; cursor: help; }
td small { color: var(--soft); } details { margin: .6rem 0; } summary { cursor: pointer; color: var(--accent); }
code { font-size: .86rem; background: #f4f6f8; padding: .05rem .3rem; white-space: pre-wrap; }
"""


def is_page(path: Path) -> bool:
    """Whether the file is a page of a report, which a newer page may replace."""
    try:
        with path.open("rb") as file:
            return _PAGE.encode() in file.read(500)
    except OSError:
        return False


def draw_tasks(entries: Sequence[Entry]) -> dict[str, bytes]:
    """The learning curves of all runs of a task in one figure: the bytes of a PNG file for each task."""
    from experiments.runs import figures  # imports matplotlib

    curves: dict[str, list[figures.Curve]] = {}
    for e in entries:
        curves.setdefault(e.task, []).append(figures.read_curve(e.run.folder, e.label))
    return {task: figures.png(figures.draw_panels(drawn, task)) for task, drawn in curves.items()}


def page(
    entries: Sequence[Entry],
    images: Mapping[str, bytes],
    *,
    seed: int = 0,
    player: Callable[[Entry], str] | None = None,
    policies: str = "",
) -> str:
    """The whole page.

    Args:
        entries: the runs.
        images: a PNG file of learning curves for each task.
        seed: of the bootstrap intervals.
        player: makes the HTML of an episode of a run, or an empty text; None leaves episodes out.
        policies: the section about policies of files, see `policies_section`.
    """
    tasks = list(images)
    title = f"{', '.join(tasks)}: imitation under cost constraints" if tasks else "Policies under cost constraints"
    parts = [
        "<!DOCTYPE html><html lang=en><head><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width, initial-scale=1'>",
        _PAGE,
        f"<title>{_text(title)}</title>",
        f"<style>{_STYLE}</style></head><body>",
        f"<h1>{_text(title)}</h1>",
    ]
    if tasks:
        parts.append(f"<p class=note>{_NOTE}</p>")
    if len(tasks) > 1:
        parts.append(_across_tasks(entries, seed))
    for task in tasks:
        parts += _task_section(task, [e for e in entries if e.task == task], images[task], seed, player)
    return "\n".join([*parts, policies, "</body></html>\n"])


def _task_section(
    task: str, entries: Sequence[Entry], image: bytes, seed: int, player: Callable[[Entry], str] | None
) -> Iterable[str]:
    from experiments.runs import figures  # imports matplotlib

    yield f"<h2>{_text(task)}</h2>"
    several = any(len(e.summary["per_seed"]) > 1 for e in entries)
    seeds = "Thick: mean over seeds. Band: standard deviation. Thin: every seed. " if several else ""
    yield (
        f"<figure>{figures.html_image(image, f'Learning curves on {task}')}<figcaption>{seeds}"
        "Dashed: mean of the demonstrations, with its standard error where that is known.</figcaption></figure>"
    )
    yield _metrics_table(entries, seed)
    yield from (text for e in entries if player and (text := player(e)))
    yield "<details><summary>Every seed</summary>" + _seeds_table(entries) + "</details>"
    yield "<details><summary>How the runs differ, and where they were made</summary>" + _differences(entries)
    yield "</details>"


def _metrics_table(entries: Sequence[Entry], seed: int) -> str:
    rows = []
    for e in entries:
        cells = [_text(e.label), _text(str(e.summary["num_seeds"]))]
        for name, _ in _COLUMNS:
            values = [row.get(name) for row in e.summary["per_seed"]]
            text = "-" if None in values else _interval([np.array(values)], seed)
            cells.append(_marked(text, name, e.summary.get("violation_beyond_error")))
        cells += [f"{e.summary['env_steps']:,}", _rate(e.summary["env_steps_per_second"])]
        rows.append(cells)
    width = 2 + len(_COLUMNS) + 2
    rows += [[*cells, *[""] * (width - len(cells))] for cells in _reference_rows(entries)]
    return _table(["", "seeds", *(title for _, title in _COLUMNS), "steps per seed", "steps/s"], rows)


def _reference_rows(entries: Sequence[Entry]) -> Iterable[list[str]]:
    """Rows for the expert, the random policy and the cost limit: a label, no number of seeds, return and cost.

    Runs that have different levels have rows of their own.
    """
    for name, title in (("expert", "expert"), ("random", "random policy"), ("cost_limit", "cost limit")):
        runs: dict[tuple[str, str], list[str]] = {}
        for e in entries:
            if name == "cost_limit":
                cells = "", number(e.summary.get(name))
            else:
                cells = _with_error(e.summary, f"{name}_return"), _with_error(e.summary, f"{name}_cost")
            runs.setdefault(cells, []).append(e.label)
        for cells, labels in runs.items():
            if set(cells) - {"", "-"}:
                yield [title if len(runs) == 1 else _text(f"{title} of {', '.join(labels)}"), "", *cells]


def _across_tasks(entries: Sequence[Entry], seed: int) -> str:
    """A table of the methods over all tasks; for the intervals, seeds are resampled within each task."""
    rows = []
    for method in dict.fromkeys(e.run.config.method for e in entries):
        chosen = [e for e in entries if e.run.config.method == method]
        cells = [_text(method), str(len({e.task for e in chosen}))]
        for name in ("recovered_return", "relative_cost_violation", "penalized_return"):
            strata = [np.array([row.get(name) for row in e.summary["per_seed"]], np.float64) for e in chosen]
            cells.append(_interval(strata, seed) if all(np.isfinite(s).all() for s in strata) else "-")
        rows.append(cells)
    titles = ["", "tasks", "recovered return, %", "relative cost violation", "penalised return, %"]
    return "<h2>Across tasks</h2>" + _table(titles, rows)


def _seeds_table(entries: Sequence[Entry]) -> str:
    rows = [
        [_text(f"{e.label}, seed {row['seed']}"), *(_seed_cell(row, name) for name, _ in _COLUMNS)]
        for e in entries
        for row in e.summary["per_seed"]
    ]
    return _table(["", *(title for _, title in _COLUMNS)], rows)


def _seed_cell(row: Mapping[str, Any], name: str) -> str:
    text = _with_error(row, name) if name in ("episode_return", "episode_cost") else number(row.get(name))
    return _marked(text, name, row.get("violation_beyond_error"))


def _with_error(content: Mapping[str, Any], name: str) -> str:
    """A mean and its standard error, which summaries of earlier versions lack."""
    if content.get(name) is None:
        return "-"
    return f"{number(content[name])} <small>&plusmn; {number(content.get(f'{name}_standard_error'))}</small>"


def _marked(text: str, name: str, beyond_error: bool | None) -> str:
    """The text of a cell. A violation that is larger than the error of the demonstrations is marked."""
    if name != "relative_cost_violation" or not beyond_error:
        return text
    return f"<span class=beyond title='{_text(BEYOND_ERROR)}'>{marked(text, beyond_error)}</span>"


def _differences(entries: Sequence[Entry]) -> str:
    fields = [e.run.settings for e in entries]  # a run without a field shows a dash
    names = [name for name in (*CONFIG_FIELDS, *GONE) if any(name in f for f in fields)]
    differing = [name for name in names if len({repr(f.get(name, "-")) for f in fields}) > 1]
    rows = [[_text(name), *(_text(str(f.get(name, "-"))) for f in fields)] for name in differing]
    text = _table(["field", *(_text(e.label) for e in entries)], rows) if rows else "<p>All fields are equal.</p>"
    for e in entries:
        facts, demos = e.run.facts, e.run.facts["demonstrations"]
        versions = ", ".join(f"{k} {v}" for k, v in facts["versions"].items())
        text += (
            f"<h3>{_text(e.label)}</h3><p><code>{_text(facts['command'])}</code></p><p class=note>"
            f"physics {_text(facts['physics'])}, device {_text(facts['device']['kind'])}, "
            f"commit {_text(str(facts['git_commit']))}, {_text(versions)}"
            + (
                f", demonstrations sha256 {_text(demos['sha256'])}, {_text(str(demos['num_episodes']))} trajectories"
                if demos
                else ""
            )
            + "</p>"
        )
    return text


def _interval(strata: Sequence[np.ndarray], seed: int) -> str:
    interval = bootstrap_interval(strata, seed=seed)
    return f"{number(interval.value)} <small>{bounds(interval.low, interval.high)}</small>"


def _rate(steps_per_second: float | None) -> str:
    return "-" if steps_per_second is None else f"{steps_per_second:,.0f}"


def _table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{title}</th>" for title in titles)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<div class=wide><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _text(value: str) -> str:
    return html.escape(value, quote=True)


def animate(entry: Entry) -> str:
    """The HTML of an episode of the seed with the highest return.

    It is empty for a run without checkpoints, for a task that cannot be drawn or is not known here, and for a policy
    of the user's own.
    """
    if not (entry.run.folder / "checkpoints").is_dir() or entry.view is None or not is_known(entry.run.config):
        return ""
    from experiments.page import animation  # imports JAX, which a page without episodes does not need

    best, caption = choose_seed(entry)
    return animation.play(evaluating.load(entry.run), best, f"episode-{entry.number}", caption)


def policies_section(files: Sequence[PolicyFile], *, animated: bool = True) -> str:
    """A table of policies, by the episodes that were played when their files were written, and an episode of each.

    Files of tasks that are not of this package stand in the table alone.
    """
    rows, episodes = [], []
    for i, file in enumerate(files):
        training, task = file.training, TASKS.get(file.training["task"])
        for index, seed in enumerate(training["seed_indices"]):
            label = f"{training['method']} on {training['task']}, seed {seed}"
            scores = {name: file.episodes[name][index] for name in file.episodes}
            cells = [_of_episodes(scores.get(name)) for name in ("episode_return", "episode_cost")]
            steps = training.get("env_steps")
            rows.append(
                [_text(label), *cells, number(training["cost_limit"]), f"{steps:,}" if isinstance(steps, int) else "-"]
            )
            if animated and task is not None and task.view is not None:
                from experiments.page import animation  # imports JAX

                loaded = evaluating.load_file(file, task)
                episodes.append(animation.play(loaded, index, f"policy-{i}-{index}", f"One episode of {label}."))
    titles = ["policy", "return", "cost", "limit", "steps of training"]
    note = (
        "<p class=note>Means &plusmn; standard errors over the episodes that were played when a file was written.</p>"
    )
    return "\n".join(["<h2>Policies</h2>", note, _table(titles, rows), *episodes])


def _of_episodes(values: np.ndarray | None) -> str:
    if values is None or not len(values):
        return "-"
    return f"{number(float(np.mean(values)))} <small>&plusmn; {number(standard_error(values))}</small>"
