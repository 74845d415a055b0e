"""What `sweep` and `ablations` share: their options, and training the variants that are not finished yet."""

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.cli import command_line
from experiments.cli.command_line import Parser, UsageError
from experiments.runs import run_folder
from experiments.runs.provenance import provenance
from experiments.sweeps import backends, machine, variants
from experiments.sweeps.variants import Job, Variant

_INTERRUPTED = 130  # exit status after Ctrl-C, by the convention of shells: 128 plus the signal


def add_options(parser: Parser) -> None:
    """Adds the options that say where and how programs are carried out, and where the results go."""
    default = max(1, len(machine.usable_cpus()) // 2)
    parser.add_argument(
        "--workers",
        type=command_line.positive,
        default=default,
        metavar="N",
        help=f"programs at a time; those on one machine share its CPUs (default: one per two CPUs, {default} here)",
    )
    parser.add_argument(
        "--launcher",
        choices=tuple(backends.BACKENDS),
        default="processes",
        help="where the programs run (default: processes)",
    )
    for name, backend in backends.BACKENDS.items():
        if backend.settings:
            parser.add_argument(
                f"--{name}", nargs="+", type=_setting, default=[], metavar="NAME=VALUE", help=backend.settings
            )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for runs, table and figure")
    parser.add_argument("--resume", action="store_true", help="finish what is missing in --out")


def option_names() -> tuple[str, ...]:
    """Names of the options that `add_options` adds, as attributes of the parsed arguments."""
    return ("workers", "launcher", "out", "resume", *_with_settings())


def _with_settings() -> list[str]:
    return [name for name, backend in backends.BACKENDS.items() if backend.settings]


def _settings(arguments: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """The settings that were given, by the name of the launcher that they belong to."""
    return {name: dict(getattr(arguments, name)) for name in _with_settings()}


def _setting(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not (name.isidentifier() and equals):
        raise argparse.ArgumentTypeError(f"{text!r}: give NAME=VALUE")
    return name, int(value) if value.isdigit() else value


def carry_out(chosen: Sequence[Variant], arguments: argparse.Namespace, record: str, choices: Mapping[str, Any]) -> int:
    """Trains what is not finished yet; returns how many programs failed.

    Args:
        chosen: all variants.
        arguments: of the command line, with those of `add_options`.
        record: name of the file in --out that keeps `choices`.
        choices: what the study compares. With --resume they must be the same as in `record`.

    Raises:
        UsageError: something is wrong; nothing has been started.
    """
    out: Path = arguments.out
    backends.check_launcher(arguments.launcher)
    backends.check_settings(arguments.launcher, _settings(arguments))
    command_line.check_output_folder(out, resume=arguments.resume, record=record)
    if arguments.resume:
        _check_choices(out / record, choices)
    for variant in chosen:
        variants.check_unchanged(variant)
    all_jobs = variants.group(chosen, out)
    # A job keeps its finished variants too: what is missing goes on from checkpoints that hold all of them.
    jobs = [job for job in all_jobs if not all(variant.finished for variant in job.variants)]
    num_runs = sum(variant.plan.setup.num_seeds for variant in chosen)
    done = f", {len(jobs)} of them unfinished" if arguments.resume else ""
    print(f"{len(chosen)} variants, {num_runs} runs, in {len(all_jobs)} programs{done}", flush=True)
    run_folder.write_json(out / record, {**provenance(), "choices": choices})
    for job in jobs:
        variants.write_job(job)
    return _wait(jobs, arguments)


def _check_choices(path: Path, choices: Mapping[str, Any]) -> None:
    saved = run_folder.read_json(path).get("choices", {})
    for name in {**saved, **choices}:
        if saved.get(name) != choices.get(name):
            raise UsageError(
                f"--resume: {name} is {choices.get(name)!r}, but {saved.get(name)!r} in {path}; choose another --out"
            )


def _wait(jobs: Sequence[Job], arguments: argparse.Namespace) -> int:
    start, num_failed = time.monotonic(), 0
    by_folder = {job.folder.resolve(): job for job in jobs}  # a worker may be started in another folder
    launcher = arguments.launcher
    settings, logs = _settings(arguments).get(launcher, {}), arguments.out / launcher
    outcomes = backends.BACKENDS[launcher].launch(list(by_folder), arguments.workers, logs, settings)
    try:
        for i, (folder, failure) in enumerate(outcomes, 1):
            names = " ".join(variant.name for variant in by_folder[folder].variants)
            state = "done" if failure is None else f"FAILED ({failure})"
            print(f"[{i}/{len(jobs)}] {time.monotonic() - start:,.0f} s: {names}: {state}", flush=True)
            num_failed += failure is not None
    except KeyboardInterrupt:
        print("stopped; continue with --resume", file=sys.stderr)
        raise SystemExit(_INTERRUPTED) from None
    return num_failed
