"""Repeats the iteration because of which a seed was given up, and names what is not finite after it.

The diagnostic file of the seed, in its run folder, has the state before that iteration.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ccil_jax.demonstrations.npz import ArchiveError
from ccil_jax.demonstrations.trajectories import Demonstrations, load_demonstrations
from ccil_jax.training.filesystem import content_sha256
from experiments.cli import command_line
from experiments.cli.command_line import Parser, UsageError
from experiments.runs import demonstration_files, fault_files, run_folder
from experiments.runs.environments import build_environment


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("replay_fault", __doc__ or "")
    parser.add_argument("file", type=Path, metavar="FILE", help="fault_seed_N.npz of a run folder")
    parser.add_argument(
        "--demos",
        type=demonstration_files.to_read,
        metavar="FILE",
        help="the demonstrations of the run, if they were moved",
    )
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Prints what is not finite after the iteration. Returns the exit status, 1 if the fault does not recur."""
    try:
        found = replay(arguments.file, arguments.demos)
    except ArchiveError as error:
        raise UsageError(str(error)) from None
    print("\n".join(f"not finite: {name}" for name in found) or "every number is finite: the fault does not recur")
    return 0 if found else 1


def replay(path: Path, demos: Path | None = None) -> list[str]:
    """Does one iteration, without the guard that would take it back, from the state in the file `path`.

    Returns:
        The names of the metrics and of the parts of the state that are not finite afterwards.
    """
    run = run_folder.parse_run(path, fault_files.read_facts(path))
    run_folder.check_continues(run, f"FILE {path}")
    task = run_folder.task_of(run)
    demonstrations = _demonstrations(run.facts["demonstrations"], demos)

    import jax

    from ccil_jax.agents import build
    from ccil_jax.agents.expert import expert_of
    from ccil_jax.training import guard
    from envs.jax_tools import full_precision

    env = build_environment(task.name, run.facts["physics"], run.facts["env_options"])
    config = build.resolve(run.config, env, demonstrations)
    agent = build.make(config, env, expert_of(config, env, demonstrations))
    state = fault_files.read_state(path, jax.eval_shape(agent.init, jax.random.key(0)))
    state, metrics = jax.jit(full_precision(agent.step))(state)  # as in training
    return [*guard.not_finite({"metrics": metrics}), *guard.not_finite({"state": state})]


def _demonstrations(facts: dict[str, Any] | None, path: Path | None) -> Demonstrations | None:
    if facts is None:
        return None
    path = path or Path(facts["file"])
    if content_sha256(path) != facts["sha256"]:
        raise UsageError(f"--demos {path}: not the file that the run began with; give that file")
    return load_demonstrations(path).take_episodes(facts["num_episodes"])


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
