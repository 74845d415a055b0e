"""Signals, in processes of their own: what is deferred is saved first; everything else ends at once."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

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
