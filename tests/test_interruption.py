"""Signals, in processes of their own: what is deferred is saved first; everything else ends at once."""

import signal
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path

import pytest

from experiments.cli.interruption import SIGNALS

ROOT = Path(__file__).parent.parent
BUSY = """
import signal, sys
sys.path.insert(0, {root!r})
from experiments.cli.interruption import SIGNALS, Interruption
for number in SIGNALS:  # whatever the tests were started with
    signal.signal(number, signal.SIG_DFL)
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
from experiments.cli import interruption
for number in interruption.SIGNALS:
    signal.signal(number, signal.SIG_IGN if number in {ignored} else signal.SIG_DFL)
with interruption.Interruption() as run:
    run.defer()
    for number in interruption.SIGNALS:
        os.kill(os.getpid(), number)
        time.sleep(0.2)
        print(number.name, run.requested(), flush=True)
        if run.requested():
            run.settle("saved")
"""


def ignoring(ignored: Collection[int], more: str = "") -> subprocess.CompletedProcess[str]:
    """Each signal in turn comes to a process that began with some of them ignored; `more` is its code afterwards."""
    code = IGNORANT.format(root=str(ROOT), ignored=[int(number) for number in ignored]) + more
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False)


@pytest.mark.parametrize(
    ("ignored", "heard"),
    [([signal.SIGTERM], "SIGINT"), ([signal.SIGTERM, signal.SIGINT], "SIGUSR1")],
)
def test_a_signal_that_was_ignored_stays_so(ignored: list[signal.Signals], heard: str) -> None:
    """As of `nohup` and of background jobs of a script; the others are heard."""
    done = ignoring(ignored)
    unheard = [f"{number.name} False" for number in SIGNALS[: [n.name for n in SIGNALS].index(heard)]]
    assert done.stdout.splitlines() == [*unheard, f"{heard} True"]
    assert (done.returncode, done.stderr) == (128 + signal.Signals[heard], f"{heard}: saved\n")


def test_where_all_are_ignored_all_stay_so() -> None:
    done = ignoring(SIGNALS, "print([signal.getsignal(number) == signal.SIG_IGN for number in interruption.SIGNALS])")
    assert done.stdout.splitlines() == ["SIGTERM False", "SIGINT False", "SIGUSR1 False", "[True, True, True]"]
    assert (done.returncode, done.stderr) == (0, "")


def test_a_worker_ends_with_whoever_waits_even_where_sigterm_is_ignored() -> None:
    code = f"import signal, sys, time; sys.path.insert(0, {str(ROOT)!r}); "
    code += "signal.signal(signal.SIGTERM, signal.SIG_IGN); "
    code += "from experiments.cli.interruption import stop_at_eof; stop_at_eof(); time.sleep(20)"
    done = subprocess.run([sys.executable, "-c", code], input="", text=True, timeout=30, check=False)
    assert done.returncode == -signal.SIGTERM
