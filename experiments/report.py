"""Writes one self-contained HTML page about finished runs: learning curves, metrics with intervals, and every seed.

With --policies, it also shows policies of files at work: those of `evaluate --export` and `expert --export`.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.cli import command_line
from experiments.cli.command_line import Parser, UsageError
from experiments.cli.names import safe_name
from experiments.page import document
from experiments.page.entries import read_entries
from experiments.policies import policy_file


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("report", __doc__ or "")
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN_DIR", help="folders that `train` or `expert` wrote")
    parser.add_argument(
        "--policies",
        nargs="+",
        default=[],
        type=Path,
        metavar="FILE.npz",
        help="policies to show, too: their returns and costs, and an episode of each",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE.html", help="page to write (default: report.html in the only run, or here)"
    )
    parser.add_argument(
        "--figures", type=Path, metavar="DIR", help="also write each task's curves there, DIR/<task>.png"
    )
    parser.add_argument(
        "--seed", default=0, type=command_line.natural, metavar="N", help="of the bootstrap intervals (default: 0)"
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace existing files, other than pages of this launcher, which are always replaced",
    )
    parser.add_argument("--no-animation", action="store_true", help="leave out the animated episodes")
    return parser


def _figure(folder: Path, task: str) -> Path:
    return folder / f"{safe_name(task)}.png"


def run(arguments: argparse.Namespace) -> None:
    """Reads the runs, then writes the page and the figures."""
    if not arguments.runs and not arguments.policies:
        raise UsageError("RUN_DIR: give at least one folder of a run, or --policies FILE.npz")
    entries = read_entries(arguments.runs)
    files = [policy_file.read(policy_file.find(path)) for path in arguments.policies]
    path = arguments.out or (arguments.runs[0] if len(entries) == 1 else Path()) / "report.html"
    command_line.check_new_file(path, "--out", overwrite=arguments.overwrite or document.is_page(path))
    command_line.check_writable(path.parent, "--out")
    if arguments.figures:
        for task in {e.task for e in entries}:
            command_line.check_new_file(_figure(arguments.figures, task), "--figures", overwrite=arguments.overwrite)
        command_line.check_writable(arguments.figures, "--figures")
    images = document.draw_tasks(entries)
    player = None if arguments.no_animation else document.animate
    shown = document.policies_section(files, animated=not arguments.no_animation) if files else ""
    page = document.page(entries, images, seed=arguments.seed, player=player, policies=shown)
    path.write_text(page, encoding="utf-8")
    print(f"page    {path}")
    if arguments.figures:
        for task, image in images.items():
            figure = _figure(arguments.figures, task)
            figure.write_bytes(image)
            print(f"figure  {figure}")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
