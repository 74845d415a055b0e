"""Measures physics, rollouts, whole training and the meta-gradient, and prints a table with their ratios.

Every row runs in a process of its own (so that peak memory is that row's); within a row the measurements are taken in
turn, and medians are reported, so that other work on the machine spoils a round rather than a ratio.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from ccil_jax.config import CHOICES, PRESETS, Config
from ccil_jax.training.versions import versions
from envs.registry import PHYSICS
from experiments.cli import command_line, interruption, options, xla
from experiments.cli.command_line import Parser, UsageError
from experiments.cli.tables import show
from experiments.runs import run_folder
from experiments.runs.provenance import git_commit
from experiments.speed import peers
from experiments.sweeps import backends

_LEAST_STEPS = 16  # of each simulation in a batch


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
    parser.add_argument("--method", default="malm", choices=CHOICES["method"], help="what is trained (default: malm)")
    parser.add_argument(
        "--physics", nargs="+", default=["auto"], choices=PHYSICS, help="engines; one row for each (default: auto)"
    )
    parser.add_argument("--preset", default="paper", choices=tuple(PRESETS), help="hyperparameters (default: paper)")
    parser.add_argument(
        "--batch-size",
        type=positive,
        metavar="K",
        help="steps per batch, whose minibatches grow with it (default: the preset's, or the next multiple of N, or 16 "
        "steps of each simulation, whichever is more)",
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
        help="instead: compare with other packages, whose environments are in DIR (docs/performance.md)",
    )
    parser.add_argument("--profile", action="store_true", help="instead: where the time of an iteration goes")
    parser.add_argument("--row", help=argparse.SUPPRESS)  # a setting as JSON: measure it here and print the result
    return parser


def settings_of(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """One setting (see `measuring.Setting`) per row. Raises `UsageError` or `ConfigError` for wrong input."""
    changes = {}
    for num_envs in arguments.num_envs:
        changes[num_envs] = _batch(arguments.preset, num_envs, arguments.batch_size)
        chosen = {"method": arguments.method, "num_envs": num_envs}
        options.config_from(chosen, arguments.preset, {"cost_limit": 0.0, **changes[num_envs]})
    return [
        {
            "task": options.find_task(task, "--tasks").name,
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


def _batch(preset: str, num_envs: int, batch_size: int | None) -> dict[str, int]:
    """Changes to the preset, so that `num_envs` simulations fill its batch or, where they are many, a larger one."""
    config = Config(**PRESETS[preset])
    if batch_size is None:
        least = max(config.batch_size, _LEAST_STEPS * num_envs)
        batch_size = math.ceil(least / num_envs) * num_envs
    times = max(1, batch_size // config.batch_size)
    minibatches = ("critic_minibatch_size", "discriminator_minibatch_size")
    return {"batch_size": batch_size} | {name: times * getattr(config, name) for name in minibatches}


def measure_row(setting: dict[str, Any], launcher: str = "benchmark", *options: str) -> dict[str, Any]:
    """Measures one setting in a process of its own. Raises `UsageError` with its last words if that process fails."""
    command = [sys.executable, "-P", "-m", f"experiments.{launcher}", *options, "--row", json.dumps(setting)]
    # The compilation is measured, so nothing may come from a cache.
    environment = {**os.environ, "PYTHONPATH": backends.python_path(), "JAX_ENABLE_COMPILATION_CACHE": "false"}
    if setting.get("turns"):  # an accelerator's memory is shared
        environment.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    ears, mouth = os.pipe()  # they close with this process, and then the row ends too
    with open(ears, "rb") as stdin, open(mouth, "wb"):
        done = subprocess.run(command, stdin=stdin, capture_output=True, text=True, check=False, env=environment)
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or [f"exit status {done.returncode}"]
        raise UsageError(f"{_name(setting)}: cannot be measured: {last[0]}")
    row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return row


def begin_row(text: str) -> dict[str, Any]:
    """In a row's own process: the setting that `measure_row` gave it, once this process is as training's would be."""
    interruption.stop_at_eof()
    setting: dict[str, Any] = json.loads(text)
    xla.spread_seeds(setting["num_seeds"])
    return setting


def _name(setting: Mapping[str, Any]) -> str:
    size = f"{setting['num_seeds']} x {setting['num_envs']}"
    return f"{setting['task']} ({setting['physics']}), {size}"


def facts_of_machine() -> dict[str, Any]:
    """What goes with every measurement."""
    return {
        "command": command_line.command(),
        "versions": versions(),
        "git_commit": git_commit(),
        "cpus": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load_average": os.getloadavg(),
    }


def print_rows(rows: Sequence[dict[str, Any]]) -> None:
    """The rows as a terminal table."""
    from rich.table import Table

    table = Table(title="control steps per second, all seeds together", title_justify="left")
    for title in ("task", "seeds x envs", "physics alone", "rollout", "training"):
        table.add_column(title, justify="left" if title == "task" else "right", no_wrap=True)
    for title in ("training / physics", "training / rollout", "meta-gradient / policy step", "compile, s", "peak, MiB"):
        table.add_column(title, justify="right")
    for row in rows:
        rates = [row[f"{name}_steps_per_second"] for name in ("physics", "rollout", "training")]
        table.add_row(
            f"{row['task']} ({row['physics']})",
            f"{row['num_seeds']} x {row['num_envs']}",
            *(f"{rate:,.0f}" for rate in rates),
            f"{row['training_to_physics']:.2f}",
            f"{row['training_to_rollout']:.2f}",
            f"{row['meta_gradient_to_policy_step']:.2f}",
            f"{row['compile_seconds']:.1f}",
            f"{row['peak_memory']:,.0f}",
        )
    show(table)


def print_profiles(rows: Sequence[dict[str, Any]]) -> None:
    """The parts of an iteration as a terminal table."""
    from rich.table import Table

    table = Table(
        title="microseconds per environment step, all seeds together (ratio to physics)", title_justify="left"
    )
    table.add_column("part")
    for row in rows:
        table.add_column(f"{row['task']}, {row['num_seeds']} x {row['num_envs']}", justify="right")
    for part in rows[0]["parts"]:
        of_rows = [row["parts"][part] for row in rows]
        table.add_row(part, *(f"{x['microseconds_per_step']:.2f} ({x['to_physics']:.2f})" for x in of_rows))
    show(table)


def _beside(setting: dict[str, Any], peer: peers.Peer, num_seeds: int) -> dict[str, Any]:
    """The row of ours that does a peer's work: its task and method, and batches of 2000 steps as there."""
    changes = {"batch_size": 2000}
    return {**setting, "task": peer.task, "method": peer.method, "num_seeds": num_seeds, "changes": changes}


def print_peers(compared: Sequence[dict[str, Any]]) -> None:
    """Peers and ours as a terminal table."""
    from rich.table import Table

    table = Table(title="training, environment steps per second", title_justify="left")
    for title in ("trainer", "steps/s", "ours : it"):
        table.add_column(title, justify="left" if title == "trainer" else "right")
    for comparison in compared:
        for way, rates in comparison["ways"].items():
            table.add_row(f"{comparison['peer']}, {way}", " ".join(f"{rate:,.0f}" for rate in rates), "")
        for seeds, rate in comparison["our_steps_per_second"].items():
            ours = f"ours: {comparison['our_method']} on {comparison['task']}, {seeds} seed(s)"
            table.add_row(ours, f"{rate:,.0f}", f"{comparison['ratio'][seeds]:.1f}")
        table.add_section()
    show(table)


def run(arguments: argparse.Namespace) -> None:
    """Measures all rows, prints and writes them."""
    if arguments.row is not None:
        setting = begin_row(arguments.row)
        from experiments.speed import measuring  # imports JAX

        if arguments.profile:
            from experiments.speed import profiling

            print(json.dumps(profiling.profile(measuring.Setting(**setting))))
        else:
            print(json.dumps(measuring.measure(measuring.Setting(**setting))))
        return
    settings = settings_of(arguments)
    if arguments.jobs > 1 and (arguments.profile or arguments.peers):
        raise UsageError("--jobs: neither --profile nor --peers takes turns; leave it out")
    pythons = peers.find_pythons(arguments.peers) if arguments.peers else None
    command_line.check_new_file(arguments.out, "--out", overwrite=arguments.overwrite)
    command_line.check_writable(arguments.out.parent, "--out")
    facts = facts_of_machine()
    rows: list[dict[str, Any]] = []
    if pythons:
        compared = peers.compare(pythons, lambda peer, seeds: measure_row(_beside(settings[0], peer, seeds)))
        rows = [row for comparison in compared for row in comparison.pop("our_rows")]
        run_folder.write_json(arguments.out, {**facts, "rows": rows, "peers": compared})
        print_peers(compared)
        settings = []
    failures, measured = [], {}
    for index, row in _measured(settings, arguments.jobs, ["--profile"] if arguments.profile else []):
        if isinstance(row, UsageError):
            failures.append(str(row))
            continue
        measured[index] = row
        rows = [measured[i] for i in sorted(measured)]
        run_folder.write_json(arguments.out, {**facts, "rows": rows})  # what is measured is kept if the rest is not
    if rows and arguments.profile:
        print_profiles(rows)
    elif rows:
        print_rows(rows)
    if failures:
        raise UsageError("; ".join(failures))
    print(f"written to {arguments.out}")


def _measured(
    settings: Sequence[dict[str, Any]], jobs: int, options: Sequence[str]
) -> Iterator[tuple[int, dict[str, Any] | UsageError]]:
    """Each setting's index and row, or why it has none, as they come; `jobs` of them compile side by side."""

    def measure(setting: dict[str, Any]) -> dict[str, Any] | UsageError:
        print(f"measuring {_name(setting)} ...", file=sys.stderr, flush=True)
        try:
            row = measure_row(setting, "benchmark", *options)
        except UsageError as error:
            return error
        print(f"measured {_name(setting)}", file=sys.stderr, flush=True)
        return row

    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        turns = {"turns": str(Path(folder) / "turns")} if jobs > 1 else {}
        coming = {pool.submit(measure, {**setting, **turns}): i for i, setting in enumerate(settings)}
        for row in as_completed(coming):
            yield coming[row], row.result()


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
