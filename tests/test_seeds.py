"""Seeds: vmapped, reproducible, independent of one another, and one compilation per program."""

import dataclasses
from collections import Counter
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import pytest

from ccil_jax.agents import build, on_policy
from ccil_jax.agents.expert import expert_data
from ccil_jax.training.guard import GuardedState
from ccil_jax.training.program import Program, compile_program
from ccil_jax.types import Metrics
from envs.base import State
from tests.probe_envs import Walk, quick_compilation, same_bits, walk_config, walk_demonstrations

pytestmark = pytest.mark.once

NUM_SEEDS = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class TracedWalk(Walk):
    """Counts how often its step is traced."""

    traces: list[int] = dataclasses.field(default_factory=list)

    def step(self, state: State, action: jax.Array) -> State:
        self.traces.append(1)
        return super().step(state, action)


class Compilations:
    """Names of the functions that XLA compiled while this listened."""

    def __init__(self) -> None:
        self.names: Counter[str] = Counter()

    def __call__(self, event: str, duration: float, **details: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            self.names[str(details.get("fun_name"))] += 1


@pytest.fixture
def compilations() -> Iterator[Compilations]:
    listener = Compilations()
    jax.monitoring.register_event_duration_secs_listener(listener)
    yield listener
    jax.monitoring.unregister_event_duration_listener(listener)


@dataclasses.dataclass(frozen=True)
class Compiled:
    """A malm program, and what compiling it took."""

    program: Program
    compilations: Counter[str]
    traces: int
    env: TracedWalk


@pytest.fixture(scope="module")
def compiled() -> Compiled:
    env, demonstrations, listener = TracedWalk(), walk_demonstrations(), Compilations()
    config = build.resolve(walk_config(method="malm"), env, demonstrations)
    expert = expert_data(demonstrations)
    jax.monitoring.register_event_duration_secs_listener(listener)
    program = compile_program(config, env, expert, NUM_SEEDS)
    jax.monitoring.unregister_event_duration_listener(listener)
    return Compiled(program, listener.names, len(env.traces), env)


def run(program: Program, keys: jax.Array) -> tuple[GuardedState, list[Metrics]]:
    """Two chunks: 20 iterations."""
    state, history = program.init(keys), []
    for _ in range(2):
        state, metrics = program.chunk(state)
        history.append(metrics)
    return state, history


def seeds(number: int) -> jax.Array:
    return jax.random.split(jax.random.key(number), NUM_SEEDS)


def one_seed(tree: Any, index: int) -> Any:
    return jax.tree.map(lambda x: x[index], tree)


def test_the_same_seeds_give_the_same_bits(compiled: Compiled) -> None:
    first, second = (run(compiled.program, seeds(0)) for _ in range(2))
    assert same_bits(first, second)
    assert all(np.isfinite(value).all() for metrics in first[1] for value in jax.tree.leaves(metrics))


def test_other_seeds_give_other_bits(compiled: Compiled) -> None:
    state, history = run(compiled.program, seeds(0))
    policies = [one_seed(state.actor, i) for i in range(NUM_SEEDS)] + [
        one_seed(run(compiled.program, seeds(1))[0].actor, 0)
    ]
    assert not any(same_bits(a, b) for i, a in enumerate(policies) for b in policies[:i])
    assert len(np.unique(np.asarray(history[-1]["episode_return"])[:, -1])) == NUM_SEEDS


def test_seeds_do_not_touch_one_another(compiled: Compiled) -> None:
    """A seed's result is the same bits in whatever place and company it runs."""
    keys, others = seeds(0), seeds(1)
    state, history = run(compiled.program, keys)
    moved, moved_history = run(compiled.program, jax.numpy.stack([others[0], others[1], keys[0]]))
    assert same_bits(one_seed(state, 0), one_seed(moved, 2))
    assert same_bits(one_seed(history, 0), one_seed(moved_history, 2))


def test_a_program_is_two_functions_compiled_once_each(compiled: Compiled, compilations: Compilations) -> None:
    """Initialisation and a chunk of iterations; running them any number of times compiles and traces nothing more."""
    assert sum(compiled.compilations.values()) == 2, compiled.compilations
    assert set(compiled.compilations.values()) == {1}
    assert compiled.traces == 1
    keys = seeds(2)
    compilations.names.clear()
    state = compiled.program.init(keys)
    for _ in range(3):
        state, _ = compiled.program.chunk(state)
    compiled.program.init(keys)
    assert not compilations.names
    assert len(compiled.env.traces) == 1


def test_every_random_key_is_consumed_once() -> None:
    """JAX's own check, on keys within the program and on those that one iteration hands to the next."""
    demonstrations = walk_demonstrations()
    config = build.resolve(walk_config(method="malm"), Walk(), demonstrations)
    agent = on_policy.make(config, Walk(), expert_data(demonstrations))
    with jax.debug_key_reuse(True), quick_compilation():
        state, step = jax.jit(agent.init)(jax.random.key(0)), jax.jit(agent.step)
        for _ in range(2):
            state, _ = step(state)


@pytest.mark.parametrize("regularizer", ["gradient_penalty", "spectral_norm"])
def test_no_seed_waits_for_anothers_thread(regularizer: str) -> None:
    """Batched LAPACK kernels on the CPU wait for helpers from the pool that they occupy; with few threads, for ever."""
    config, env = walk_config(method="malm", discriminator_regularizer=regularizer).replace(cost_limit=1.0), Walk()
    expert = expert_data(walk_demonstrations())
    agent = on_policy.make(config, env, expert)
    init = str(jax.make_jaxpr(jax.vmap(agent.init))(jax.random.split(jax.random.key(0), 2)))
    step = str(jax.make_jaxpr(agent.step)(jax.eval_shape(agent.init, jax.random.key(0))))
    for kernel in ("geqrf", "householder_product", "qr[", "svd[", "eigh[", "cholesky[", "lu["):
        assert kernel not in init + step
