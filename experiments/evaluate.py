"""Evaluates every seed of a trained run: return and cost over fresh episodes, in our simulator or the original one.

The result file keeps earlier evaluations: the newest in each simulator stands first, those before it under `earlier`.
With --record, one seed's policy is recorded as demonstrations too, as `expert` does; with --export, all seeds' policies
are written for other programs.
"""

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ccil_jax.demonstrations.trajectories import save_demonstrations
from envs.registry import TASKS
from experiments.cli import command_line, xla
from experiments.cli.command_line import Parser, UsageError
from experiments.runs import evaluations, recording, run_folder, summary
from experiments.runs.run_folder import Run

_NUM_TRAJECTORIES = 10  # to record, unless said otherwise


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("evaluate", __doc__ or "")
    parser.add_argument("run", type=Path, metavar="RUN_DIR", help="folder that `train` or `expert` wrote")
    parser.add_argument(
        "--episodes", default=50, type=command_line.positive, metavar="N", help="per seed (default: 50)"
    )
    parser.add_argument(
        "--simulator",
        default="ours",
        choices=evaluations.SIMULATORS,
        help="ours, or gymnasium's own -v5 environments (one process, NumPy) (default: ours)",
    )
    parser.add_argument("--deterministic", action="store_true", help="act with the mode instead of sampling")
    parser.add_argument(
        "--seed", default=1, type=command_line.natural, metavar="N", help="of the episodes (default: 1)"
    )
    parser.add_argument(
        "--shared-episodes",
        action="store_true",
        help="all seeds play the same starts, layouts and noise, for paired comparisons (default: each its own)",
    )
    parser.add_argument(
        "--export",
        nargs="+",
        default=[],
        type=Path,
        metavar="FILE",
        help="also write the policies: with these episodes as NumPy arrays (.npz), or as a program (.stablehlo)",
    )
    parser.add_argument(
        "--record",
        type=Path,
        metavar="FILE.npz",
        help="also record demonstrations of one seed's policy, in our simulator and sampling its actions",
    )
    parser.add_argument(
        "--seed-index",
        type=command_line.natural,
        metavar="N",
        help="the seed to record (default: that of the highest return within the cost limit, as `expert` chooses)",
    )
    parser.add_argument(
        "--num-trajectories", type=command_line.positive, metavar="K", help=f"to record (default: {_NUM_TRAJECTORIES})"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing files of --export and --record")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="result file, which keeps earlier results (default: RUN_DIR/evaluation.json)",
    )
    return parser


def run(arguments: argparse.Namespace) -> None:
    """Checks, evaluates, writes and prints."""
    if not arguments.run.is_dir():
        raise UsageError(f"RUN_DIR {arguments.run}: no such folder; give a folder that `train` wrote")
    stored = run_folder.read_run(arguments.run)
    if stored.facts["task"] not in TASKS:
        raise UsageError(f"RUN_DIR {arguments.run}: of task {stored.facts['task']}, which is not known here")
    checkpoints = arguments.run / "checkpoints"
    if not checkpoints.is_dir() or not any(checkpoints.iterdir()):
        raise UsageError(f"RUN_DIR {arguments.run}: holds no checkpoint; train first, or resume with `train --resume`")
    path = arguments.out or arguments.run / "evaluation.json"
    evaluations.read(path)
    if arguments.simulator == "original" and TASKS[stored.facts["task"]].family == "safety_gym":
        raise UsageError(
            "--simulator original: safety-gymnasium needs an environment of its own; use --export FILE and run there "
            "`python tests/golden/run_policy.py FILE`"
        )
    files = check_files(arguments, path)
    described = describe_recording(arguments, stored)
    for option, file in files:
        command_line.check_writable(file.parent, option)
    content, reference = evaluate_run(stored, arguments, described)
    title = (
        f"{stored.config.method} on {stored.facts['task']}, {arguments.episodes} episodes per seed, "
        f"{arguments.simulator} simulator"
    )
    summary.print_table(title, content["per_seed"], content["aggregate"], reference)
    evaluations.add(path, content)
    print(f"written to {path}")


def check_files(arguments: argparse.Namespace, path: Path) -> list[tuple[str, Path]]:
    """The files that are to be written, `path` among them, each with its option.

    Raises `UsageError` where one has an unknown form, or would replace another.
    """
    for file in arguments.export:
        if file.suffix not in (".npz", ".stablehlo"):
            raise UsageError(f"--export {file}: unknown kind of file; end its name with .npz or .stablehlo")
    if arguments.record and arguments.record.suffix != ".npz":
        raise UsageError(f"--record {arguments.record}: a demonstrations file is named *.npz")
    written = [("--export", file) for file in arguments.export]
    written += [("--record", arguments.record)] if arguments.record else []
    if arguments.overwrite and not written:
        raise UsageError("--overwrite: for files of --export and --record, and neither is given; leave it out")
    taken = {path.resolve()}
    for option, file in written:
        if file.resolve() in taken:
            raise UsageError(f"{option} {file}: two results would go into this file; give each a name of its own")
        taken.add(file.resolve())
        command_line.check_new_file(file, option, overwrite=arguments.overwrite)
    return [("--out", path), *written]


def describe_recording(arguments: argparse.Namespace, stored: Run) -> dict[str, Any] | None:
    """Metadata of the demonstrations, `seed_index` among them; None where none are to be recorded.

    Raises `UsageError` where it cannot be said what to record.
    """
    if arguments.record is None:
        for option, value in (("seed-index", arguments.seed_index), ("num-trajectories", arguments.num_trajectories)):
            if value is not None:
                raise UsageError(f"--{option} {value}: says what to record; add --record FILE.npz")
        return None
    if arguments.deterministic:
        raise UsageError("--deterministic: demonstrations are recorded from sampled actions; leave one of the two out")
    if arguments.simulator == "original":
        raise UsageError("--simulator original: demonstrations are recorded in ours; leave one of the two out")
    finished = recording.read_summary(stored)
    rows, seed_index = finished["per_seed"], arguments.seed_index
    if seed_index is None:
        limit = recording.cost_limit(stored)
        seed_index = recording.choose_seed(rows, limit)
        if seed_index is None:
            costs = ", ".join(f"seed {row['seed']}: {row['episode_cost']:g}" for row in rows)
            raise UsageError(
                f"--record: no seed keeps the cost limit {limit:g} ({costs}); choose one by --seed-index N"
            )
    if seed_index not in [row["seed"] for row in rows]:
        raise UsageError(f"--seed-index {seed_index}: the run has {len(rows)} seed(s); give 0 to {len(rows) - 1}")
    command = "\n".join([stored.facts["command"], command_line.command()])
    return recording.facts(stored, finished, seed_index, command)


def evaluate_run(
    stored: Run, arguments: argparse.Namespace, described: Mapping[str, Any] | None = None
) -> tuple[dict[str, Any], summary.Reference]:
    """Runs the episodes and writes policies and, where they are `described`, demonstrations.

    Returns the entry for the result file and the levels to compare with.
    """
    import envs  # imports JAX: not before the input has been checked
    from ccil_jax.acting import evaluation
    from ccil_jax.training import runner
    from experiments.policies import exporting, original_simulator

    xla.spread_seeds(stored.facts["num_seeds"])
    env = envs.make(stored.facts["task"], physics=stored.facts["physics"], **stored.facts["env_options"])
    loaded = runner.load(stored.config, env, stored.folder.resolve() / "checkpoints", stored.facts["num_seeds"])
    settings: dict[str, Any] = {
        "num_episodes": arguments.episodes,
        "seed": arguments.seed,
        "deterministic": arguments.deterministic,
    }
    recorded = {**settings, "shared_episodes": arguments.shared_episodes}
    draws = [0] * stored.facts["num_seeds"] if arguments.shared_episodes else None
    if arguments.simulator == "ours":
        evaluated: Any = evaluation.evaluate(loaded.config, loaded.actor, env, draws=draws, **settings)
    else:
        contact_cost = stored.facts["env_options"].get("contact_cost", True)
        evaluated = original_simulator.evaluate(
            loaded.config, loaded.actor, env, draws=draws, contact_cost=contact_cost, **settings
        )
    provenance = run_folder.provenance()
    facts = {
        "task": env.name,
        "original": TASKS[env.name].original,
        "simulator": arguments.simulator,
        **recorded,
        **provenance,
    }
    for file in arguments.export:
        if file.suffix == ".npz":
            exporting.export_numpy(file, loaded.config, loaded.actor, env, evaluated, facts)
        else:
            exporting.export_stablehlo(file, loaded.config, loaded.actor, env)
        print(f"policies {file}")
    if described:
        demonstrations = recording.record(
            loaded.config,
            loaded.actor,
            env,
            num_trajectories=arguments.num_trajectories or _NUM_TRAJECTORIES,
            episode_seed=(arguments.seed + 1) % 2**32,  # other episodes than those that judge the policy
            facts=described,
        )
        save_demonstrations(arguments.record, demonstrations)
        recording.print_demonstrations(demonstrations, arguments.record)
    random = evaluation.random_policy(env, num_episodes=arguments.episodes, seed=arguments.seed)
    reference = summary.make_reference(stored.facts, random, stored.config.prescribed_limit)
    rows = summary.per_seed_scores(evaluated, None, reference)
    return {
        "run": str(stored.folder.resolve()),
        "simulator": arguments.simulator,
        **recorded,
        **provenance,
        **dataclasses.asdict(reference),
        "per_seed": rows,
        "aggregate": summary.aggregate_scores(rows),
        "violation_beyond_error": summary.mean_violation_beyond_error(rows, reference),
    }, reference


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
