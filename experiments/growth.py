"""How time and memory grow with seeds, simulations, network width and demonstrations: a table and a log-log figure.

Every point is measured in a process of its own. The exponent p of value = c size^p is the slope of log(value) against
log(size), fitted to the larger half of the sizes, where constant costs matter least.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.methods import METHODS
from experiments.cli import command_line, options
from experiments.cli.command_line import Parser
from experiments.cli.tables import show
from experiments.runs import run_folder
from experiments.speed import row_processes

DEMONSTRATIONS = 10_000  # steps of the demonstrations, on all axes but theirs
AXES: Mapping[str, tuple[int, ...]] = {
    "seeds": (1, 2, 4, 8, 16, 32, 64),
    "simulations": (16, 64, 256, 1024, 4096),
    "width": (32, 64, 128, 256, 512),
    "demonstration steps": (1_000, 10_000, 100_000, 1_000_000),
}
MEASURES = {
    "seconds_per_iteration": "seconds per iteration",
    "compile_seconds": "seconds to compile",
    "peak_memory": "peak memory, MiB",
}


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("growth", __doc__ or "")
    parser.add_argument("--env", default="HalfCheetah", metavar="TASK", help="task (default: HalfCheetah)")
    parser.add_argument("--method", default="malm", choices=tuple(METHODS), help="what is trained (default: malm)")
    parser.add_argument(
        "--axes",
        nargs="+",
        choices=tuple(AXES),
        default=tuple(AXES),
        metavar="AXIS",
        help=f"of {', '.join(AXES)} (default: all)",
    )
    parser.add_argument("--largest", type=command_line.positive, metavar="N", help="leave out points beyond N")
    parser.add_argument("--out", type=Path, default=Path("growth"), metavar="DIR", help="new folder (default: growth)")
    parser.add_argument("--row", help=argparse.SUPPRESS)  # a setting as JSON: measure it here and print the result
    return parser


def settings_of(arguments: argparse.Namespace) -> list[tuple[str, int, dict[str, Any]]]:
    """(axis, value, setting) of every point. A batch holds at least one step of every simulation."""
    task = options.find_task(arguments.env, "--env").name
    points = []
    for axis in arguments.axes:
        for value in AXES[axis]:
            if arguments.largest and value > arguments.largest:
                continue
            changes: dict[str, Any] = {"batch_size": 4096 if axis == "simulations" else 2000}
            if axis == "width":
                changes["hidden_sizes"] = [value, value]
            setting = {
                "task": task,
                "physics": "auto",
                "method": arguments.method,
                "num_seeds": value if axis == "seeds" else 1,
                "num_envs": value if axis == "simulations" else 16,
                "preset": "paper",
                "rounds": 3,
                "seconds": 0.0,
                "seed": 0,
                "changes": changes,
                "num_demonstration_steps": value if axis == "demonstration steps" else DEMONSTRATIONS,
            }
            points.append((axis, value, setting))
    return points


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """The slope of log(value) against log(size) over the larger half of the points, by least squares."""
    half = len(sizes) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(values[half:]), 1)[0])


def exponents_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float | None]]:
    """The exponent by axis and measure; None where an axis has fewer than three points."""
    found: dict[str, dict[str, float | None]] = {}
    for axis in dict.fromkeys(row["axis"] for row in rows):
        own = [row for row in rows if row["axis"] == axis]
        sizes = [row["value"] for row in own]
        found[axis] = {name: exponent(sizes, [row[name] for row in own]) if len(own) > 2 else None for name in MEASURES}
    return found


def draw(path: Path, rows: Sequence[Mapping[str, Any]], title: str) -> None:
    """Draws one panel per axis; both scales are logarithmic, and each measure is relative to its first point."""
    from matplotlib.figure import Figure

    axes = list(dict.fromkeys(row["axis"] for row in rows))
    exponents = exponents_of(rows)
    figure = Figure(figsize=(3.6 * len(axes), 3.6), layout="constrained")
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    panels = figure.subplots(1, len(axes), squeeze=False, sharey=True)[0]
    for panel, axis in zip(panels, axes, strict=True):
        own = [row for row in rows if row["axis"] == axis]
        sizes = [row["value"] for row in own]
        for name, label in MEASURES.items():
            values = np.array([row[name] for row in own])
            slope = exponents[axis][name]
            text = label if slope is None else f"{label}: {slope:.2f}"
            panel.loglog(sizes, values / values[0], marker="o", markersize=4, label=text)
        panel.set_xticks(sizes, [f"{size:,}" for size in sizes], fontsize=7)
        panel.minorticks_off()
        panel.set_xlabel(axis)
        panel.set_title(f"{axis}, exponents", fontsize=9, loc="left")
        panel.grid(alpha=0.3)
        panel.legend(fontsize=7, frameon=False, loc="upper left")
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("relative to the smallest")
    figure.savefig(path, dpi=150)


def print_rows(rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints all points as a table, with the exponents of each axis."""
    from rich.table import Table

    table = Table(title="growth", title_justify="left")
    table.add_column("axis")
    for text in ("size", *MEASURES.values(), "steps/s"):
        table.add_column(text, justify="right")
    for axis, exponents in exponents_of(rows).items():
        for row in rows:
            if row["axis"] == axis:
                numbers = (f"{row['seconds_per_iteration']:.3f}", f"{row['compile_seconds']:.1f}")
                rate = f"{row['training_steps_per_second']:,.0f}"
                table.add_row(axis, f"{row['value']:,}", *numbers, f"{row['peak_memory']:,.0f}", rate)
        slopes = ("-" if slope is None else f"{slope:.2f}" for slope in exponents.values())
        table.add_row("", "exponent", *slopes, "")
        table.add_section()
    show(table)


def run(arguments: argparse.Namespace) -> None:
    """Measures all points, writes and draws them, and prints the table."""
    if arguments.row is not None:
        setting = row_processes.begin_row(arguments.row)
        from experiments.speed import measuring  # imports JAX
        from experiments.speed.setting import Setting

        print(json.dumps(measuring.measure_training(Setting(**setting))))
        return
    points = settings_of(arguments)
    command_line.check_output_folder(arguments.out, record="growth.json")
    facts, rows = row_processes.facts_of_machine(), list[dict[str, Any]]()
    for axis, value, setting in points:
        print(f"measuring {axis} {value:,} ...", file=sys.stderr, flush=True)
        rows.append({"axis": axis, "value": value, **row_processes.measure_row(setting, "growth")})
        content = {**facts, "rows": rows, "exponents": exponents_of(rows)}
        run_folder.write_json(arguments.out / "growth.json", content)
    title = f"{arguments.method} on {rows[0]['task']}: cost of an iteration, relative to the smallest"
    draw(arguments.out / "growth.png", rows, title)
    print_rows(rows)
    print(f"written to {arguments.out}")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
