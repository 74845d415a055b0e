"""Evaluates every seed of a trained run: return and cost over fresh episodes, in our simulator or the original one.

The result file keeps all evaluations: the newest of each simulator under the simulator's name, older ones under
`earlier`. With --record, the policy of one seed is also recorded as demonstrations, as `expert` does it. With --export,
the policies of all seeds are also written to files that other programs can use.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import save_demonstrations
from envs.registry import TaskInfo
from experiments.cli import command_line, xla
from experiments.cli.command_line import Parser, UsageError
from experiments.policies import evaluating
from experiments.policies.evaluating import Loaded, Settings
from experiments.policies.numpy_policy import is_known
from experiments.runs import evaluations, recording, run_folder, summary
from experiments.runs.run_folder import Run

_NUM_TRAJECTORIES = 10  # to record, unless said otherwise


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("evaluate", __doc__ or "")
    parser.add_argument("run", type=Path, metavar="RUN_DIR", help="folder that `train` or `expert` wrote")
    parser.add_argument(
        "--episodes", default=50, type=command_line.positive, metavar="N", help="episodes per seed (default: 50)"
    )
    parser.add_argument(
        "--simulator",
        default="ours",
        choices=evaluations.SIMULATORS,
        help="ours, or gymnasium's own -v5 environments (one process, NumPy) (default: ours)",
    )
    parser.add_argument(
        "--deterministic", action="store_true", help="act with the mode of the policy instead of sampling"
    )
    parser.add_argument(
        "--seed", default=1, type=command_line.natural, metavar="N", help="of the episodes (default: 1)"
    )
    parser.add_argument(
        "--shared-episodes",
        action="store_true",
        help="all seeds play the same starts, layouts and noise, for paired comparisons (default: each seed its own)",
    )
    parser.add_argument(
        "--export",
        nargs="+",
        default=[],
        type=Path,
        metavar="FILE",
        help="also write the policies of all seeds: as NumPy arrays, together with the results of these episodes "
        "(.npz), or as a StableHLO program (.stablehlo)",
    )
    parser.add_argument(
        "--record",
        type=Path,
        metavar="FILE.npz",
        help="also record demonstrations by the policy of one seed, in our simulator and with sampled actions",
    )
    parser.add_argument(
        "--seed-index",
        type=command_line.natural,
        metavar="N",
        help="the seed to record (default: as `expert` chooses, the one with the highest return among those within the "
        "cost limit)",
    )
    parser.add_argument(
        "--num-trajectories",
        type=command_line.positive,
        metavar="K",
        help=f"episodes to record (default: {_NUM_TRAJECTORIES})",
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
    """Checks everything, plays the episodes, writes the results and prints them."""
    if not arguments.run.is_dir():
        raise UsageError(f"RUN_DIR {arguments.run}: no such folder; give a folder that `train` wrote")
    stored = run_folder.read_run(arguments.run)
    task = run_folder.task_of(stored)
    checkpoints = arguments.run / "checkpoints"
    if not checkpoints.is_dir() or not any(checkpoints.iterdir()):
        raise UsageError(f"RUN_DIR {arguments.run}: holds no checkpoint; train first, or resume with `train --resume`")
    path = arguments.out or arguments.run / "evaluation.json"
    evaluations.read(path)
    if arguments.simulator == "original":
        check_original(task)
    check_policy(arguments, stored.config)
    files = check_files(arguments, path)
    described = describe_recording(arguments, stored)
    for option, file in files:
        command_line.check_writable(file.parent, option)
    xla.spread_seeds(stored.facts["num_seeds"])
    loaded, settings = evaluating.load(stored), _settings(arguments)
    episodes = evaluating.play(loaded, settings)
    _export(arguments.export, loaded, episodes, evaluating.facts_of(loaded, settings))
    if described:
        _record(arguments, loaded, described)
    content, reference = evaluating.judge(loaded, settings, episodes)
    title = (
        f"{stored.config.method} on {task.name}, {arguments.episodes} episodes per seed, "
        f"{arguments.simulator} simulator"
    )
    summary.print_table(title, content["per_seed"], content["aggregate"], reference)
    evaluations.add(path, content)
    print(f"written to {path}")


def check_original(task: TaskInfo) -> None:
    """Raises `UsageError` where a task has no original simulator that runs beside this package."""
    if task.original_package == "safety_gymnasium":
        raise UsageError(
            "--simulator original: safety-gymnasium needs an environment of its own; use --export FILE and run there "
            "`python tests/golden/run_policy.py FILE`"
        )
    if task.original is None or task.original_package is None:
        raise UsageError(f"--simulator original: task {task.name} has no original in gymnasium; leave it out")


def check_policy(arguments: argparse.Namespace, config: Config) -> None:
    """Raises `UsageError` where a policy of the user's own would have to be computed in NumPy."""
    if is_known(config):
        return
    reason = f"method {config.method} has a policy of its own, which only JAX can compute"
    if arguments.simulator == "original":
        raise UsageError(f"--simulator original: {reason}; leave it out")
    for file in arguments.export:
        if file.suffix == ".npz":
            raise UsageError(f"--export {file}: {reason}; give a file named *.stablehlo")


def check_files(arguments: argparse.Namespace, path: Path) -> list[tuple[str, Path]]:
    """The files that are to be written, each with its option: the result file `path`, then --export and --record.

    Raises:
        UsageError: a file's name has an unknown ending, or the file would replace another.
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
    """The metadata of the demonstrations that are to be recorded, such as `seed_index`; None without --record.

    Raises:
        UsageError: there is nothing that could be recorded, or an option does not go with --record.
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
    seed_index = recording.find_seed(stored, finished["per_seed"], arguments.seed_index)
    command = "\n".join([stored.facts["command"], command_line.command()])
    return recording.facts(stored, finished, seed_index, command)


def _settings(arguments: argparse.Namespace) -> Settings:
    return Settings(
        simulator=arguments.simulator,
        num_episodes=arguments.episodes,
        seed=arguments.seed,
        deterministic=arguments.deterministic,
        shared_episodes=arguments.shared_episodes,
    )


def _export(files: Sequence[Path], loaded: Loaded, episodes: Any, facts: dict[str, Any]) -> None:
    from experiments.policies import exporting  # imports JAX

    for file in files:
        if file.suffix == ".npz":
            exporting.export_numpy(file, loaded.config, loaded.actor, loaded.env, episodes, facts)
        else:
            exporting.export_stablehlo(file, loaded.config, loaded.actor, loaded.env)
        print(f"policies {file}")


def _record(arguments: argparse.Namespace, loaded: Loaded, described: Mapping[str, Any]) -> None:
    demonstrations = recording.record(
        loaded.config,
        loaded.actor,
        loaded.env,
        num_trajectories=arguments.num_trajectories or _NUM_TRAJECTORIES,
        episode_seed=(arguments.seed + 1) % 2**32,  # other episodes than those that judge the policy
        facts=described,
    )
    save_demonstrations(arguments.record, demonstrations)
    recording.print_demonstrations(demonstrations, arguments.record)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
