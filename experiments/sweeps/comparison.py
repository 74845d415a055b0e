"""Finished variants compared: a row of numbers for each, a CSV file, a terminal table."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.config import Config
from experiments.cli.tables import BEYOND_ERROR, bounds, marked, number, show
from experiments.runs import run_folder
from experiments.runs.intervals import bootstrap_interval
from experiments.runs.metrics_file import read_metrics
from experiments.runs.summary import NO_INTERVAL
from experiments.sweeps.variants import Variant

SCORES = ("episode_return", "episode_cost", "recovered_return", "relative_cost_violation")
_FINAL = 0.1  # the final value of a multiplier is its mean over this share of the iterations, the last ones

Row = dict[str, Any]


def row(variant: Variant) -> Row:
    """The row of a finished variant: scores with intervals over seeds, its multiplier, its speed."""
    summary = run_folder.read_json(variant.plan.folder / "summary.json")
    content: Row = {"variant": variant.name, "task": variant.plan.setup.task, "method": variant.plan.config.method}
    content |= {"num_seeds": variant.plan.setup.num_seeds, "env_steps": summary["env_steps"]}
    for name in SCORES:
        values = [seed[name] for seed in summary["per_seed"]]
        interval = None if None in values else bootstrap_interval([np.array(values)])
        content[name] = interval.value if interval else None
        content[f"{name}_low"] = interval.low if interval else None
        content[f"{name}_high"] = interval.high if interval else None
        content[f"{name}_per_seed"] = values
        if name in ("episode_return", "episode_cost"):  # means over episodes, which have errors
            content[f"{name}_standard_error_per_seed"] = [
                seed.get(f"{name}_standard_error") for seed in summary["per_seed"]
            ]
    content["violation_beyond_error"] = summary.get("violation_beyond_error")  # earlier versions do not say
    metrics = read_metrics(variant.plan.folder)
    limit = summary["expert_cost"] if summary["cost_limit"] is None else summary["cost_limit"]
    content |= multiplier_path(variant.plan.config, metrics, limit)
    rate, num_runs = summary["env_steps_per_second"], summary["runs_in_program"]
    return content | {"env_steps_per_second": rate, "runs_in_program": num_runs}


def multiplier_path(config: Config, metrics: Mapping[str, np.ndarray], limit: float | None) -> Row:
    """The course of the multiplier in numbers, each a mean over seeds; None for a method without a multiplier.

    `max_multiplier` is its largest value and `final_multiplier` its mean over the last tenth of the iterations.
    `windup` is the share of the iterations with a known cost in which the cost was already below the limit while the
    multiplier was still above its final value.

    Args:
        config: of the run.
        metrics: of the run, [num_iterations, num_seeds] each.
        limit: of the episode cost; None if there is none.
    """
    if not config.has_multiplier:
        return dict.fromkeys(("max_multiplier", "final_multiplier", "windup"))
    multiplier, episode_cost = metrics["multiplier"], metrics["episode_cost"]
    last = max(1, round(_FINAL * len(multiplier)))
    final = multiplier[-last:].mean(axis=0)
    above = (episode_cost < (np.inf if limit is None else limit)) & (multiplier > final)
    known = ~np.isnan(episode_cost)
    return {
        "max_multiplier": float(multiplier.max(axis=0).mean()),
        "final_multiplier": float(final.mean()),
        "windup": float(above[known].mean()) if known.any() else None,
    }


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Writes the rows as a CSV file. The values of single seeds stand in one cell, separated by blanks."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _cell(value) for name, value in content.items()} for content in rows)


def print_rows(title: str, columns: Mapping[str, str], rows: Sequence[Row], section: str = "") -> None:
    """Prints the rows as a table.

    Args:
        title: of the table.
        columns: names of the values to show, with their headings.
        rows: from `row`.
        section: name of a value. Where it changes from one row to the next, a line separates the rows.
    """
    from rich.table import Table

    table = Table(title=title, title_justify="left", caption_justify="left")
    for name, heading in columns.items():
        table.add_column(heading, justify="left" if isinstance(rows[0][name], str) else "right")
    previous = rows[0].get(section)
    for content in rows:
        if content.get(section) != previous:
            table.add_section()
            previous = content.get(section)
        table.add_row(*(_shown(content, name) for name in columns))
    mark = f"*: {BEYOND_ERROR}" if any(content.get("violation_beyond_error") for content in rows) else ""
    note = note_on_intervals(rows)
    table.caption = "; ".join(filter(None, (mark, note and f"-: {note}"))) or None
    show(table)


def note_on_intervals(rows: Sequence[Row]) -> str:
    """The note that explains missing intervals; empty if all rows have intervals."""
    missing = any(row[name] is not None and row[f"{name}_low"] is None for row in rows for name in SCORES)
    return NO_INTERVAL if missing else ""


def _shown(content: Row, name: str) -> str:
    value = content[name]
    if f"{name}_low" in content and value is not None:
        shown = f"{number(value)} {bounds(content[f'{name}_low'], content[f'{name}_high'])}"
        beyond = name == "relative_cost_violation" and content.get("violation_beyond_error")
        return marked(shown, beyond)
    return value if isinstance(value, str) else str(value) if isinstance(value, int) else number(value)


def _cell(value: Any) -> Any:
    if isinstance(value, list):
        return " ".join("" if v is None else f"{v:.6g}" for v in value)
    return f"{value:.6g}" if isinstance(value, float) else value
