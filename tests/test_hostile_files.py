"""Malformed and mutated demonstrations: one line, exit status 2, nothing run, in bounded time and memory."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.hostile_builders import FAMILIES

CASES = [(family, name) for family, cases in FAMILIES.items() for name in cases]
ROOT = Path(__file__).parent.parent


def hostile_files(*arguments: str) -> str:
    """What `tests.hostile_files` prints: a process without JAX that may be limited, and may be lost."""
    command = [sys.executable, "-m", "tests.hostile_files", *arguments]
    settings = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=settings, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def named() -> dict[tuple[str, str], dict[str, Any]]:
    return {(row["family"], row["name"]): row for row in json.loads(hostile_files("--named"))}


def test_there_are_enough_cases() -> None:
    assert min(map(len, FAMILIES.values())) >= 25


@pytest.mark.parametrize(("family", "name"), CASES)
def test_a_malformed_file_ends_in_one_line(
    named: dict[tuple[str, str], dict[str, Any]], family: str, name: str
) -> None:
    row, message = named[family, name], FAMILIES[family][name][1]
    assert row["ended"] == "read", row  # the launcher ended by itself, within seconds, and ran nothing
    assert row["status"] == [2], row
    assert row["stderr"].startswith("python -m experiments.convert: error: ")
    assert row["stderr"].count("\n") == 1
    assert len(row["stderr"]) < 1100
    assert row["stderr"].strip().isprintable()
    assert message in row["stderr"]
    assert not row["wrote"]


def test_mutated_files_are_refused_or_read() -> None:
    table = hostile_files("--mutations", "600")
    assert table.count("150 | ") == len(FAMILIES), table


@pytest.mark.slow
def test_ten_thousand_mutated_files() -> None:
    print(hostile_files("--mutations", "10000", "--seed", "1"))


def test_the_harness_sees_what_it_looks_for() -> None:
    """Real execution, an endless loop, another error and an allocation beyond the limit are told from a refusal."""
    code = """
import os, pickle, time
from pathlib import Path
import numpy as np
from ccil_jax.errors import DemonstrationsError
from tests import hostile_builders, hostile_files as h

def refuse(): raise DemonstrationsError("no")
h.SECONDS = 0.2
with h.confined():
    hostile_builders.LEGACY["os.mkdir"][0](Path("payload.npz"))
    acts = [lambda: np.load("payload.npz", allow_pickle=True)["obs"], lambda: os.system("true"), lambda: time.sleep(9),
            lambda: [][0], lambda: np.ones(2**33), refuse, lambda: None]
    print([h.outcome(act).partition(":")[0] for act in acts])
"""
    settings = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=settings, capture_output=True, text=True, check=True
    )
    expected = ["executed", "executed", "hung", "IndexError", "MemoryError", "refused", "read"]
    assert done.stdout.strip() == str(expected)
