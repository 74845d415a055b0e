"""Trains one method on one task, all seeds in one program, and writes a run folder with figures and a table."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.cli import command_line
from experiments.cli.command_line import Parser
from experiments.runs import plans
from experiments.runs.execution import execute
from experiments.runs.plans import RunPlan
from experiments.runs.resuming import resumed


def make_parser() -> Parser:
    """The options of this launcher. One that is not given is absent, so that --resume can tell it from a default."""
    parser = Parser("train", __doc__ or "")
    plans.add_options(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="run folder (default: runs/<task>_<method>_<time>)")
    parser.add_argument("--resume", action="store_true", help="continue the run in --out from its last checkpoint")
    return parser


def make_plan(arguments: argparse.Namespace) -> RunPlan:
    """Turns the options into the plan of a run. Raises a `UserError` for wrong input."""
    given = {k: v for k, v in vars(arguments).items() if k not in ("out", "resume")}
    saved = resumed(arguments.out, given) if arguments.resume else {}
    plan = plans.plan_of(given, arguments.out, resume=arguments.resume, saved=saved)
    command_line.check_output_folder(plan.folder, resume=plan.resume)
    return plan


def run(arguments: argparse.Namespace) -> int:
    """Checks everything, then trains. Returns the exit status, 1 if a seed had to be given up."""
    return execute(make_plan(arguments)).status


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
