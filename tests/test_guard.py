"""Numbers that go wrong: the iteration is taken back, counted, and no other seed notices.

Faults enter as NaN or infinity through the environment or through a traced learning rate, in one vmapped seed.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from ccil_jax.agents import build, on_policy
from ccil_jax.agents.expert import expert_data
from ccil_jax.agents.on_policy import Agent
from ccil_jax.training import guard
from ccil_jax.training.guard import GuardedState
from envs.jax_tools import is_key
from tests.probe_envs import Walk, assert_same_bits, quick_compilation, same_bits, walk_config, walk_demonstrations

LIMIT = 3  # iterations in a row
NUM_SEEDS = 3
VICTIM = 1


@struct.dataclass(kw_only=True)
class Fault:
    """What is added to each quantity: 0 for none."""

    reward: Any = 0.0
    cost: Any = 0.0
    observation: Any = 0.0
    physics: Any = 0.0
    critic_learning_rate: Any = 0.0
    discriminator_learning_rate: Any = 0.0
    multiplier_learning_rate: Any = 0.0
    meta_learning_rate: Any = 0.0


RATES = [field.name for field in dataclasses.fields(Fault) if field.name.endswith("rate")]


@dataclasses.dataclass(frozen=True, kw_only=True)
class FaultyWalk(Walk):
    """Adds the fault in every step of positive x."""

    fault: Fault = dataclasses.field(default_factory=Fault)

    def observe(self, physics: jax.Array) -> jax.Array:
        return physics + self.fault.observation

    def advance(self, physics: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        physics, reward, cost, terminated = super().advance(physics, action)
        return physics + self.fault.physics, reward + self.fault.reward, cost + self.fault.cost, terminated


class Stepper(NamedTuple):
    """Seeds with faults of their own."""

    init: Any
    step: Any  # state [S], Fault [S] -> state, metrics


@pytest.fixture(scope="module")
def stepper() -> Stepper:
    demonstrations = walk_demonstrations()
    config = build.resolve(walk_config(method="malm"), Walk(), demonstrations)
    expert = expert_data(demonstrations)

    def make(fault: Fault) -> Agent:
        rates = {name: getattr(config, name) + getattr(fault, name) for name in RATES}
        return guard.protect(on_policy.make(config.replace(**rates), FaultyWalk(fault=fault), expert), LIMIT)

    with quick_compilation():
        keys = jax.random.split(jax.random.key(0), NUM_SEEDS)
        state = jax.jit(jax.vmap(make(Fault()).init))(keys)
        step = jax.jit(jax.vmap(lambda state, fault: make(fault).step(state)))
        compiled = step.lower(state, faults()).compile()
    for _ in range(2):
        state, _ = compiled(state, faults())
    return Stepper(state, compiled)


def faults(**values: float) -> Fault:
    """Faults of the victim alone."""
    chosen = np.zeros(NUM_SEEDS, np.float32)
    fault = Fault(**{field.name: jnp.asarray(chosen) for field in dataclasses.fields(Fault)})
    for name, value in values.items():
        chosen[VICTIM] = value
        fault = dataclasses.replace(fault, **{name: jnp.asarray(chosen)})
    return fault


def of(tree: Any, seed: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[seed], tree)


def without_keys(tree: Any) -> list[Any]:
    return [leaf for leaf in jax.tree.leaves(tree) if not is_key(leaf)]


CASES = [(field.name, value) for field in dataclasses.fields(Fault) for value in (np.nan, np.inf)]
# An infinite rate may be no fault: it takes the multiplier to an end of its range.
CASES = [
    (name, value)
    for name, value in CASES
    if name not in ("multiplier_learning_rate", "meta_learning_rate") or value != np.inf
]


@pytest.mark.parametrize(("name", "value"), CASES)
def test_a_faulty_iteration_is_taken_back(stepper: Stepper, name: str, value: float) -> None:
    before: GuardedState = stepper.init
    healthy, healthy_metrics = stepper.step(before, faults())
    state, metrics = stepper.step(before, faults(**{name: value}))
    assert state.skipped.tolist() == metrics["skipped_updates"].tolist() == [0, 1, 0]
    assert state.skipped_in_a_row.tolist() == [0, 1, 0]
    assert_same_bits(without_keys(of(state.agent, VICTIM)), without_keys(of(before.agent, VICTIM)))
    assert not same_bits(of(state.agent.key, VICTIM), of(before.agent.key, VICTIM))
    for seed in (0, 2):
        assert_same_bits(of(state, seed), of(healthy, seed))
        assert_same_bits(of(metrics, seed), of(healthy_metrics, seed))
    recovered, _ = stepper.step(state, faults())
    assert recovered.skipped.tolist() == [0, 1, 0]
    assert recovered.skipped_in_a_row.tolist() == [0, 0, 0]
    assert not same_bits(of(recovered.actor, VICTIM), of(before.actor, VICTIM))


def test_a_seed_that_cannot_recover_stops_where_its_fault_can_be_replayed(stepper: Stepper) -> None:
    fault, state, healthy = faults(cost=np.nan), stepper.init, stepper.init
    states = []
    for _ in range(LIMIT + 2):
        state, _ = stepper.step(state, fault)
        healthy, _ = stepper.step(healthy, faults())
        states.append(state)
    assert [int(s.skipped[VICTIM]) for s in states] == [1, 2, 3, 3, 3]
    assert guard.stopped(state, LIMIT).tolist() == [False, True, False]
    assert_same_bits(of(states[LIMIT - 1], VICTIM), of(state, VICTIM))
    # The key is the one that the last faulty iteration began with.
    assert_same_bits(of(states[LIMIT - 1].agent.key, VICTIM), of(states[LIMIT - 2].agent.key, VICTIM))
    for seed in (0, 2):
        assert_same_bits(of(state, seed), of(healthy, seed))
    # Stopped for good, also where the fault is gone.
    later, _ = stepper.step(state, faults())
    assert_same_bits(of(later, VICTIM), of(state, VICTIM))


def test_an_engines_infinities_are_its_own() -> None:
    tree = {"physics": jnp.zeros(2), "other": jnp.array([jnp.inf, 1.0]), "count": jnp.zeros((), jnp.int32)}
    state = struct.dataclass(type("S", (), {"__annotations__": {"physics": Any, "other": Any}}))
    before = state(tree["physics"], tree["other"])
    assert bool(guard.stays_finite(before, state(jnp.full(2, jnp.inf), tree["other"])))
    assert not bool(guard.stays_finite(before, state(tree["physics"], jnp.array([jnp.inf, jnp.nan]))))
    assert guard.not_finite(tree) == ["other"]
