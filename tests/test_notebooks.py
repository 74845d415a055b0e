"""The notebooks of the documentation, run from top to bottom with small settings."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest

from tests.test_documentation import ROOT

pytestmark = pytest.mark.once

FOLDER = ROOT / "docs" / "notebooks"
# In the place of the cell with the tag `parameters`. A warning is an error, as in all tests, and compilation is quick.
FIRST = """
import warnings
import jax
warnings.simplefilter("error")
jax.config.update("jax_disable_most_optimizations", True)
"""
SMALL = {
    "quick_start": 'NUM_SEEDS, NUM_EPISODES, PRESET, SETTINGS = 2, 2, "tiny", {}',
    "training_step": (
        "NUM_ITERATIONS, IMITATION = 2, {'discriminator_minibatch_size': 50}\n"
        "SETTINGS = {'batch_size': 100, 'num_envs': 4, 'hidden_sizes': (4,), 'critic_minibatch_size': 50}"
    ),
}


def printed(notebook: Any) -> str:
    """What the notebook shows as text. Nothing is written to standard error."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert [output.text for output in outputs if output.get("name") == "stderr"] == []
    shown = [output.get("text") or output.data.get("text/markdown", "") for output in outputs]
    return "\n".join(shown)


def run(name: str, folder: Path) -> str:
    """What the notebook shows with small settings."""
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    assert all(setting in SMALL[name] for setting in re.findall(r"^(\w+) = ", parameters.source, re.MULTILINE))
    parameters.source = FIRST + SMALL[name]
    path = folder / "small.ipynb"
    nbformat.write(notebook, path)
    # The kernel is reached by files: another process could take a network's port.
    command = [sys.executable, "-m", "nbconvert", "--to=notebook", "--execute", "--inplace", path.name]
    settings = {**os.environ, "PYTHONPATH": str(ROOT), "IPYTHONDIR": str(folder), "JUPYTER_PLATFORM_DIRS": "1"}
    done = subprocess.run(
        [*command, "--KernelManager.transport=ipc"],
        cwd=folder,
        env=settings,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return printed(nbformat.read(path, as_version=4))


def numbers(pattern: str, text: str) -> list[float]:
    """Those in the groups of the pattern, where it is found first."""
    found = re.search(pattern, text)
    assert found, text
    return [float(number) for number in found.groups()]


def test_the_quick_start_ends_with_a_table(tmp_path: Path) -> None:
    rows = re.findall(r"^\| ([\w, ]+) \| +([\d.-]+) \|", run("quick_start", tmp_path), re.MULTILINE)
    assert [name for name, _ in rows] == ["MALM, seed 0", "MALM, seed 1", "expert", "random"]
    with np.load(ROOT / "experiments" / "demonstrations" / "Swimmer.npz") as demonstrations:
        mean_return = demonstrations["rewards"].sum(dtype=float) / len(demonstrations["episode_ends"])
    assert float(dict(rows)["expert"]) == pytest.approx(mean_return, abs=0.06)


def test_the_training_step_has_the_derivative_that_differences_have(tmp_path: Path) -> None:
    said = run("training_step", tmp_path)
    slope, quotient = numbers(r"derivative ([\d.-]+), difference quotient ([\d.-]+)", said)
    assert slope == pytest.approx(quotient, rel=1e-3)
    assert abs(slope) > 1e-3
    before, after = numbers(r"log-likelihood: ([\d.-]+), then ([\d.-]+)", said)
    assert after < before


@pytest.mark.parametrize("name", SMALL)
def test_what_is_stored_is_small_and_of_the_notebook_as_it_is(name: str) -> None:
    path = FOLDER / f"{name}.ipynb"
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < 150_000
    assert printed(notebook)
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == [*range(1, len(counts) + 1)]  # run once, from top to bottom


def test_every_notebook_is_run() -> None:
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == SMALL.keys()
