"""Several configurations in one program: each run has its own numbers, and shares nothing with the others."""

import dataclasses
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import chex
import jax
import numpy as np
import pytest

import envs
from ccil_jax.agents import build
from ccil_jax.agents.expert import expert_data
from ccil_jax.config import Config
from ccil_jax.errors import ConfigError
from ccil_jax.training import combining, program, runner
from ccil_jax.training.history import EPISODE_ESTIMATES, without_unknown
from ccil_jax.training.program import compile_program
from ccil_jax.training.runner import Result
from envs.base import Environment
from experiments.cli import xla
from tests.probe_envs import (
    Counter,
    Walk,
    assert_same_bits,
    quick_compilation,
    walk_config,
    walk_demonstrations,
)

pytestmark = pytest.mark.once

NUM_SEEDS = 2
CHOICES = ((1.0, 0.02, 0.5), (2.0, 0.0, 0.25), (0.5, 0.1, 0.0))  # cost limit, step size and start of the multiplier


def config(limit: float, rate: float, start: float, **changes: Any) -> Config:
    return walk_config(
        method="lgail",
        multiplier_update="sgd",
        cost_limit=limit,
        multiplier_learning_rate=rate,
        initial_multiplier=start,
        **changes,
    )


def train(*choices: tuple[float, float, float], **settings: Any) -> list[Result]:
    configs = [config(*choice) for choice in choices]
    with quick_compilation():
        return runner.train_runs(configs, Walk(), walk_demonstrations(), num_seeds=NUM_SEEDS, seed=3, **settings)


@pytest.fixture(scope="module")
def results() -> list[Result]:
    return train(*CHOICES)


def test_every_run_has_its_own_numbers(results: list[Result]) -> None:
    """The multiplier recomputed from the logged costs: lambda + rate (J - limit), not below 0."""
    for result, (limit, rate, start) in zip(results, CHOICES, strict=True):
        assert result.config == config(limit, rate, start)
        assert result.metrics["multiplier"].shape == (20, NUM_SEEDS)
        expected = np.full(NUM_SEEDS, start)
        for cost, multiplier in zip(result.metrics["episode_cost"], result.metrics["multiplier"], strict=True):
            expected = np.clip(expected + rate * (cost - limit), 0.0, 100.0)
            np.testing.assert_allclose(multiplier, expected, atol=1e-5)
    assert len({float(r.metrics["multiplier"][-1, 0]) for r in results}) == len(CHOICES)


def test_the_order_of_the_configurations_does_not_matter(results: list[Result]) -> None:
    for result, same in zip(results, reversed(train(*reversed(CHOICES))), strict=True):
        assert_same_bits((result.state, result.metrics), (same.state, same.metrics))


def test_a_run_begins_as_it_would_alone(results: list[Result]) -> None:
    """The same seeds; later, programs of other widths round differently."""
    alone = train(CHOICES[0])[0]
    for name, rows in alone.metrics.items():
        np.testing.assert_allclose(results[0].metrics[name][0], rows[0], rtol=1e-4, atol=1e-5, err_msg=name)


def test_stopped_and_resumed_together(results: list[Result], tmp_path: Path) -> None:
    train(*CHOICES, checkpoint_dir=tmp_path / "together", stop_after=10)
    resumed = train(*CHOICES, checkpoint_dir=tmp_path / "together", resume=True)
    for i, (result, same) in enumerate(zip(results, resumed, strict=True)):
        assert_same_bits((result.state, result.metrics), (same.state, same.metrics))
        runner.save(result, tmp_path / str(i))
        loaded = runner.load(result.config, Walk(), tmp_path / str(i), NUM_SEEDS)
        assert_same_bits(loaded.actor, result.actor)


@pytest.mark.parametrize(
    ("num_runs", "num_cores", "expected"), [(8, 4, 4), (3, 4, 3), (8, 1, 1), (8, 3, 4), (5, 4, 5), (7, 3, 1), (1, 4, 1)]
)
def test_devices_share_runs_evenly(num_runs: int, num_cores: int, expected: int) -> None:
    assert xla.num_cpu_devices(num_runs, num_cores) == expected


@pytest.mark.skipif(not hasattr(os, "SCHED_BATCH"), reason="Linux only")
def test_the_threads_of_a_training_are_scheduled_as_a_batch_job() -> None:
    script = (
        "import os; from experiments.cli import xla; xla.spread_seeds(2);"
        "import jax; before = set(os.listdir('/proc/self/task')); jax.numpy.ones(3).block_until_ready();"
        "started = set(os.listdir('/proc/self/task')) - before; assert started;"
        "print({os.sched_getscheduler(int(thread)) for thread in started} == {os.SCHED_BATCH})"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


def test_before_an_episode_has_ended_nothing_is_said_of_episodes() -> None:
    """`Counter` ends after 100 steps; an iteration takes 16, so the first whole episode ends in the seventh."""
    small = walk_config(method="trpo", env_steps=8 * 64)
    with quick_compilation():
        metrics = runner.train(small, Counter(max_episode_steps=100), num_seeds=2).metrics
    for name, value in (("episode_return", 100.0), ("episode_cost", 200.0), ("episode_length", 100.0)):
        assert np.isnan(metrics[name][:6]).all()
        np.testing.assert_array_equal(metrics[name][6:], np.full((2, 2), value))
    assert all(np.isfinite(rows).all() for name, rows in metrics.items() if name not in EPISODE_ESTIMATES)


def test_an_iteration_that_is_taken_back_ends_no_episode() -> None:
    history = {name: np.ones((4, 1), np.float32) for name in EPISODE_ESTIMATES}
    history |= {"episodes_finished": np.array([[0], [2], [0], [1]]), "skipped_updates": np.array([[0], [1], [1], [1]])}
    found = without_unknown(history)
    assert np.isnan(found["episode_cost"][:3, 0]).all()
    assert found["episode_cost"][3, 0] == 1
    assert found["episode_cost"].dtype == np.float32


def test_only_the_last_batch_of_an_iteration_is_kept() -> None:
    """No array of the program holds the steps of all generator steps, which at large sizes would be gigabytes."""
    config = build.resolve(walk_config(method="malm", generator_steps=3), Walk(), walk_demonstrations())
    agent = build.make(config, Walk(), expert_data(walk_demonstrations()))
    state = jax.eval_shape(agent.init, jax.random.key(0))
    shapes = {value.aval.shape for value in values_of(jax.make_jaxpr(agent.step)(state).jaxpr)}
    batch = (config.num_steps, config.num_envs)
    assert any(shape[:2] == batch for shape in shapes)
    assert not any(shape[:3] == (3, *batch) for shape in shapes)


def values_of(program: Any) -> Iterator[Any]:
    """All values of a jaxpr, those inside loops and calls included."""
    yield from (*program.invars, *program.outvars)
    for equation in program.eqns:
        yield from equation.outvars
        for inner in jax.tree.leaves(list(equation.params.values())):
            if hasattr(getattr(inner, "jaxpr", inner), "eqns"):
                yield from values_of(getattr(inner, "jaxpr", inner))


def test_verbose_shows_the_progress_on_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    """Not a terminal here, so that there is a line at the end. `on_progress` sees every chunk all the same."""
    seen: list[int] = []
    small = walk_config(method="trpo", env_steps=2 * 64)
    with quick_compilation():
        for verbose in (False, True):
            runner.train(small, Walk(), verbose=verbose, on_progress=lambda progress: seen.append(progress.iteration))
            out, err = capsys.readouterr()
            assert out == ""
            assert bool(err) == verbose
    assert seen[-1] == 2
    assert seen[: len(seen) // 2] == seen[len(seen) // 2 :]
    compiled, last = err.splitlines()
    assert re.fullmatch(r"compiled in \d+\.\d s", compiled)
    assert re.fullmatch(r"trpo Walk 2/2  return \S+  cost \S+  [\d,]+ steps/s.*", last)


def test_the_limit_is_shown_where_all_configurations_have_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    train(*CHOICES[:1], stop_after=1, verbose=True)  # one line, at the end of the training: not reached here
    assert capsys.readouterr().err.splitlines()[1:] == []
    for choices, shown in ((CHOICES[:1], "cost 2.00 / 1.00  lambda"), (CHOICES[:2], "cost 2.00  lambda")):
        train(*choices, verbose=True)
        assert shown in re.sub(r"cost \S+", "cost 2.00", capsys.readouterr().err)


def test_no_chunk_is_traced_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """One trace of the program and one of an iteration serve chunks of all lengths."""
    chex.clear_trace_counter()
    iteration = program._iteration

    def counted(env: Environment) -> program.Iteration:
        traced = iteration(env).__wrapped__  # type: ignore[attr-defined]  # the function that is jitted
        return jax.jit(chex.assert_max_traces(traced, n=1))

    monkeypatch.setattr(program, "_iteration", counted)
    monkeypatch.setattr(program, "_run_chunk", chex.assert_max_traces(program._run_chunk, n=1))
    lengths = []
    with quick_compilation():
        runner.train(
            walk_config(method="trpo"), Walk(), on_progress=lambda p: lengths.append(len(p.metrics["env_steps"]))
        )
    assert sum(lengths) == 20
    assert len(lengths) > 2
    assert len(set(lengths)) > 1
    with quick_compilation(), pytest.raises(AssertionError, match="traced > 1 times"):
        runner.train(walk_config(method="trpo"), Walk())  # a program of its own: the counters do count


def test_only_traced_fields_may_differ() -> None:
    with pytest.raises(ConfigError, match="hidden_sizes"):
        runner.train_runs([walk_config(method="trpo"), walk_config(method="trpo", hidden_sizes=(5,))], Walk())


def test_fields_that_agree_stay_numbers() -> None:
    shared, varied = combining.join([config(1.0, 0.1, 0.0), config(1.0, 0.2, 0.0)], num_seeds=2)
    assert shared.cost_limit == 1.0
    assert list(varied) == ["multiplier_learning_rate"]
    np.testing.assert_array_equal(varied["multiplier_learning_rate"], np.float32([0.1, 0.1, 0.2, 0.2]))
    assert combining.join([config(1.0, 0.1, 0.0)] * 2, num_seeds=2)[1] == {}
    assert isinstance(varied["multiplier_learning_rate"], jax.Array)


ON_FOUR_DEVICES = """
import json, sys, jax
from ccil_jax.acting import evaluation
from ccil_jax.agents import build
from ccil_jax.agents.expert import expert_data
from ccil_jax.training import combining, runner
from ccil_jax.training.program import compile_program
from tests.probe_envs import Walk, quick_compilation, same_bits, walk_config, walk_demonstrations

env, demonstrations = Walk(), walk_demonstrations()
expert, keys = expert_data(demonstrations), jax.random.split(jax.random.key(0), 5)
configs = [
    build.resolve(walk_config(method=sys.argv[1], critic_learning_rate=rate), env, demonstrations)
    for rate in (0.01, 0.02, 0.05)
]
shared, varied = combining.join(configs, num_seeds=2)
single = [compile_program(configs[0], env, expert, num_runs, one_by_one=True) for num_runs in (1, 5)]
together = compile_program(shared, env, expert, 6, varied=varied, one_by_one=True)
with quick_compilation():
    side_by_side = compile_program(shared, env, expert, 4, varied={k: v[:4] for k, v in varied.items()})

def train(program, keys):
    trained = program.chunk(program.init(keys))
    return [jax.tree.map(lambda leaf: leaf[i], trained) for i in range(len(keys))]

[alone], [first, *_, last] = train(single[0], keys[:1]), train(single[1], keys)
found = train(together, jax.numpy.tile(keys[::4], 3))
programs = (*single, together, side_by_side)
print(json.dumps({
    "devices": [len(program.state.agent.key.sharding.device_set) for program in programs],
    "evaluations": [
        len(evaluation._spread(lambda key: jax.random.normal(key), jax.random.split(keys[0], n)).sharding.device_set)
        for n in (1, 3, 6, 8)
    ],
    "alone": same_bits(alone, first),
    "same": [[same_bits(expected, run) for run in found] for expected in (first, last)],
    "collectives": [
        f"{name} of {i}" for name in ("all-reduce", "all-gather", "collective-permute", "all-to-all", "reduce-scatter")
        for i, program in enumerate(programs) if name in program.text()
    ],
}))
"""


@pytest.mark.parametrize("method", ["trpo", pytest.param("malm", marks=pytest.mark.slow)])
def test_devices_share_runs_without_a_word(method: str) -> None:
    """Four CPU devices: nothing travels between them; in turn, a run has the bits that it has on one, or alone."""
    environment = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=4", "PJRT_NPROC": "16"}
    environment["PYTHONPATH"] = str(Path(__file__).parent.parent)
    command = [sys.executable, "-c", ON_FOUR_DEVICES, method]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found.pop("same") == [[i == 0 for i in range(6)], [i == 1 for i in range(6)]]
    assert found == {"devices": [1, 1, 3, 4], "evaluations": [1, 3, 3, 4], "alone": True, "collectives": []}


def test_a_chunk_of_iterations_stays_on_its_device() -> None:
    """A compiled iteration over MJX physics does not speak to the host, and what it needs is refused from there."""
    env = envs.make("Swimmer", physics="mjx")
    small = build.resolve(walk_config(method="trpo"), env, None)
    with quick_compilation():
        program = compile_program(small, env, None, 1)
    calls = set(re.findall(r'custom_call_target="([^"]+)"', program.text()))
    assert calls <= {"lapack_spotrf_ffi", "lapack_strsm_ffi"}  # MJX factorises
    assert not re.findall(r" (infeed|outfeed|send|recv)\(", program.text())

    state, metrics = program.chunk(program.init(jax.random.split(jax.random.key(0), 1)), 1)
    assert np.isfinite(metrics["surrogate"]).all()
    fetched = dataclasses.replace(state, agent=dataclasses.replace(state.agent, cost_rate=np.zeros(1, np.float32)))
    with pytest.raises(Exception, match="Disallowed host-to-device transfer"):
        program.chunk(fetched)


def test_vectors_are_as_wide_as_the_processor_has_them_unless_the_user_says_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(xla, "_processor_features", lambda: "flags : sse2 avx512f avx512_bf16")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    xla.widen_vectors()
    xla.widen_vectors()
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_prefer_vector_width=512"
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    xla.widen_vectors()
    assert os.environ["XLA_FLAGS"].split() == [
        "--xla_force_host_platform_device_count=2",
        "--xla_cpu_prefer_vector_width=512",
    ]
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_prefer_vector_width=128")
    xla.widen_vectors()
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_prefer_vector_width=128"
    monkeypatch.setattr(xla, "_processor_features", lambda: "flags : sse2 avx512f")
    monkeypatch.delenv("XLA_FLAGS")
    xla.widen_vectors()
    assert "XLA_FLAGS" not in os.environ


def test_gpus_run_loops_as_graphs_unless_the_user_says_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    xla.tune_gpus()
    xla.tune_gpus()
    flags = ["--xla_gpu_enable_command_buffer=+WHILE", "--xla_gpu_enable_triton_gemm=false"]
    assert os.environ["XLA_FLAGS"].split() == flags
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_enable_command_buffer= --xla_cpu_prefer_vector_width=512")
    xla.tune_gpus()
    assert os.environ["XLA_FLAGS"].split() == [
        "--xla_gpu_enable_command_buffer=",
        "--xla_cpu_prefer_vector_width=512",
        flags[1],
    ]
    # XLA ends the process over a flag that it does not know; on a CPU too.
    monkeypatch.setenv("XLA_FLAGS", " ".join(flags))
    subprocess.run([sys.executable, "-c", "import jax; jax.numpy.ones(1).sum()"], check=True, capture_output=True)


def test_compiled_programs_are_kept_unless_the_user_says_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "mine")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_MAX_SIZE", "1")
    xla.keep_programs()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "mine"
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    xla.keep_programs()
    folder = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    assert folder.is_dir()
    assert folder.parent == tmp_path / "ccil_jax" / "programs"
    # A cache folder that cannot be made is no reason to stop.
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    xla.keep_programs()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
