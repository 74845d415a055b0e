"""The fault suite in a reduced form, long runs, and no network. In full: `python tests/faults.py`."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest

from ccil_jax.training import loop, runner
from ccil_jax.training.loop import Progress
from tests import faults
from tests.faults import Suite
from tests.probe_envs import Walk, quick_compilation, walk_config

pytestmark = pytest.mark.once

SIMPLE = "gail"  # the quickest to compile


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Suite]:
    original, faults.METHODS = faults.METHODS, (SIMPLE,)
    yield Suite(tmp_path_factory.mktemp("faults"), seed=5)
    faults.METHODS = original


def test_killed_and_signalled_runs_end_as_undisturbed_ones(suite: Suite) -> None:
    for row in (*suite.kills(1), *suite.signals(1)):
        assert row.survived == row.tried > 0, row


def test_a_second_run_in_the_folder_is_refused(suite: Suite) -> None:
    (row,) = suite.two_runs()
    assert row.survived == row.tried == 1


def resident_megabytes() -> float:
    """Of this process, now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize(
    "num_iterations", [pytest.param(300, id="reduced"), pytest.param(2000, id="full", marks=pytest.mark.slow)]
)
def test_long_runs_do_not_grow(num_iterations: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a tenth of the run as warm-up: memory within 10 MB or 1 %, as many arrays on the device, one compilation.

    Checkpoints are part of it, one a second.
    """
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", 1.0)
    seen: list[tuple[int, float, int]] = []
    compiled: list[str] = []

    def on_progress(progress: Progress) -> None:
        seen.append((progress.iteration, resident_megabytes(), len(jax.live_arrays())))
        if progress.iteration >= num_iterations // 10 and not compiled:
            compiled.append("warm")

    def on_compilation(event: str, duration: float, **details: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration" and compiled:
            compiled.append(str(details.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(on_compilation)
    try:
        with quick_compilation():
            config = walk_config(method="trpo", env_steps=num_iterations * 64)
            result = runner.train(config, Walk(), num_seeds=2, checkpoint_dir=tmp_path, on_progress=on_progress)
    finally:
        jax.monitoring.unregister_event_duration_listener(on_compilation)
    warm = [row for row in seen if row[0] >= num_iterations // 10]
    growth = warm[-1][1] - warm[0][1]
    assert growth < max(10.0, 0.01 * warm[0][1]), f"{growth:.1f} MB"
    assert len({arrays for _, _, arrays in warm}) <= 2, "the first and the last chunk may differ"
    assert compiled == ["warm"]
    assert result.metrics["env_steps"].shape == (num_iterations, 2)


def test_counters_pass_31_bits() -> None:
    config = walk_config(batch_size=2**20, num_envs=2**10, generator_steps=1)
    first = 2**31 // 2**20 - 2
    rows = loop._rows({"kl": np.zeros((2, 4))}, first, config)
    assert rows["env_steps"].dtype == np.int64
    assert rows["env_steps"].tolist() == [[2**31 + k * 2**20] * 2 for k in (-1, 0, 1, 2)]


def test_nothing_needs_the_network(suite: Suite) -> None:
    """A training, from its start to its figures, where there is no interface but an unreachable loopback."""
    apart = ["unshare", "--user", "--map-root-user", "--net"]
    if not shutil.which("unshare") or subprocess.run([*apart, "true"], capture_output=True, check=False).returncode:
        apart = []  # then a process in which every socket is refused
    folder = suite.folder()
    suite.reference(SIMPLE)
    with suite.start(SIMPLE, folder, prefix=apart, **({} if apart else {"OFFLINE": "1"})) as process:
        error = process.communicate(timeout=300)[1]
    assert process.returncode == 0, error
    assert faults.ending(folder) == suite.reference(SIMPLE)[0]


@pytest.mark.parametrize(
    ("method", "options", "variables", "found"),
    [
        pytest.param(SIMPLE, (), {"FAULTY": "1"}, "metrics.cost_rate", id="on-policy"),
        pytest.param("iq_learn", (), {"FAULTY": "1"}, "metrics.cost_rate", id="iq_learn"),
        pytest.param("bc", ("--actor-learning-rate", "1e38"), {}, "metrics.loss", id="bc"),
    ],
)
def test_a_fault_is_diagnosed_and_replayed(
    suite: Suite, method: str, options: tuple[str, ...], variables: dict[str, str], found: str
) -> None:
    """A cost that is NaN, or a learning rate beyond all bounds, stops every seed; the file in the run folder says why.

    The three are the kinds of agent, each with a state of its own.
    """
    folder = suite.folder()
    with suite.start(method, folder, "--max-skipped-updates", "3", *options, **variables) as process:
        error = process.communicate(timeout=300)[1]
    assert process.returncode == 1, error
    assert "seed 0 stopped" in error
    command = [sys.executable, faults.__file__, "--child", "replay_fault", str(folder / "fault_seed_0.npz")]
    environment = {**suite.environment(), **variables}
    replayed = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert replayed.returncode == 0, replayed.stderr
    assert f"not finite: {found}" in replayed.stdout
