"""Rows of a benchmark: each setting is measured in a process of its own."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from experiments.cli import interruption, xla
from experiments.cli.command_line import UsageError
from experiments.cli.subprocesses import python_path
from experiments.runs.provenance import provenance


def measure_row(setting: dict[str, Any], launcher: str = "benchmark", *options: str) -> dict[str, Any]:
    """Measures one setting in a process of its own.

    Args:
        setting: the fields of a `measuring.Setting`.
        launcher: the launcher that is started for it; its `--row` calls `begin_row`.
        *options: of that launcher.

    Returns:
        What the process has printed last, a JSON object.

    Raises:
        UsageError: the process failed; the message has the last line of its errors.
    """
    command = [sys.executable, "-P", "-m", f"experiments.{launcher}", *options, "--row", json.dumps(setting)]
    # The compilation is measured, so nothing may come from a cache.
    environment = {**os.environ, "PYTHONPATH": python_path(), "JAX_ENABLE_COMPILATION_CACHE": "false"}
    if setting.get("turns"):  # an accelerator's memory is shared
        environment.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    ears, mouth = os.pipe()  # the pipe closes when this process ends, and then the row's process ends too
    with open(ears, "rb") as stdin, open(mouth, "wb"):
        done = subprocess.run(command, stdin=stdin, capture_output=True, text=True, check=False, env=environment)
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or [f"exit status {done.returncode}"]
        raise UsageError(f"{_name(setting)}: cannot be measured: {last[0]}")
    row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return row


def begin_row(text: str) -> dict[str, Any]:
    """In a row's own process: prepares it as a training would be, and returns the setting that it is to measure."""
    interruption.stop_at_eof()
    setting: dict[str, Any] = json.loads(text)
    xla.spread_seeds(setting["num_seeds"])
    return setting


def _name(setting: Mapping[str, Any]) -> str:
    size = f"{setting['num_seeds']} x {setting['num_envs']}"
    return f"{setting['task']} ({setting['physics']}), {size}"


def facts_of_machine() -> dict[str, Any]:
    """What is written down with all measurements: the program and the state of the machine."""
    return {
        **provenance(),
        "cpus": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load_average": os.getloadavg(),
    }


def measure_rows(
    settings: Sequence[dict[str, Any]], jobs: int, options: Sequence[str]
) -> Iterator[tuple[int, dict[str, Any] | UsageError]]:
    """Measures all settings; `jobs` of them compile side by side, but only one is measured at a time.

    Yields the index of a setting and its row, or the error because of which it has none, in the order of completion.
    """

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
