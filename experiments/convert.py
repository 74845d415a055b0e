"""Converts demonstrations between formats: from baselines, CCIL, DSRL, Minari and ours to ours, DSRL's or Minari's.

What is read is recognised by its content, or is of a format of your own, `--format`. It is not trusted: no code in it
is run, and a file that is damaged, inconsistent or of another task is refused with a one-line message. What is written
follows from the name of --out. DSRL's and Minari's datasets have the observation after each episode's last step, which
files of earlier versions lack.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from ccil_jax.demonstrations import formats
from ccil_jax.demonstrations.trajectories import Demonstrations, check_matches, load_demonstrations, save_demonstrations
from ccil_jax.errors import UserError
from experiments.cli import command_line, options
from experiments.cli.command_line import Parser, UsageError
from experiments.runs import demonstration_files


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("convert", __doc__ or "")
    parser.add_argument(
        "file",
        type=demonstration_files.to_read,
        metavar="FILE",
        help=f"demonstrations: {demonstration_files.TO_READ}",
    )
    parser.add_argument(
        "--env", metavar="TASK", help="task of the demonstrations, whose dimensions must be those of the task"
    )
    parser.add_argument(
        "--format",
        metavar="MODULE:NAME",
        help="read it as your own ccil_jax.Format, found as NAME in the Python module MODULE "
        "(default: recognise the format)",
    )
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="FILE",
        help=f"what to write: {demonstration_files.TO_WRITE}",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace what --out names")
    parser.add_argument(
        "--default-cost",
        type=float,
        metavar="X",
        help="cost of every step where the file has none (default: refuse it)",
    )
    return parser


def run(arguments: argparse.Namespace) -> None:
    """Checks everything, converts the file and prints what was written."""
    task = options.find_task(arguments.env)
    out: Path = arguments.out
    demonstration_files.check_new(out, "--out", overwrite=arguments.overwrite)
    if arguments.default_cost is not None and not 0 <= arguments.default_cost < float("inf"):
        raise UsageError(f"--default-cost {arguments.default_cost}: must be finite and not negative")
    try:
        file_format = None if arguments.format is None else formats.named(arguments.format)
    except UserError as error:
        raise UsageError(f"--format {error}") from error
    demonstrations = load_demonstrations(arguments.file, default_cost=arguments.default_cost, file_format=file_format)
    if arguments.default_cost not in (None, demonstrations.metadata.get("default_cost")):
        raise UsageError(
            f"--default-cost {arguments.default_cost:g}: {arguments.file} has costs of its own; leave it out"
        )
    check_matches(demonstrations, arguments.file, task)
    demonstration_files.check_writable(out, "--out")
    earlier = demonstrations.metadata.get("command")  # those that made the demonstrations, one a line
    made_by = f"{earlier}\n{command_line.command()}" if isinstance(earlier, str) else command_line.command()
    facts = {"task": task.name, "source": arguments.file.name, "command": made_by}
    try:
        save_demonstrations(out, dataclasses.replace(demonstrations, metadata={**demonstrations.metadata, **facts}))
    except OSError as error:
        raise UsageError(f"--out {out}: cannot be written ({error.strerror}); make space or choose another") from None
    print(_summary(demonstrations, out))
    if note := demonstration_files.note_on_rewards(demonstrations, task.name):
        print(f"note: {note}")


def _summary(demonstrations: Demonstrations, out: Path) -> str:
    mean_return, actions = demonstrations.mean_episode_return, demonstrations.actions
    return (
        f"{out}: {demonstrations.num_episodes} trajectories, {demonstrations.num_steps} steps (at most "
        f"{demonstrations.episode_lengths.max()} each), mean return "
        f"{'unknown' if mean_return is None else f'{mean_return:g}'}, mean cost {demonstrations.mean_episode_cost:g}, "
        f"actions from {actions.min():g} to {actions.max():g}"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
