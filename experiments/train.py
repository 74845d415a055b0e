"""Trains one method on one task, all seeds in one program, and writes a run folder with figures and a table."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ccil_jax.errors import UserError
from experiments.cli import command_line, settings_file
from experiments.cli.command_line import Parser, UsageError
from experiments.runs import plans
from experiments.runs.execution import execute
from experiments.runs.plans import RunPlan
from experiments.runs.resuming import repeated, resumed


def make_parser() -> Parser:
    """The options of this launcher. One that is not given is absent, so that --resume can tell it from a default."""
    parser = Parser("train", __doc__ or "")
    plans.add_options(parser)
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="options of this launcher in a TOML or JSON file, or the config.json of an earlier run, which is to be "
        "done again; an option on the command line comes before one in the file",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="run folder (default: runs/<task>_<method>_<time>)")
    parser.add_argument("--resume", action="store_true", help="continue the run in --out from its last checkpoint")
    return parser


def make_plan(arguments: argparse.Namespace) -> RunPlan:
    """Turns the options into the plan of a run. Raises a `UserError` for wrong input."""
    given = {k: v for k, v in vars(arguments).items() if k not in ("config", "out", "resume")}
    saved: dict[str, Any] = {}
    if arguments.resume and arguments.config:
        raise UsageError(
            f"--config {arguments.config}: a run that is resumed has its own options; leave one of the two out"
        )
    if arguments.resume:
        saved = resumed(arguments.out, given)
    elif arguments.config:
        content = settings_file.read(arguments.config, "--config")
        if "config" in content:
            saved = repeated(arguments.config, content, given)
        else:
            given = {**_options_in(arguments.config, content), **given}
    plan = plans.plan_of(given, arguments.out, resume=arguments.resume, saved=saved)
    command_line.check_output_folder(plan.folder, resume=plan.resume)
    return plan


def _options_in(path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    """The options in a file, by name. Raises `UsageError`, which names the file, for a wrong one."""
    typed = []
    for name, value in content.items():
        if isinstance(value, dict):
            raise UsageError(f"--config {path}: {name}: a table; give the options of `train` side by side")
        typed.append(f"--{name.replace('_', '-')}={settings_file.text(value)}")
    try:
        return plans.parse_options(typed)
    except UserError as error:
        raise UsageError(f"--config {path}: {error}") from None


def run(arguments: argparse.Namespace) -> int:
    """Checks everything, then trains. Returns the exit status, 1 if a seed had to be given up."""
    return execute(make_plan(arguments)).status


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
