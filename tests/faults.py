"""The fault suite: real training processes are killed, signalled and damaged, and must end as undisturbed ones do.

    python tests/faults.py [--kills 50] [--signals 20]      about half an hour on one core

Every process is `experiments.train` on a probe task that compiles in seconds and saves several times a second. An
undisturbed run of each method tells how the others must end: the digest of every array of the last checkpoint (policy,
critics, discriminator, optimisers, multiplier, statistics, environments, keys) and metrics.csv, byte for byte. Prints
a table; the exit status is 1 where anything was lost.
"""

import argparse
import contextlib
import dataclasses
import importlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

ROOT = Path(__file__).parent.parent
METHODS: tuple[str, ...] = ("malm", "ccil", "gail", "expert", "bc", "iq_learn")
NUM_ITERATIONS = 40
SECONDS_TO_LEAVE = 30.0
RUN = "--env Walk --num-seeds 2 --seed 3 --eval-episodes 2 --max-episode-steps 7".split()
FIELDS = {  # each method gets those that it uses
    "env_steps": NUM_ITERATIONS * 64,
    "num_envs": 4,
    "batch_size": 32,
    "generator_steps": 2,
    "hidden_sizes": 4,
    "discriminator_minibatch_size": 16,
    "critic_minibatch_size": 8,
    "critic_epochs": 2,
    "fisher_stride": 2,
}


def options(method: str) -> list[str]:
    """What `train` is given, but for demonstrations and folder."""
    from ccil_jax.config import CLONING_UPDATES_PER_ITERATION, Config, unused

    idle = unused(Config(method=method))
    used = {name: value for name, value in FIELDS.items() if name not in idle}
    if method == "bc":
        used["cloning_updates"] = CLONING_UPDATES_PER_ITERATION * NUM_ITERATIONS
    return [*RUN, "--method", method, *(f"--{name.replace('_', '-')}={value}" for name, value in used.items())]


@dataclasses.dataclass
class Row:
    """One line of the table."""

    what: str
    tried: int = 0
    survived: int = 0
    instants: dict[str, int] = dataclasses.field(default_factory=dict)
    slowest: float = 0.0  # seconds from a signal to the end

    def count(self, good: bool, instant: str) -> None:
        self.tried += 1
        self.survived += good
        self.instants[instant] = self.instants.get(instant, 0) + 1


@dataclasses.dataclass(frozen=True)
class Ending:
    """How a run ended, to the last bit."""

    arrays: dict[str, dict[str, object]]
    metrics: bytes


class Suite:
    """Runs below one scratch folder, with one compilation cache."""

    def __init__(self, scratch: Path, seed: int = 0) -> None:
        from ccil_jax.demonstrations.trajectories import save_demonstrations
        from tests.probe_envs import walk_demonstrations

        self.scratch = scratch
        self.random = random.Random(seed)
        demonstrations = dataclasses.replace(walk_demonstrations(), metadata={"task": "Walk", "max_episode_steps": 7})
        save_demonstrations(scratch / "walk.npz", demonstrations)
        self._endings: dict[str, tuple[Ending, float]] = {}
        self._number = 0

    def folder(self) -> Path:
        """A run folder of its own."""
        self._number += 1
        return self.scratch / f"run{self._number}"

    def environment(self) -> dict[str, str]:
        """Of the processes."""
        return {
            **os.environ,
            "JAX_PLATFORMS": "cpu",
            "MPLBACKEND": "agg",
            "JAX_COMPILATION_CACHE_DIR": str(self.scratch / "cache"),
            "JAX_COMPILATION_CACHE_MAX_SIZE": str(2**30),  # locks the folder: a killed process may be writing there
            "JAX_DISABLE_MOST_OPTIMIZATIONS": "true",  # plain code: compiled in a third of the time
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }

    def start(
        self, method: str, folder: Path, *more: str, prefix: Sequence[str] = (), **variables: str
    ) -> "subprocess.Popen[str]":
        """A training process that goes on from what is in `folder`, as a job that is restarted would."""
        demos = ["--cost-limit", "1"] if method == "expert" else ["--demos", str(self.scratch / "walk.npz")]
        resume = ["--resume"] if (folder / "config.json").is_file() else []
        launcher = [sys.executable, __file__, "--child", "train"]
        command = [*prefix, *launcher, *options(method), "--out", str(folder), *demos, *resume, *more]
        environment = {**self.environment(), **variables}
        return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)

    def finish(self, method: str, folder: Path, *more: str) -> str:
        """Runs to the end. Returns what it said."""
        with self.start(method, folder, *more) as process:
            error = process.communicate(timeout=600)[1]
        if process.returncode != 0:
            raise RuntimeError(f"status {process.returncode}: {error[-2000:]}")
        return error

    def reference(self, method: str) -> tuple[Ending, float]:
        """The undisturbed run's ending, and how long it took with a warm cache."""
        if method not in self._endings:
            for _ in range(2):  # the first fills the cache
                folder, start = self.folder(), time.monotonic()
                self.finish(method, folder)
                self._endings[method] = ending(folder), time.monotonic() - start
        return self._endings[method]

    def ends_well(self, method: str, folder: Path) -> bool:
        """Continues the run in `folder`; whether it ends as the undisturbed one."""
        try:
            self.finish(method, folder)
        except RuntimeError as error:
            print(f"{method} in {folder}: {error}", file=sys.stderr)
            return False
        same = ending(folder) == self.reference(method)[0]
        if same:
            shutil.rmtree(folder)
        else:
            print(f"{method} in {folder}: ended otherwise", file=sys.stderr)
        return same

    def disturb(self, method: str, folder: Path, number: signal.Signals) -> tuple[int, str, float]:
        """Sends a signal at a random instant. Returns the exit status, where the run stood, seconds until the end."""
        duration = self.reference(method)[1]
        with self.start(method, folder) as process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(self.random.uniform(0, 1) * duration)
            instant = stage(folder)
            sent = time.monotonic()
            process.send_signal(number)
            process.communicate(timeout=300)
        return process.returncode, instant, time.monotonic() - sent

    def kills(self, count: int) -> Iterator[Row]:
        """kill -9 at random instants, now and then twice."""
        row = Row("kill -9 at a random instant, then `--resume`")
        for number in range(count):
            method, folder = METHODS[number % len(METHODS)], self.folder()
            for _ in range(1 + (number % 5 == 4)):
                instant = self.disturb(method, folder, signal.SIGKILL)[1]
            row.count(self.ends_well(method, folder), instant)
            progress(row)
        yield row

    def signals(self, count: int) -> Iterator[Row]:
        """SIGTERM, SIGINT and SIGUSR1 at random instants."""
        row = Row("SIGTERM, SIGINT, SIGUSR1 at a random instant, then `--resume`")
        for number in range(count):
            sent = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)[number % 3]
            method, folder = METHODS[number % len(METHODS)], self.folder()
            status, instant, seconds = self.disturb(method, folder, sent)
            # Before the launcher listens, and once all is done and it no longer does, the signal just ends the process.
            unheard = status == -sent and instant in ("start", "end")
            expected = status == 128 + sent or unheard or status == 0
            if not expected:
                print(f"{sent.name} during {instant}: status {status}", file=sys.stderr)
            row.slowest = max(row.slowest, seconds)
            row.count(self.ends_well(method, folder) and expected and seconds < SECONDS_TO_LEAVE, instant)
            progress(row)
        yield row

    def damage(self, count: int) -> Iterator[Row]:
        """Every file of the newest of two steps, flipped, cut or removed."""
        method = METHODS[0]
        original = self.folder()
        self.finish(method, original, "--env-steps", str(NUM_ITERATIONS // 2 * 64))
        self.finish(method, original)  # trained for longer: the step of the first half stays
        newest = original / "checkpoints" / str(max(steps(original)))
        files = sorted(path.relative_to(original) for path in newest.rglob("*") if path.is_file())
        flips, cuts = Row("one bit flipped in the newest checkpoint"), Row("a file of it cut short or removed")
        for file in files[:count]:
            for row in (flips, cuts):
                folder = self.folder()
                shutil.copytree(original, folder)
                if row is flips:
                    flip(folder / file, self.random)
                elif self.random.random() < 0.5:
                    os.truncate(folder / file, (folder / file).stat().st_size // 2)
                else:
                    (folder / file).unlink()
                row.count(self.ends_well(method, folder), file.name.split(".")[0] if len(file.name) < 24 else "data")
                progress(row)
        yield flips
        yield cuts

    def two_runs(self) -> Iterator[Row]:
        """A second process in the folder of a running one."""
        row, folder = Row("a second run in the same folder"), self.folder()
        self.reference("gail")
        with self.start("gail", folder) as first:
            while not (folder / "config.json").is_file() and first.poll() is None:
                time.sleep(0.05)
            start = time.monotonic()
            with self.start("gail", folder) as second:
                error = second.communicate(timeout=300)[1]
            row.slowest = time.monotonic() - start
            refused = second.returncode == 2 and f"process {first.pid} on" in error
            first.kill()
        row.count(refused and self.ends_well("gail", folder), "refused")
        yield row

    def full_disk(self) -> Iterator[Row]:
        """A small file system that fills up while the run trains. Needs the right to mount one."""
        row, disk = Row("disk full, space made, then `--resume`"), self.scratch / "disk"
        disk.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(disk)]
        if subprocess.run(mount, capture_output=True, check=False).returncode:
            print("full disk: not tried, no right to mount a file system here", file=sys.stderr)
            return
        try:
            self.reference("gail")
            folder = disk / "run"
            with self.start("gail", folder) as process:
                while not steps(folder) and process.poll() is None:
                    time.sleep(0.02)
                with contextlib.suppress(OSError), (disk / "filler").open("wb") as file:
                    while file.write(bytes(4096)):
                        file.flush()
                error = process.communicate(timeout=300)[1]
            told = process.returncode == 2 and str(folder) in error and ("bytes" in error or "space" in error)
            if not told:
                print(f"full disk: status {process.returncode}: {error[-500:]}", file=sys.stderr)
            kept = bool(steps(folder))
            (disk / "filler").unlink()
            row.count(told and kept and self.ends_well("gail", folder), "training")
        finally:
            subprocess.run(["umount", "-l", str(disk)], check=False)
        yield row


def ending(folder: Path) -> Ending:
    """Of a finished run."""
    manifest = json.loads((folder / "checkpoints" / str(NUM_ITERATIONS) / "manifest.json").read_text())
    metrics = (folder / "metrics.csv").read_bytes()
    rows = [line.split(",")[:2] for line in metrics.decode().splitlines()[1:]]
    assert rows == [[str(i + 1), str(s)] for i in range(NUM_ITERATIONS) for s in range(2)], "one row each"
    assert (folder / "summary.json").is_file()
    return Ending({name: facts for name, facts in manifest["arrays"].items() if "time" not in name}, metrics)


def steps(folder: Path) -> list[int]:
    """The steps of a run that are finished."""
    return [int(path.parent.name) for path in folder.glob("checkpoints/[0-9]*/manifest.json")]


def stage(folder: Path) -> str:
    """Where a run stands, by what it has written."""
    if (folder / "summary.json").is_file():
        return "end"
    if NUM_ITERATIONS in steps(folder):
        return "evaluation"
    if any(folder.glob("checkpoints/*tmp*")) or any(
        not (path / "manifest.json").is_file() for path in folder.glob("checkpoints/[0-9]*")
    ):
        return "save"
    if steps(folder):
        return "update"
    return "compile" if (folder / "config.json").is_file() else "start"


def flip(path: Path, chance: random.Random) -> None:
    """Flips one random bit; an empty file gets a byte."""
    content = bytearray(path.read_bytes() or b"\0")
    content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    path.write_bytes(content)


def progress(row: Row) -> None:
    """One line to follow a long suite by."""
    print(f"{row.what}: {row.survived} of {row.tried}", file=sys.stderr, flush=True)


def table(rows: Sequence[Row]) -> str:
    """For the README."""
    lines = ["| Fault | Tried | Survived | Where | Slowest |", "|---|---|---|---|---|"]
    for row in rows:
        where = ", ".join(f"{count} {name}" for name, count in sorted(row.instants.items()))
        slowest = f"{row.slowest:.1f} s" if row.slowest else ""
        lines.append(f"| {row.what} | {row.tried} | {row.survived} | {where} | {slowest} |")
    return "\n".join(lines)


def child(launcher: str, arguments: Sequence[str]) -> int:
    """A launcher with the probe task among its tasks; training looks and saves after every iteration.

    With OFFLINE set every socket is refused, with FAULTY every cost is NaN.
    """
    if "OFFLINE" in os.environ:
        socket.socket = refuse  # type: ignore[assignment,misc]
    import envs

    envs.register("Walk", make_walk, obs_dim=2, action_dim=1)

    from ccil_jax.training import loop

    loop.CHECKPOINT_SECONDS, loop.SAVING_SHARE, loop.CHUNK_SECONDS = 0.3, 1.0, 0.0
    for number in (signal.SIGTERM, signal.SIGUSR1):  # sent here, even if whoever runs this began with them ignored
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return importlib.import_module(f"experiments.{launcher}").main(arguments)


def refuse(*_: object, **__: object) -> NoReturn:
    """In place of a socket."""
    raise OSError("no network here")


def make_walk(physics: str = "auto", max_episode_steps: int = 1000) -> object:
    """Builds the probe task, which has no engine: every physics is the same."""
    del physics
    from tests.probe_envs import Walk

    class Task(Walk):
        physics_name = "native"

        def advance(self, physics: Any, action: Any) -> Any:
            physics, reward, cost, terminated = super().advance(physics, action)
            return physics, reward, cost * float("nan") if "FAULTY" in os.environ else cost, terminated

    return Task(max_episode_steps=max_episode_steps)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--signals", type=int, default=20)
    parser.add_argument("--files", type=int, default=100, help="of the newest checkpoint to damage, at most")
    parser.add_argument("--seed", type=int, default=0, help="of the random instants")
    arguments = parser.parse_args(argv)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        suite = Suite(Path(scratch), arguments.seed)
        for part in (
            suite.two_runs(),
            suite.full_disk(),
            suite.signals(arguments.signals),
            suite.damage(arguments.files),
            suite.kills(arguments.kills),
        ):
            for row in part:
                rows.append(row)
                print(table([row]), file=sys.stderr, flush=True)
    print(table(rows))
    return int(any(row.survived < row.tried for row in rows))


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(child(sys.argv[2], sys.argv[3:]) if sys.argv[1:2] == ["--child"] else main())
