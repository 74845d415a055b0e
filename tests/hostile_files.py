"""Reads thousands of damaged demonstrations in this process and counts how each ends.

    python -m tests.hostile_files --mutations 10000     # mutated files, a table; status 1 unless all is well
    python -m tests.hostile_files --named               # the named cases, as JSON

Every file goes through `load_demonstrations` or the converter. HDF5 is read in a child as for a user, but one that is
forked rather than started anew, which makes a file take milliseconds. Memory is limited for all processes together.
"""

import argparse
import contextlib
import io
import json
import os
import resource
import select
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.demonstrations import hdf5, hdf5_child, npz
from ccil_jax.demonstrations.trajectories import load_demonstrations
from ccil_jax.errors import DemonstrationsError
from experiments import convert
from tests import hostile_builders
from tests.hostile_builders import CANARY, FAMILIES, LIMIT, SOUND

SECONDS = 5.0  # of processor time: a file that takes longer counts as hung
WALL = 6  # times as long by the clock, as the machine may be busy
MEMORY = 2 * 1024**3  # address space of this process
EXECUTION = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "pickle.find_class", "ctypes.dlopen")
COLUMNS = ("tried", "refused", "read", "hung", "executed", "other", "readers lost")
FRAGMENTS = tuple(  # what a pickle is attacked with
    bytes(fragment)
    for fragment in (
        b"cos\nsystem\n",
        b"cposix\nmkdir\nX\x06\x00\x00\x00canary\x85R",
        b"cbuiltins\neval\nX\x21\x00\x00\x00__import__('os').mkdir('canary')\x85R",
        b"\x8c\x05posix\x8c\x05mkdir\x93\x8c\x06canary\x85R",
        b"cnumpy._core.multiarray\n_reconstruct\n",
        b"cnumpy\nndarray\n",
        b"cnumpy\ndtype\n",
        b"R", b"b", b"a", b"e", b"t", b"(", b"]", b")", b"0", b"2", b".", b"N", b"}", b"u", b"\x81", b"\x82\x01",
        b"\x93", b"h\x00", b"h\x01", b"q\x00", b"r\xff\xff\xff\x7f", b"j\x00\x00\x00\x00", b"\x94",
    )
)  # fmt: skip
INTERESTING = (b"\xff" * 4, b"\xff" * 8, b"\xff\xff\xff\x7f", b"\x00" * 8, b"\x00\x00\x00\x80", b"\x01" + b"\0" * 7)

executed = Counter[str]()


def watch_execution() -> None:
    """Counts, from now on, what Python reports when code is about to run."""
    sys.addaudithook(lambda event, _: executed.update([event]) if event in EXECUTION else None)


def forked_reader(arguments: Sequence[str]) -> tuple[int, str]:
    """As `hdf5.run_child`, in a fork of this process."""
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        status = 99
        with contextlib.suppress(BaseException):
            sys.stderr = os.fdopen(theirs, "w")
            status = hdf5_child.main(arguments)
            sys.stderr.flush()
        os._exit(status)
    os.close(theirs)
    try:
        if not select.select([ours], [], [], WALL * SECONDS)[0]:
            os.kill(child, signal.SIGKILL)
            raise subprocess.TimeoutExpired("reader", WALL * SECONDS)
        with os.fdopen(os.dup(ours), errors="replace") as said:
            complaint = said.read()
    finally:
        os.close(ours)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status not in (0, hdf5_child.REFUSED):
        executed["reader lost"] += 1
        print(f"an HDF5 reader ended with status {status}", file=sys.stderr)
    return status, complaint.strip().rpartition("\n")[2]


@contextlib.contextmanager
def confined() -> Iterator[Path]:
    """An empty working directory, small limits, a bounded process."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    npz.MAX_BYTES = LIMIT
    hdf5.run_child, hdf5_child.CPU_SECONDS = forked_reader, int(SECONDS)
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        watch_execution()
        try:
            yield Path(folder)
        finally:
            os.chdir(before)


class Hung(BaseException):
    """The file took too long by the clock. No reader catches this."""


def _alarm(*_: Any) -> None:
    raise Hung


def outcome(act: Callable[[], Any]) -> str:
    """What reading one file led to: refused, read, hung, executed, or the name of another error."""
    signal.signal(signal.SIGALRM, _alarm)
    signal.setitimer(signal.ITIMER_REAL, WALL * SECONDS)
    seen = sum(executed[event] for event in EXECUTION)
    start = time.process_time()
    try:
        act()
        result = "read"
    except DemonstrationsError as error:
        result = "refused" if "\n" not in str(error) else "message of several lines"
    except Hung:
        result = "hung"
    except SystemExit:
        result = "refused"
    except Exception as error:  # noqa: BLE001  (this is what we look for)
        result = f"{type(error).__name__}: {error}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    if Path(CANARY).exists() or sum(executed[event] for event in EXECUTION) > seen:
        with contextlib.suppress(OSError):
            Path(CANARY).rmdir()
        return "executed"
    return "hung" if time.process_time() - start > SECONDS else result


def mutate(content: bytes, rng: np.random.Generator, fragments: Sequence[bytes] = INTERESTING) -> bytes:
    """One to four edits, mostly where there is something: flips, cuts, repetitions, insertions, odd numbers."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        busy = np.flatnonzero(np.frombuffer(bytes(data), np.uint8))
        at = int(rng.choice(busy)) if len(busy) and rng.random() < 0.8 else int(rng.integers(0, len(data) + 1))
        length = int(rng.integers(1, 40))
        piece = fragments[rng.integers(len(fragments))]
        match rng.integers(0, 8):
            case 0 | 1:
                data[at : at + 1] = bytes([data[at] ^ (1 << int(rng.integers(8)))]) if at < len(data) else b""
            case 2 | 3:
                data[at : at + 1] = bytes([int(rng.integers(256))])
            case 4:
                data[at : at + len(piece)] = piece
            case 5:
                data[at:at] = piece
            case 6:
                del data[at : at + length]
            case 7:
                data[at:at] = data[at : at + length]
        if rng.random() < 0.02:
            del data[at:]
    return bytes(data)


def mutate_archive(path: Path, content: bytes, rng: np.random.Generator) -> None:
    """Half of the time the archive; else one member, in an archive that is sound."""
    if rng.random() < 0.5:
        path.write_bytes(mutate(content, rng))
        return
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = str(rng.choice(sorted(members)))
    members[name] = mutate(members[name], rng, FRAGMENTS if rng.random() < 0.7 else INTERESTING)
    hostile_builders.write_members(path, members)


def mutated_files(family: str, seed: int) -> Iterator[Path]:
    """Endlessly many damaged files, each in place of the one before."""
    path = Path("sound") if family == "Minari" else Path("sound.npz")
    SOUND[family](path)
    load_demonstrations(path)  # what is not sound to begin with would prove nothing
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    contents = [file.read_bytes() for file in files]
    rng = np.random.default_rng([seed, *family.encode()])
    while True:
        which = int(rng.choice(len(files), p=[0.9, 0.1] if len(files) == 2 else None))
        if family in ("npz", "legacy npz"):
            mutate_archive(files[which], contents[which], rng)
        else:
            files[which].write_bytes(mutate(contents[which], rng))
        yield path
        files[which].write_bytes(contents[which])


def run_mutations(count: int, seed: int) -> dict[str, Counter[str]]:
    """Outcomes of `count` mutated files, the same number of each family, counted by family."""
    results = {}
    for family in FAMILIES:
        counts, lost = Counter[str](), executed["reader lost"]
        with tempfile.TemporaryDirectory(dir=".") as folder, contextlib.chdir(folder):
            for path, _ in zip(mutated_files(family, seed), range(count // len(FAMILIES)), strict=False):
                counts[outcome(lambda path=path: load_demonstrations(path))] += 1  # type: ignore[misc]
        counts["readers lost"] = executed["reader lost"] - lost
        results[family] = counts
    return results


def run_named() -> list[dict[str, Any]]:
    """Every named case through the converter: what it printed, its exit status and whether code ran."""
    results = []
    for family, cases in FAMILIES.items():
        for number, (name, (build, _)) in enumerate(cases.items()):
            folder = Path(f"{family} {number}".replace(" ", "_"))
            folder.mkdir()
            build(folder / "bad")
            stderr = io.StringIO()
            status: list[Any] = []

            def act(folder: Path = folder, status: list[Any] = status) -> None:
                try:
                    arguments = [str(folder / "bad"), "--env", "Swimmer", "--out", str(folder / "out.npz")]
                    status.append(convert.main(arguments))
                except SystemExit as end:
                    status.append(end.code)

            with contextlib.redirect_stderr(stderr), contextlib.redirect_stdout(io.StringIO()):
                ended = outcome(act)
            results.append(
                {
                    "family": family,
                    "name": name,
                    "status": status,
                    "ended": ended,
                    "stderr": stderr.getvalue(),
                    "wrote": (folder / "out.npz").exists() or (folder / CANARY).exists(),
                }
            )
    return results


def print_table(results: dict[str, Counter[str]], seconds: float) -> bool:
    """Prints one row a family; true where every file was refused or read."""
    known = ("refused", "read", "hung", "executed", "readers lost")
    print(" | ".join(("family", *COLUMNS)))
    for family, counts in results.items():
        tried = sum(n for name, n in counts.items() if name != "readers lost")
        other = {name: n for name, n in counts.items() if name not in known}
        row = [tried, counts["refused"], counts["read"], counts["hung"], counts["executed"], sum(other.values())]
        print(" | ".join(map(str, (family, *row, counts["readers lost"]))))
        for name, n in other.items():
            print(f"  {n} x {name[:300]}")
    peak = [resource.getrusage(who).ru_maxrss // 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    print(f"{seconds:.0f} s; peak memory {peak[0]} MiB, of an HDF5 reader {peak[1]} MiB")
    return all(set(counts) <= {"refused", "read", "readers lost"} for counts in results.values())


def main() -> int:
    """Entry point; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutations", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--named", action="store_true")
    arguments = parser.parse_args()
    with confined():
        if arguments.named:
            print(json.dumps(run_named()))
            return 0
        start = time.perf_counter()
        results = run_mutations(arguments.mutations, arguments.seed)
        return 0 if print_table(results, time.perf_counter() - start) else 1


if __name__ == "__main__":
    sys.exit(main())
