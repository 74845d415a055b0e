"""Evaluates every seed of a trained run: return and cost over fresh episodes, in our simulator or the original one."""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ccil_jax.versions import versions
from envs.registry import TASKS
from experiments import command_line, run_folder, summary
from experiments.command_line import Parser, UsageError
from experiments.run_folder import Run


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
        choices=("ours", "original"),
        help="ours, or gymnasium's own -v5 environments (one process, NumPy) (default: ours)",
    )
    parser.add_argument("--deterministic", action="store_true", help="act with the mode instead of sampling")
    parser.add_argument(
        "--seed", default=1, type=command_line.natural, metavar="N", help="of the episodes (default: 1)"
    )
    parser.add_argument(
        "--export",
        nargs="+",
        default=[],
        type=Path,
        metavar="FILE",
        help="also write the policies: with these episodes as NumPy arrays (.npz), or as a program (.stablehlo)",
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="result file (default: RUN_DIR/evaluation.json)")
    return parser


def run(arguments: argparse.Namespace) -> None:
    """Checks, evaluates, writes and prints."""
    if not arguments.run.is_dir():
        raise UsageError(f"RUN_DIR {arguments.run}: no such folder; give a folder that `train` wrote")
    stored = run_folder.read_run(arguments.run)
    checkpoints = arguments.run / "checkpoints"
    if not checkpoints.is_dir() or not any(checkpoints.iterdir()):
        raise UsageError(f"RUN_DIR {arguments.run}: holds no checkpoint; train first, or resume with `train --resume`")
    path = arguments.out or arguments.run / "evaluation.json"
    command_line.check_writable(path.parent, "--out")
    for file in arguments.export:
        if file.suffix not in (".npz", ".stablehlo"):
            raise UsageError(f"--export {file}: unknown kind of file; end its name with .npz or .stablehlo")
        command_line.check_writable(file.parent, "--export")
    if arguments.simulator == "original" and TASKS[stored.facts["task"]].family == "safety_gym":
        raise UsageError(
            "--simulator original: safety-gymnasium needs an environment of its own; use --export FILE and run there "
            "`python tests/golden/run_policy.py FILE`"
        )
    earlier = run_folder.read_json(path) if path.is_file() else {}
    content, reference = evaluate_run(stored, arguments)
    run_folder.write_json(path, {**earlier, arguments.simulator: content})
    title = (
        f"{stored.config.method} on {stored.facts['task']}, {arguments.episodes} episodes per seed, "
        f"{arguments.simulator} simulator"
    )
    summary.print_table(title, content["per_seed"], content["aggregate"], reference)
    print(f"written to {path}")


def evaluate_run(stored: Run, arguments: argparse.Namespace) -> tuple[dict[str, Any], summary.Reference]:
    """Runs the episodes. Returns the content of the result file and the levels to compare with."""
    import envs  # imports JAX: not before the input has been checked
    from ccil_jax import evaluation, runner
    from experiments import exporting, original

    env = envs.make(stored.facts["task"], physics=stored.facts["physics"], **stored.facts["env_options"])
    loaded = runner.load(stored.config, env, stored.folder.resolve() / "checkpoints", stored.facts["num_seeds"])
    settings: dict[str, Any] = {
        "num_episodes": arguments.episodes,
        "seed": arguments.seed,
        "deterministic": arguments.deterministic,
    }
    if arguments.simulator == "ours":
        evaluated: Any = evaluation.evaluate(loaded.config, loaded.agent, env, **settings)
    else:
        contact_cost = stored.facts["env_options"]["contact_cost"]
        evaluated = original.evaluate(loaded.config, loaded.agent, env, contact_cost=contact_cost, **settings)
    facts = {"task": env.name, "original": TASKS[env.name].original, "simulator": arguments.simulator, **settings}
    for file in arguments.export:
        if file.suffix == ".npz":
            exporting.export_numpy(file, loaded.config, loaded.agent, env, evaluated, facts)
        else:
            exporting.export_stablehlo(file, loaded.config, loaded.agent, env)
        print(f"policies {file}")
    random = evaluation.random_policy(env, num_episodes=arguments.episodes, seed=arguments.seed)
    reference = summary.make_reference(stored.facts, random, stored.config.prescribed_limit)
    rows = summary.per_seed_scores(evaluated, None, reference)
    return {
        **settings,
        "command": command_line.command(),
        "versions": versions(),
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
