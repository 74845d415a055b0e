"""The average of policies that is judged in the place of the newest: its weights, and that it changes nothing else."""

import dataclasses
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ccil_jax
from ccil_jax.agents import build
from ccil_jax.agents.base import polynomial_decay_mean
from ccil_jax.agents.on_policy import AgentState
from ccil_jax.config import validate
from ccil_jax.errors import ConfigError
from ccil_jax.training.runner import load
from tests.probe_envs import Walk, assert_same_bits, quick_compilation, same_bits, walk_config, walk_demonstrations

pytestmark = pytest.mark.once


def rising_factorial(k: int, power: int) -> float:
    return float(np.prod([k + i for i in range(power)]))


@pytest.mark.parametrize("power", [0, 1, 3, 6])
def test_value_k_weighs_k_to_the_power(power: int) -> None:
    values = np.random.default_rng(0).normal(size=30)
    mean = jnp.asarray(7.0)  # of no values: it must not matter
    for k, value in enumerate(values, start=1):
        mean = polynomial_decay_mean(mean, jnp.asarray(value), count=jnp.asarray(k), power=power)
        weights = [rising_factorial(i, power) for i in range(1, k + 1)]
        np.testing.assert_allclose(mean, np.average(values[:k], weights=weights), rtol=1e-5, atol=1e-6)


def states(length: int, **changes: Any) -> list[AgentState]:
    """Before the first iteration, and after each. No clone comes first: it would be an average of its own."""
    demonstrations = walk_demonstrations()
    config = build.resolve(walk_config(method="malm", **changes), Walk(), demonstrations)
    with quick_compilation():
        agent = build.make_agent(config, Walk(), demonstrations)
        found = [jax.jit(agent.init)(jax.random.key(2))]
        step = jax.jit(agent.step)
        for _ in range(length):
            found.append(step(found[-1])[0])
    return found


def as_arrays(state: AgentState) -> AgentState:
    """With the bits of its random key, which cannot be subtracted."""
    return dataclasses.replace(state, key=jax.random.key_data(state.key))


def test_what_is_judged_is_the_average_and_all_else_is_as_without() -> None:
    plain = states(4, generator_steps=2)
    found = states(4, generator_steps=2, policy_average="polynomial_decay", policy_average_power=2.0)
    for state, without in zip(found, plain, strict=True):  # but for rounding: two programs may fuse differently
        assert type(without) is AgentState  # whose checkpoints are those of versions that could not average
        same = {field.name: getattr(state, field.name) for field in dataclasses.fields(without)}
        same_training = AgentState(**same | {"actor": state.learner})
        chex.assert_trees_all_close(as_arrays(same_training), as_arrays(without), rtol=1e-4, atol=1e-6)
    chex.assert_trees_all_close(found[1].actor, found[1].learner, rtol=1e-6)
    assert not same_bits(found[2].actor, found[2].learner)
    weights = [rising_factorial(k, 2) for k in range(1, 5)]
    expected = jax.tree.map(
        lambda *leaves: np.average(leaves, axis=0, weights=weights), *(s.actor.policy_params for s in plain[1:])
    )
    chex.assert_trees_all_close(found[4].actor.policy_params, expected, rtol=1e-4, atol=1e-6)


def test_the_average_is_kept_when_a_run_is_resumed_and_is_what_a_checkpoint_gives(tmp_path: Path) -> None:
    config = walk_config(
        method="gail", policy_average="polynomial_decay", env_steps=4 * walk_config().steps_per_iteration
    )
    whole, halves = tmp_path / "whole", tmp_path / "halves"

    def train(folder: Path, **settings: Any) -> ccil_jax.Result:
        return ccil_jax.train(config, Walk(), walk_demonstrations(), num_seeds=2, checkpoint_dir=folder, **settings)

    with quick_compilation():
        unbroken = train(whole)
        train(halves, stop_after=2)
        resumed = train(halves, resume=True)
    assert_same_bits(resumed.state, unbroken.state)
    agent = unbroken.state.agent
    assert not same_bits(agent.actor, agent.learner)
    assert_same_bits(load(unbroken.config, Walk(), whole, 2).actor, agent.actor)
    assert_same_bits(unbroken.actor, agent.actor)


def test_a_power_without_an_average_is_refused() -> None:
    with pytest.raises(ConfigError, match="policy_average_power"):
        validate(ccil_jax.Config(policy_average_power=2.0))
