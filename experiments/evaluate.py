"""Evaluates every seed of a trained run: return and cost over fresh episodes, in our simulator or the original one.

With --policy, the policies of a file are evaluated in place of a run's: one that --export wrote, or a shipped expert.
The result file keeps all evaluations: the newest of each simulator under the simulator's name, older ones under
`earlier`. With --record, the policy of one seed is also recorded as demonstrations, as `expert` does it. With --export,
the policies of all seeds, or that of --seed-index, are also written to files that other programs can use. With --video,
an episode of one seed is also drawn; no display and no renderer is needed.
"""

import argparse
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import save_demonstrations
from envs.registry import TaskInfo
from experiments.cli import command_line, waiting, xla
from experiments.cli.command_line import Parser, UsageError
from experiments.page import video
from experiments.policies import evaluating, sources
from experiments.policies.evaluating import Loaded, Settings
from experiments.policies.numpy_policy import is_known
from experiments.policies.sources import Source
from experiments.runs import demonstration_files, evaluations, recording, summary

_NUM_TRAJECTORIES = 10  # to record, unless said otherwise


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("evaluate", __doc__ or "")
    parser.add_argument("run", nargs="?", type=Path, metavar="RUN_DIR", help="folder that `train` or `expert` wrote")
    parser.add_argument(
        "--policy",
        type=Path,
        metavar="FILE.npz",
        help="evaluate the policies of this file, which --export wrote, or that of a shipped expert by the name of its "
        "task; in place of RUN_DIR",
    )
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
        "--deterministic",
        action=argparse.BooleanOptionalAction,
        help="act with the mode of the policy, or sample with --no-deterministic (default: as the training's "
        "--evaluated-action says)",
    )
    parser.add_argument(
        "--seed", default=1, type=command_line.natural, metavar="N", help="of the episodes (default: 1)"
    )
    parser.add_argument(
        "--shared-episodes",
        action="store_true",
        help="all seeds play the same starts, layouts and noise, for paired comparisons (default: each seed its own)",
    )
    _add_files(parser)
    return parser


def _add_files(parser: Parser) -> None:
    """Options of what is written."""
    parser.add_argument(
        "--export",
        nargs="+",
        default=[],
        type=Path,
        metavar="FILE",
        help="also write the policies of all seeds, or that of --seed-index: as NumPy arrays, together with the "
        "results of these episodes (.npz), as an ONNX model (.onnx), or as a StableHLO program (.stablehlo)",
    )
    parser.add_argument(
        "--record",
        type=Path,
        metavar="FILE",
        help="also record demonstrations by the policy of one seed, in our simulator and acting as it is evaluated, as "
        f"{demonstration_files.TO_WRITE}",
    )
    parser.add_argument(
        "--video",
        type=Path,
        metavar="FILE",
        help="also write a video of an episode in our simulator, with running return and cost: FILE.gif, or FILE.mp4 "
        "with the package imageio-ffmpeg",
    )
    parser.add_argument(
        "--seed-index",
        type=command_line.natural,
        metavar="N",
        help="the seed to record, to export and to show (default: --export writes all; --record chooses as `expert` "
        "does, the seed with the highest return among those within the cost limit; --video shows the seed with the "
        "highest return)",
    )
    parser.add_argument(
        "--num-trajectories",
        type=command_line.positive,
        metavar="K",
        help=f"episodes to record (default: {_NUM_TRAJECTORIES})",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace existing files of --export, --record and --video"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="result file, which keeps earlier results (default: RUN_DIR/evaluation.json; none for --policy)",
    )


def run(arguments: argparse.Namespace) -> None:
    """Checks everything, plays the episodes, writes the results and prints them."""
    if (arguments.run is None) == (arguments.policy is None):
        raise UsageError("RUN_DIR: give the folder of a run, or --policy FILE.npz; one of the two")
    source = sources.of_run(arguments.run) if arguments.run else sources.of_file(arguments.policy)
    path = arguments.out or (arguments.run / "evaluation.json" if arguments.run else None)
    if path:
        evaluations.read(path)
    if arguments.simulator == "original":
        check_original(source.task)
    check_policy(arguments, source.config)
    files = check_files(arguments, path)
    check_recording(arguments, source)
    check_video(arguments)
    for option, file in files:
        demonstration_files.check_writable(file, option)
    xla.spread_seeds(len(source.seeds))
    env = source.build()
    if arguments.video:
        check_drawing(arguments.video, source.task.name, env)
    loaded, settings = source.load(env), _settings(arguments, source.config)
    unit = "steps" if arguments.simulator == "ours" else "episodes"
    with waiting.progress("evaluating", unit) as on_progress:
        episodes = evaluating.play(loaded, settings, on_progress)
    print("evaluating the random policy ...", file=sys.stderr, flush=True)
    content, reference = evaluating.judge(loaded, settings, episodes)
    _export(arguments, loaded, episodes, settings)
    if arguments.record:
        _record(arguments, source, loaded, content)
    if arguments.video:
        _write_video(arguments, source, loaded, content)
    title = f"{source.title}, {arguments.episodes} episodes per seed, {arguments.simulator} simulator"
    summary.print_table(title, content["per_seed"], content["aggregate"], reference)
    if path:
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
        if file.suffix in (".npz", ".onnx"):
            raise UsageError(f"--export {file}: {reason}; give a file named *.stablehlo")


def check_files(arguments: argparse.Namespace, path: Path | None) -> list[tuple[str, Path]]:
    """The files that are to be written, each with its option: the result file `path`, if any, then all others.

    Raises:
        UsageError: a file's name has an unknown ending, or the file would replace another.
    """
    for file in arguments.export:
        if file.suffix not in (".npz", ".onnx", ".stablehlo"):
            raise UsageError(f"--export {file}: unknown kind of file; end its name with .npz, .onnx or .stablehlo")
        if file.suffix == ".onnx" and importlib.util.find_spec("onnx") is None:
            raise UsageError(f"--export {file}: needs the package onnx; `pip install 'ccil_jax[onnx]'`")
    if arguments.video:
        video.check(arguments.video, "--video")
    written = [("--export", file) for file in arguments.export]
    written += [("--record", arguments.record)] if arguments.record else []
    written += [("--video", arguments.video)] if arguments.video else []
    if arguments.overwrite and not written:
        raise UsageError("--overwrite: for files of --export, --record and --video; none is given, leave it out")
    results = [("--out", path)] if path else []
    taken = {path.resolve() for _, path in results}
    for option, file in written:
        if file.resolve() in taken:
            raise UsageError(f"{option} {file}: two results would go into this file; give each a name of its own")
        taken.add(file.resolve())
        check = demonstration_files.check_new if option == "--record" else command_line.check_new_file
        check(file, option, overwrite=arguments.overwrite)
    return [*results, *written]


def check_recording(arguments: argparse.Namespace, source: Source) -> None:
    """Raises `UsageError` where there is nothing to record, or an option does not go with --record."""
    if arguments.record is None:
        if arguments.num_trajectories is not None:
            raise UsageError(
                f"--num-trajectories {arguments.num_trajectories}: says what to record; add --record FILE.npz"
            )
        if arguments.seed_index is not None and not arguments.export and not arguments.video:
            raise UsageError(
                f"--seed-index {arguments.seed_index}: says what to record, export or show; add --record FILE.npz, "
                "--export FILE.npz or --video FILE.gif"
            )
    if arguments.record and arguments.deterministic is not None:
        option = "--deterministic" if arguments.deterministic else "--no-deterministic"
        raise UsageError(
            f"{option}: demonstrations are recorded as the training's --evaluated-action says; leave one of the two out"
        )
    if arguments.record and arguments.simulator == "original":
        raise UsageError("--simulator original: demonstrations are recorded in ours; leave one of the two out")
    if arguments.seed_index is not None and arguments.seed_index not in source.seeds:
        known = ", ".join(map(str, source.seeds))
        raise UsageError(f"--seed-index {arguments.seed_index}: there is no such seed; give one of {known}")
    if arguments.record and source.run:
        recording.find_seed(source.run, recording.read_summary(source.run)["per_seed"], arguments.seed_index)


def check_video(arguments: argparse.Namespace) -> None:
    """Raises `UsageError` where the episodes of a video would not be played in our simulator."""
    if arguments.video and arguments.simulator == "original":
        raise UsageError("--simulator original: videos are made in ours; leave one of the two out")


def check_drawing(file: Path, task: str, env: Any) -> None:
    """Raises `UsageError` where `env`, an environment of `task`, cannot be drawn, or the encoder is missing."""
    from experiments.page import film  # imports MuJoCo

    if reason := film.obstacle(env):
        raise UsageError(
            f"--video {file}: task {task} cannot be drawn, because {reason}; leave it out, or let --record FILE.npz "
            "write its episodes as numbers"
        )
    video.check_encoder(file, "--video")


def describe_recording(
    arguments: argparse.Namespace, source: Source, loaded: Loaded, content: Mapping[str, Any]
) -> dict[str, Any]:
    """The metadata of the demonstrations that are to be recorded, such as `seed_index`.

    A run was evaluated when it was trained, and its summary.json says how well its seeds do. The policies of a file are
    described by `content`, the evaluation of this process.
    """
    if source.run:
        scores = recording.read_summary(source.run)
        num_episodes = scores.get("evaluation", {}).get("num_episodes")
        chosen = recording.find_seed(source.run, scores["per_seed"], arguments.seed_index)
    else:
        rows = [{**row, "seed": seed} for row, seed in zip(content["per_seed"], source.seeds, strict=True)]
        scores, num_episodes = {**content, "per_seed": rows}, arguments.episodes
        chosen = source.seeds[0] if arguments.seed_index is None else arguments.seed_index
    trained = {name: value for name, value in loaded.training.items() if name != "seed_indices"}
    made_by = f"{loaded.command}\n{command_line.command()}"
    return recording.facts(trained, scores, chosen, num_episodes, made_by)


def _settings(arguments: argparse.Namespace, config: Config) -> Settings:
    return Settings(
        simulator=arguments.simulator,
        num_episodes=arguments.episodes,
        seed=arguments.seed,
        deterministic=config.acts_by_mode(arguments.deterministic),
        shared_episodes=arguments.shared_episodes,
    )


def _export(arguments: argparse.Namespace, loaded: Loaded, episodes: Any, settings: Settings) -> None:
    from experiments.policies import exporting  # imports JAX

    if arguments.export and arguments.seed_index is not None:
        index = loaded.training["seed_indices"].index(arguments.seed_index)
        loaded, episodes = loaded.only(index), evaluating.only(episodes, index)
    for file in arguments.export:
        if file.suffix == ".npz":
            exporting.export_numpy(
                file, loaded.config, loaded.actor, loaded.env, episodes, evaluating.facts_of(loaded, settings)
            )
        elif file.suffix == ".onnx":
            exporting.export_onnx(file, loaded.config, loaded.actor, loaded.env)
        else:
            exporting.export_stablehlo(file, loaded.config, loaded.actor, loaded.env)
        print(f"policies {file}")


def _record(arguments: argparse.Namespace, source: Source, loaded: Loaded, content: Mapping[str, Any]) -> None:
    described = describe_recording(arguments, source, loaded, content)
    demonstrations = recording.record(
        loaded.config,
        loaded.actor,
        loaded.env,
        num_trajectories=arguments.num_trajectories or _NUM_TRAJECTORIES,
        episode_seed=(arguments.seed + 1) % 2**32,  # other episodes than those that judge the policy
        seed_index=loaded.training["seed_indices"].index(described["seed_index"]),
        facts=described,
    )
    save_demonstrations(arguments.record, demonstrations)
    recording.print_demonstrations(demonstrations, arguments.record)


def _write_video(arguments: argparse.Namespace, source: Source, loaded: Loaded, content: Mapping[str, Any]) -> None:
    from experiments.page import film  # imports MuJoCo

    rows = content["per_seed"]
    index = max(range(len(rows)), key=lambda i: rows[i]["episode_return"])
    if arguments.seed_index is not None:
        index = source.seeds.index(arguments.seed_index)
    recorded = film.record(loaded, index, seed=arguments.seed, deterministic=arguments.deterministic)
    title, limit = f"{source.title}, seed {source.seeds[index]}", loaded.training["cost_limit"]
    with waiting.progress("drawing", "frames") as on_progress:
        video.write(arguments.video, recorded, title, cost_limit=limit, on_progress=on_progress)
    print(f"video    {arguments.video}")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
