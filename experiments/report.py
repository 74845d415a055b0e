"""Writes one self-contained HTML page about finished runs: learning curves, metrics with intervals, and every seed.

With --policies, it also shows policies of files at work: those of `evaluate --export` and `expert --export`.
"""

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.cli import command_line, waiting
from experiments.cli.command_line import Parser, UsageError
from experiments.cli.names import safe_name
from experiments.page import document
from experiments.page.entries import Entry, read_entries
from experiments.policies import policy_file
from experiments.policies.policy_file import PolicyFile


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
    files = [policy_file.read(policy_file.find(path, "--policies")) for path in arguments.policies]
    path = arguments.out or (arguments.runs[0] if len(entries) == 1 else Path()) / "report.html"
    command_line.check_new_file(path, "--out", overwrite=arguments.overwrite or document.is_page(path))
    command_line.check_writable(path.parent, "--out")
    if arguments.figures:
        for task in {e.task for e in entries}:
            command_line.check_new_file(_figure(arguments.figures, task), "--figures", overwrite=arguments.overwrite)
        command_line.check_writable(arguments.figures, "--figures")
    path.write_text(_page(entries, files, arguments), encoding="utf-8")
    print(f"page    {path}")
    if arguments.figures:
        for task, runs in document.tasks_of(entries).items():
            figure = _figure(arguments.figures, task)
            figure.write_bytes(document.draw_task(runs))
            print(f"figure  {figure}")


def _page(entries: Sequence[Entry], files: Sequence[PolicyFile], arguments: argparse.Namespace) -> str:
    if arguments.no_animation:
        return document.page(entries, seed=arguments.seed, files=files)
    from experiments.page import episodes  # imports JAX, which a page without episodes does not need

    total = len(entries) + sum(file.num_policies for file in files)
    numbers = itertools.count(1)
    with waiting.progress("playing episodes for the page", "policies") as update:
        update(0, total)

        def play_run(entry: Entry) -> str:
            played = episodes.of_run(entry)
            update(next(numbers), total)
            return played

        def play_policy(file: PolicyFile, index: int) -> str:
            played = episodes.of_policy(file, index)
            update(next(numbers), total)
            return played

        return document.page(entries, seed=arguments.seed, play_run=play_run, files=files, play_policy=play_policy)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
