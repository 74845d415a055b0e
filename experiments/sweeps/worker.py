"""Carries out one job of a sweep: trains all its variants together, in one program, and completes their run folders.

`sweep` and `ablations` start it. A job that was interrupted goes on from its last checkpoint.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.cli import command_line, interruption
from experiments.cli.command_line import Parser
from experiments.runs.execution import execute_together
from experiments.runs.plans import ProgramPlan
from experiments.sweeps import variants


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("sweeps.worker", __doc__ or "")
    parser.add_argument("program", type=Path, metavar="PROGRAM_DIR", help="a folder under `programs` of a sweep")
    parser.add_argument("--cpus", type=_cpus, metavar="I,J,...", help="use only these CPUs")
    parser.add_argument(
        "--until-eof",
        action="store_true",
        help="stop when standard input ends, because then the parent process has ended",
    )
    return parser


def run(arguments: argparse.Namespace) -> None:
    """Trains and evaluates the variants and completes their run folders."""
    if arguments.until_eof:
        interruption.stop_at_eof()
    if arguments.cpus and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, arguments.cpus)
    folder = arguments.program.resolve()
    if (start := variants.started_in(folder)).is_dir():  # Ray starts its workers elsewhere
        os.chdir(start)
    job = variants.read_job(folder)
    if all(variant.finished for variant in job.variants):
        return  # the worker before this one died after everything was done
    program = ProgramPlan(
        runs=tuple(variant.plan for variant in job.variants),
        checkpoint_dir=job.folder / "checkpoints",
        resume=True,
        finished=frozenset(variant.plan.folder for variant in job.variants if variant.finished),
    )
    execute_together(program)


def _cpus(text: str) -> list[int]:
    return [command_line.natural(part) for part in text.split(",")]


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
