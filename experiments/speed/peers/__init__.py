"""Trainers of other packages, each in a virtual environment of its own, compared with ours.

The scripts of this folder run in those environments and import nothing of ours.
"""

import dataclasses
import json
import os
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.command_line import UsageError

_FOLDER = Path(__file__).parent
_TIME_LIMIT = 600.0  # seconds for one way of running a peer


@dataclasses.dataclass(frozen=True)
class Peer:
    """The trainer of a package, the ways to run it, and the task and method of ours that do the same work."""

    title: str
    script: str
    ways: Mapping[str, tuple[str, ...]]  # arguments of the script
    task: str
    method: str


def _imitation(*arguments: str) -> tuple[str, ...]:
    return (str(_FOLDER.parents[1] / "demonstrations" / "HalfCheetah.npz"), *arguments, "20")


_CORES = str(os.cpu_count() or 1)
PEERS: Mapping[str, Peer] = {
    "imitation": Peer(
        title="imitation: GAIL with Stable-Baselines3's PPO",
        script="imitation_gail.py",
        ways={
            "8 simulations in turn, 1 thread": _imitation("8", "dummy", "1"),
            "8 processes, 1 thread": _imitation("8", "subproc", "1"),
            "8 simulations in turn, a thread per core": _imitation("8", "dummy", _CORES),
        },
        task="HalfCheetah",
        method="gail",
    ),
    "omnisafe": Peer(
        title="OmniSafe: TRPOLag",
        script="omnisafe_trpo_lag.py",
        ways={
            "1 simulation, 1 thread": ("1", "1", "6"),
            "4 processes, 1 thread": ("4", "1", "6"),
            "1 simulation, a thread per core": ("1", _CORES, "6"),
        },
        task="PointGoal1",
        method="expert",
    ),
}


def find_pythons(folder: Path) -> dict[str, Path]:
    """The interpreter of each peer's environment below `folder`. Raises `UsageError` where one is missing."""
    found = {name: folder / name / "bin" / "python" for name in PEERS}
    for name, python in found.items():
        if not python.exists():
            raise UsageError(
                f"--peers {folder}: no {name}/bin/python; make the environments as docs/performance.md says"
            )
    return found


def compare(pythons: Mapping[str, Path], measure: Callable[[Peer, int], dict[str, Any]]) -> list[dict[str, Any]]:
    """Measures the speed of each peer in every way, and of ours with 1 and 8 seeds.

    Each peer is timed before ours and once more after it, so that a change of the machine's speed shows; the median of
    both counts.

    Args:
        pythons: the interpreter of each peer's environment.
        measure: measures ours for a peer and a number of seeds.

    Raises:
        UsageError: a peer fails in every way.
    """
    rows = []
    for name, peer in PEERS.items():
        first = {way: _time(peer, pythons[name], arguments) for way, arguments in peer.ways.items()}
        if all("error" in run for run in first.values()):
            error = next(iter(first.values()))["error"]
            raise UsageError(f"--peers: {peer.script} in {pythons[name]} failed: {error}")
        ours = {seeds: measure(peer, seeds) for seeds in (1, 8)}
        second = {way: _time(peer, pythons[name], arguments) for way, arguments in peer.ways.items()}
        ways = {way: [run[way]["steps_per_second"] for run in (first, second)] for way in peer.ways}
        errors = {way: run[way]["error"] for run in (first, second) for way in peer.ways if "error" in run[way]}
        best = max(float(np.median([rate for rate in rates if rate] or [0.0])) for rates in ways.values())
        rates = {seeds: row["training_steps_per_second"] for seeds, row in ours.items()}
        versions: dict[str, str] = next((run["versions"] for run in first.values() if run["versions"]), {})
        rows.append(
            {
                "peer": peer.title,
                "task": peer.task,
                "our_method": peer.method,
                "ways": ways,
                "errors": errors,
                "best_steps_per_second": best,
                "our_steps_per_second": rates,
                "ratio": {seeds: rate / best for seeds, rate in rates.items()},
                "versions": versions,
                "our_rows": list(ours.values()),
            }
        )
    return rows


def _time(peer: Peer, python: Path, arguments: tuple[str, ...]) -> dict[str, Any]:
    """What the script prints. If it fails or takes too long, the rate is 0 and `error` says why."""
    command = [str(python.absolute()), str(_FOLDER / peer.script), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_TIME_LIMIT)
    except subprocess.TimeoutExpired:
        return {"steps_per_second": 0.0, "versions": {}, "error": f"not done after {_TIME_LIMIT:.0f} s"}
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        return {"steps_per_second": 0.0, "versions": {}, "error": last}
    printed: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return printed
