"""The tables of a page; return and cost come first."""

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ccil_jax.demonstrations.trajectories import standard_error
from ccil_jax.earlier_versions import GONE
from experiments.cli.options import CONFIG_FIELDS
from experiments.cli.tables import BEYOND_ERROR, bounds, marked, number
from experiments.page.entries import Entry
from experiments.policies.policy_file import PolicyFile
from experiments.runs.intervals import bootstrap_interval

_COLUMNS = (
    ("episode_return", "return"),
    ("episode_cost", "cost"),
    ("recovered_return", "recovered return, %"),
    ("relative_cost_violation", "rel. violation"),
    ("penalized_return", "penalised return, %"),
    ("cost_rate", "cost rate in training"),
)


def metrics(entries: Sequence[Entry], seed: int) -> str:
    """A row for each run: every score over its seeds, with its interval; and rows for what it is compared with.

    `seed` is that of the bootstrap intervals.
    """
    rows = []
    for e in entries:
        cells = [text(e.label)]
        for name, _ in _COLUMNS:
            values = [row.get(name) for row in e.summary["per_seed"]]
            cell = "-" if None in values else _interval([np.array(values)], seed)
            cells.append(_marked(cell, name, e.summary.get("violation_beyond_error")))
        steps = f"{e.summary['env_steps']:,}"
        rows.append([*cells, text(str(e.summary["num_seeds"])), steps, _rate(e.summary["env_steps_per_second"])])
    titles = ["", *(title for _, title in _COLUMNS), "seeds", "steps per seed", "steps/s"]
    rows += [[*cells, *[""] * (len(titles) - len(cells))] for cells in _reference_rows(entries)]
    return table(titles, rows)


def _reference_rows(entries: Sequence[Entry]) -> Iterable[list[str]]:
    """Rows for the expert, the random policy and the cost limit: a label, return and cost.

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
                yield [title if len(runs) == 1 else text(f"{title} of {', '.join(labels)}"), *cells]


def across_tasks(entries: Sequence[Entry], seed: int) -> str:
    """A table of the methods over all tasks; for the intervals, seeds are resampled within each task."""
    rows = []
    for method in dict.fromkeys(e.run.config.method for e in entries):
        chosen = [e for e in entries if e.run.config.method == method]
        cells = [text(method), str(len({e.task for e in chosen}))]
        for name in ("recovered_return", "relative_cost_violation", "penalized_return"):
            strata = [np.array([row.get(name) for row in e.summary["per_seed"]], np.float64) for e in chosen]
            cells.append(_interval(strata, seed) if all(np.isfinite(s).all() for s in strata) else "-")
        rows.append(cells)
    titles = ["", "tasks", "recovered return, %", "rel. violation", "penalised return, %"]
    return table(titles, rows)


def seeds(entries: Sequence[Entry]) -> str:
    """A row for each seed of each run."""
    rows = [
        [text(f"{e.label}, seed {row['seed']}"), *(_seed_cell(row, name) for name, _ in _COLUMNS)]
        for e in entries
        for row in e.summary["per_seed"]
    ]
    return table(["", *(title for _, title in _COLUMNS)], rows)


def _seed_cell(row: Mapping[str, Any], name: str) -> str:
    cell = _with_error(row, name) if name in ("episode_return", "episode_cost") else number(row.get(name))
    return _marked(cell, name, row.get("violation_beyond_error"))


def _with_error(content: Mapping[str, Any], name: str) -> str:
    """A mean and its standard error, which summaries of earlier versions lack."""
    if content.get(name) is None:
        return "-"
    return f"{number(content[name])} <small>&plusmn; {number(content.get(f'{name}_standard_error'))}</small>"


def _marked(cell: str, name: str, beyond_error: bool | None) -> str:
    """The text of a cell. A violation that is larger than the error of the demonstrations is marked."""
    if name != "relative_cost_violation" or not beyond_error:
        return cell
    return f"<span class=beyond title='{text(BEYOND_ERROR)}'>{marked(cell, beyond_error)}</span>"


def differences(entries: Sequence[Entry]) -> str:
    """The fields in which the runs differ, then the command, the versions and the demonstrations of each run."""
    fields = [e.run.settings for e in entries]  # a run without a field shows a dash
    names = [name for name in (*CONFIG_FIELDS, *GONE) if any(name in f for f in fields)]
    differing = [name for name in names if len({repr(f.get(name, "-")) for f in fields}) > 1]
    rows = [[text(name), *(text(str(f.get(name, "-"))) for f in fields)] for name in differing]
    shown = table(["field", *(text(e.label) for e in entries)], rows) if rows else "<p>All fields are equal.</p>"
    return shown + "".join(_origin(e) for e in entries)


def _origin(entry: Entry) -> str:
    facts, demos = entry.run.facts, entry.run.facts["demonstrations"]
    made_with = [f"physics {facts['physics']}", f"device {facts['device']['kind']}", f"commit {facts['git_commit']}"]
    made_with += [f"{name} {version}" for name, version in facts["versions"].items()]
    if demos:
        made_with += [f"demonstrations sha256 {demos['sha256']}", f"{demos['num_episodes']} trajectories"]
    return (
        f"<h3>{text(entry.label)}</h3><p><code>{text(facts['command'])}</code></p>"
        f"<p class=note>{text(', '.join(made_with))}</p>"
    )


def _interval(strata: Sequence[np.ndarray], seed: int) -> str:
    interval = bootstrap_interval(strata, seed=seed)
    return f"{number(interval.value)} <small>{bounds(interval.low, interval.high)}</small>"


def _rate(steps_per_second: float | None) -> str:
    return "-" if steps_per_second is None else f"{steps_per_second:,.0f}"


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of HTML texts, which scrolls within its own box where it is wider than the page."""
    head = "".join(f"<th>{title}</th>" for title in titles)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<div class=wide><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def text(value: str) -> str:
    """The text as it is, for HTML."""
    return html.escape(value, quote=True)


def policies(files: Sequence[PolicyFile]) -> str:
    """A row for each policy, by the episodes that were played when its file was written."""
    rows = []
    for file in files:
        steps = file.training.get("env_steps")
        for index in range(file.num_policies):
            scores = {name: values[index] for name, values in file.episodes.items()}
            cells = [_of_episodes(scores.get(name)) for name in ("episode_return", "episode_cost")]
            cells += [number(file.training["cost_limit"]), f"{steps:,}" if isinstance(steps, int) else "-"]
            rows.append([text(policy_label(file, index)), *cells])
    return table(["policy", "return", "cost", "limit", "steps of training"], rows)


def policy_label(file: PolicyFile, index: int) -> str:
    """What the policy `index` of a file is called."""
    training = file.training
    return f"{training['method']} on {training['task']}, seed {training['seed_indices'][index]}"


def _of_episodes(values: np.ndarray | None) -> str:
    if values is None or not len(values):
        return "-"
    return f"{number(float(np.mean(values)))} <small>&plusmn; {number(standard_error(values))}</small>"
