"""Signals, in processes of their own: what is deferred is saved first; everything else ends at once."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.interruption import SIGNALS

ROOT = Path(__file__).parent.parent
BUSY = """
import re, sys
sys.path.insert(0, {root!r})
from experiments.interruption import Interruption
with Interruption() as interruption:
    {defer}
    print("ready", flush=True)
    {work}
    interruption.settle("saved")
print("undisturbed")
"""
WAIT = "while not interruption.requested(): pass"


def signalled(number: signal.Signals, defer: str, work: str, times: int = 1) -> tuple[int, str]:
    code = BUSY.format(root=str(ROOT), defer=defer, work=work)
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert process.stdout.readline() == "ready\n"
        for _ in range(times):
            process.send_signal(number)
        error = process.communicate(timeout=30)[1]
    return process.returncode, error


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])
def test_what_is_deferred_is_saved_first(number: signal.Signals) -> None:
    assert signalled(number, "interruption.defer()", WAIT) == (128 + number, f"{number.name}: saved\n")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_without_anything_to_save_it_ends_at_once(number: signal.Signals) -> None:
    """Also while the main thread hears nothing."""
    status, error = signalled(number, "pass", "import time; [sum(range(10**8)) for _ in range(10**6)]")
    assert status == 128 + number
    assert "nothing that was saved is lost" in error


def test_no_signal_no_effect() -> None:
    code = BUSY.format(root=str(ROOT), defer="interruption.defer()", work="pass")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "ready\nundisturbed\n", "")


IGNORANT = """
import os, signal, sys, time
sys.path.insert(0, {root!r})
from experiments import interruption
with interruption.Interruption() as run:
    run.defer()
    for number in interruption.SIGNALS:
        os.kill(os.getpid(), number)
        time.sleep(0.2)
        print(number.name, run.requested(), flush=True)
        if run.requested():
            run.settle("saved")
"""


@pytest.mark.parametrize(
    ("ignored", "heard"),
    [({signal.SIGINT}, "SIGTERM"), ({signal.SIGTERM}, "SIGINT"), ({signal.SIGTERM, signal.SIGINT}, "SIGUSR1")],
)
def test_a_signal_that_was_ignored_stays_so(ignored: set[signal.Signals], heard: str) -> None:
    """As of `nohup` and of background jobs of a script; the others are heard."""
    done = ignoring(ignored, IGNORANT.format(root=str(ROOT)))
    shown = [f"{number.name} False" for number in SIGNALS[: [n.name for n in SIGNALS].index(heard)]]
    assert done.stdout.splitlines() == [*shown, f"{heard} True"]
    assert done.stderr == f"{heard}: saved\n"
    assert done.returncode == 128 + signal.Signals[heard]


def test_where_all_are_ignored_all_stay_so() -> None:
    code = "print([signal.getsignal(number) == signal.SIG_IGN for number in interruption.SIGNALS])"
    done = ignoring(set(SIGNALS), IGNORANT.format(root=str(ROOT)) + code)
    assert done.stdout.splitlines() == ["SIGTERM False", "SIGINT False", "SIGUSR1 False", "[True, True, True]"]
    assert (done.returncode, done.stderr) == (0, "")


def test_a_worker_ends_with_whoever_waits_even_where_sigterm_is_ignored() -> None:
    code = f"import sys, time; sys.path.insert(0, {str(ROOT)!r})\n"
    code += "from experiments.interruption import stop_at_eof; stop_at_eof(); time.sleep(20)"
    assert ignoring({signal.SIGTERM}, code).returncode == -signal.SIGTERM


def ignoring(ignored: set[signal.Signals], code: str) -> subprocess.CompletedProcess[str]:
    """Runs code in a process that begins with some signals ignored and whose standard input has ended."""

    def ignore() -> None:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN if number in ignored else signal.SIG_DFL)

    command = [sys.executable, "-c", code]
    return subprocess.run(command, input="", capture_output=True, text=True, timeout=30, check=False, preexec_fn=ignore)
