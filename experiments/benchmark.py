"""Measures the speeds of physics, rollouts, whole training and the meta-gradient, and prints a table with their ratios.

Every row is measured in a process of its own, so that the peak memory is that of the row. Within a row, the kinds of
measurement take turns, for several rounds, and medians over the rounds are reported: when other work slows the machine
down for a while, it slows all kinds of one round, and the ratios stay right.
"""

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ccil_jax.config import Config
from ccil_jax.methods import METHODS
from ccil_jax.presets import PRESETS
from envs.registry import PHYSICS, TaskInfo
from experiments.cli import command_line, options
from experiments.cli.command_line import Parser, UsageError
from experiments.runs import run_folder
from experiments.speed import peers, row_processes, tables

_LEAST_STEPS = 16  # least number of steps of each simulation in a batch, unless --batch-size says otherwise


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("benchmark", __doc__ or "")
    positive = command_line.positive
    parser.add_argument("--tasks", nargs="+", default=["Swimmer", "HalfCheetah"], metavar="TASK", help="task names")
    parser.add_argument(
        "--num-seeds", nargs="+", type=positive, default=[1, 8], metavar="S", help="one row for each (default: 1 8)"
    )
    parser.add_argument(
        "--num-envs",
        nargs="+",
        type=positive,
        default=[16],
        metavar="N",
        help="per seed; one row for each (default: 16)",
    )
    parser.add_argument("--method", default="malm", choices=tuple(METHODS), help="what is trained (default: malm)")
    parser.add_argument(
        "--physics", nargs="+", default=["auto"], choices=PHYSICS, help="engines; one row for each (default: auto)"
    )
    parser.add_argument("--preset", default="paper", choices=tuple(PRESETS), help="hyperparameters (default: paper)")
    parser.add_argument(
        "--batch-size",
        type=positive,
        metavar="K",
        help="steps per batch; minibatches grow with it (default: the preset's, but at least 16 steps of each "
        "simulation, rounded up to a multiple of N)",
    )
    parser.add_argument(
        "--jobs",
        type=positive,
        default=1,
        metavar="J",
        help="rows that are compiled side by side; they are measured one at a time (default: 1)",
    )
    parser.add_argument("--quick", action="store_true", help="fewer and shorter measurements, for a first look")
    parser.add_argument("--seed", default=0, type=command_line.natural, metavar="N", help="base seed (default: 0)")
    parser.add_argument(
        "--out", type=Path, default=Path("benchmark.json"), metavar="FILE", help="result file (default: benchmark.json)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing --out file")
    parser.add_argument(
        "--peers",
        type=Path,
        metavar="DIR",
        help="compare with other packages instead, whose virtual environments are in DIR (docs/performance.md)",
    )
    parser.add_argument("--profile", action="store_true", help="measure instead where the time of an iteration goes")
    parser.add_argument("--row", help=argparse.SUPPRESS)  # a setting as JSON: measure it here and print the result
    return parser


def settings_of(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """The fields of one `setting.Setting` per row. Raises `UsageError` or `ConfigError` for wrong input."""
    changes = {}
    for num_envs in arguments.num_envs:
        changes[num_envs] = _batch(arguments.preset, num_envs, arguments.batch_size)
        chosen = {"method": arguments.method, "num_envs": num_envs}
        options.config_from(chosen, arguments.preset, {"cost_limit": 0.0, **changes[num_envs]})
    return [
        {
            "task": _find_task(task).name,
            "physics": physics,
            "method": arguments.method,
            "num_seeds": num_seeds,
            "num_envs": num_envs,
            "preset": arguments.preset,
            "rounds": 2 if arguments.quick else 5,
            "seconds": 0.3 if arguments.quick else 2.0,
            "seed": arguments.seed,
            "changes": changes[num_envs],
        }
        for task in arguments.tasks
        for physics in arguments.physics
        for num_seeds in arguments.num_seeds
        for num_envs in arguments.num_envs
    ]


def _find_task(name: str) -> TaskInfo:
    task = options.find_task(name, "--tasks")
    if not options.has_option(task, "physics"):
        raise UsageError(f"--tasks {name}: takes no physics, so there is no engine to compare it with; see `growth`")
    return task


def _batch(preset: str, num_envs: int, batch_size: int | None) -> dict[str, int]:
    """Changes of the preset with which `num_envs` simulations fill a batch; the minibatches grow with the batch."""
    config = Config(**PRESETS[preset])
    if batch_size is None:
        least = max(config.batch_size, _LEAST_STEPS * num_envs)
        batch_size = math.ceil(least / num_envs) * num_envs
    times = max(1, batch_size // config.batch_size)
    minibatches = ("critic_minibatch_size", "discriminator_minibatch_size")
    return {"batch_size": batch_size} | {name: times * getattr(config, name) for name in minibatches}


def _beside(setting: dict[str, Any], peer: peers.Peer, num_seeds: int) -> dict[str, Any]:
    """The setting of ours that does the same work as a peer: its task and method, and its batches of 2000 steps."""
    changes = {"batch_size": 2000}
    return {**setting, "task": peer.task, "method": peer.method, "num_seeds": num_seeds, "changes": changes}


def run(arguments: argparse.Namespace) -> None:
    """Measures all rows, prints and writes them."""
    if arguments.row is not None:
        _measure_here(arguments.row, profile=arguments.profile)
        return
    settings = settings_of(arguments)
    if arguments.jobs > 1 and (arguments.profile or arguments.peers):
        raise UsageError("--jobs: neither --profile nor --peers takes turns; leave it out")
    if arguments.profile and arguments.peers:
        raise UsageError("--profile: --peers measures other things instead; leave one of the two out")
    pythons = peers.find_pythons(arguments.peers) if arguments.peers else None
    command_line.check_new_file(arguments.out, "--out", overwrite=arguments.overwrite)
    command_line.check_writable(arguments.out.parent, "--out")
    facts = row_processes.facts_of_machine()
    if pythons:
        _compare(pythons, settings[0], arguments.out, facts)
    else:
        _measure(settings, arguments, facts)
    print(f"written to {arguments.out}")


def _measure_here(text: str, *, profile: bool) -> None:
    """In a row's own process: measures the setting in `text` and prints the row."""
    setting = row_processes.begin_row(text)
    from experiments.speed import measuring, profiling  # import JAX
    from experiments.speed.setting import Setting

    measure = profiling.profile if profile else measuring.measure
    print(json.dumps(measure(Setting(**setting))))


def _compare(pythons: Mapping[str, Path], setting: dict[str, Any], out: Path, facts: Mapping[str, Any]) -> None:
    """Times the trainers of other packages and ours, with the options in `setting`."""
    compared = peers.compare(pythons, lambda peer, seeds: row_processes.measure_row(_beside(setting, peer, seeds)))
    rows = [row for comparison in compared for row in comparison.pop("our_rows")]
    run_folder.write_json(out, {**facts, "rows": rows, "peers": compared})
    tables.print_peers(compared)
    tables.print_rows(rows)


def _measure(settings: Sequence[dict[str, Any]], arguments: argparse.Namespace, facts: Mapping[str, Any]) -> None:
    """Measures the settings. Raises `UsageError` for those that failed, after the others are written and printed."""
    failures, measured, rows = [], {}, list[dict[str, Any]]()
    own_options = ["--profile"] if arguments.profile else []
    for index, row in row_processes.measure_rows(settings, arguments.jobs, own_options):
        if isinstance(row, UsageError):
            failures.append(str(row))
            continue
        measured[index] = row
        rows = [measured[i] for i in sorted(measured)]
        run_folder.write_json(arguments.out, {**facts, "rows": rows})  # now, in case that a later row fails
    if rows:
        (tables.print_profiles if arguments.profile else tables.print_rows)(rows)
    if failures:
        raise UsageError("; ".join(failures))


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
