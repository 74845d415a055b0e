"""The same configuration, seed and versions give the same bits: in other processes, threads, and after any stop."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import pytest

from ccil_jax.agents import build
from ccil_jax.agents.expert import expert_data
from ccil_jax.config import CLONING_UPDATES_PER_ITERATION, Config, unused
from ccil_jax.methods import METHODS
from ccil_jax.training.checkpointing import Checkpointer
from ccil_jax.training.manifests import Identity
from ccil_jax.training.program import compile_program
from tests.probe_envs import Walk, assert_same_bits, quick_compilation, walk_config, walk_demonstrations

pytestmark = pytest.mark.once

IN_A_PROCESS = """
import hashlib, json, jax, numpy
from ccil_jax.training import runner
from envs.jax_tools import as_numbers
from tests.probe_envs import Walk, quick_compilation, walk_config, walk_demonstrations

with quick_compilation():
    result = runner.train(walk_config(method="gail"), Walk(), walk_demonstrations(), num_seeds=2)
digest = hashlib.sha256()
for leaf in jax.tree.leaves((result.state, result.metrics)):
    digest.update(numpy.asarray(as_numbers(leaf) if isinstance(leaf, jax.Array) else leaf).tobytes())
print(json.dumps({"digest": digest.hexdigest(), "devices": len(jax.devices())}))
"""


def digest(hash_seed: int, threads: int) -> dict[str, Any]:
    """Of the whole state and all metrics, from a process of its own."""
    environment = {
        **os.environ,
        "PYTHONHASHSEED": str(hash_seed),
        "PJRT_NPROC": str(threads),
        "JAX_ENABLE_COMPILATION_CACHE": "false",  # every process compiles for itself
        "PYTHONPATH": str(Path(__file__).parent.parent),
    }
    command = [sys.executable, "-c", IN_A_PROCESS]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_two_processes_end_with_the_same_bits() -> None:
    first = digest(1, threads=1)
    assert first["devices"] == 1
    assert first == digest(2, threads=4)


@pytest.mark.slow
def test_eight_processes_end_with_the_same_bits() -> None:
    """Five alike, and with 1, 2 and 4 threads."""
    settings = [(seed, 2) for seed in range(5)] + [(0, threads) for threads in (1, 2, 4)]
    assert len({digest(*setting)["digest"] for setting in settings}) == 1


NUM_ITERATIONS = 20


def config_of(method: str) -> Config:
    limit = {"cost_limit": 1.0} if METHODS[method].limit == "prescribed" else {}
    config = walk_config(method=method, **limit)
    if method == "bc":
        return config.replace(cloning_updates=NUM_ITERATIONS * CLONING_UPDATES_PER_ITERATION)
    lengths = {"env_steps": NUM_ITERATIONS * 64, "replay_size": 64}
    return config.replace(**{name: value for name, value in lengths.items() if name not in unused(config)})


DEFAULT = ("malm", "iq_learn")


@pytest.mark.parametrize(
    "method", [name if name in DEFAULT else pytest.param(name, marks=pytest.mark.slow) for name in METHODS]
)
def test_a_run_stopped_after_any_iteration_goes_on_as_if_it_had_not_been(method: str, tmp_path: Path) -> None:
    """Through a checkpoint on disk, for every method and every iteration (a few of them, in the quick tests)."""
    demonstrations = walk_demonstrations()
    config = build.resolve(config_of(method), Walk(), demonstrations)
    with quick_compilation():
        program = compile_program(config, Walk(), expert_data(demonstrations), 2)

    def run(state: Any, length: int) -> Any:
        while length:
            turn = min(length, program.chunk_length)
            state, _ = program.chunk(state, turn)
            length -= turn
        return state

    keys = jax.random.split(jax.random.key(0), 2)
    whole = run(program.init(keys), NUM_ITERATIONS)
    for stop in (1, 7, 19) if method in DEFAULT else range(1, NUM_ITERATIONS + 1):
        with Checkpointer(tmp_path / str(stop), Identity(configs=(config,))) as checkpoints:
            checkpoints.save(stop, {"state": run(program.init(keys), stop)})
            state = checkpoints.restore(stop, {"state": program.state})["state"]
        assert_same_bits(run(state, NUM_ITERATIONS - stop), whole)
