"""JAX's strict modes: whoever switches one on, to look for mistakes of their own, is not stopped by ours."""

import contextlib
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ccil_jax
import envs
from ccil_jax.acting import evaluation
from ccil_jax.agents import build
from ccil_jax.agents.expert import expert_data
from ccil_jax.training import guard
from envs.adapters import GymnasiumVectorEnv
from tests.probe_envs import Walk, quick_compilation, walk_config, walk_demonstrations

pytestmark = pytest.mark.once

LEARNERS: dict[str, dict[str, Any]] = {
    "malm": {"method": "malm", "held_out_unit": "trajectory"},
    "malm, other choices": {
        "method": "malm",
        "discriminator_regularizer": "gradient_penalty",
        "outer_advantage": "re-evaluated",
        "multiplier_update": "sgd",
        "meta_update": "sgd",
    },
    "cvag": {"method": "cvag"},
    "cvag by episode": {"method": "cvag", "gate": "episode"},
    "ccil": {"method": "ccil", "discriminator_regularizer": "spectral_norm"},
    "cpo_il": {"method": "cpo_il"},
    "pid_il": {"method": "pid_il"},
    "bc": {"method": "bc", "cloning_updates": 200},
    "a clone": {
        "method": "malm",
        "cloning_updates": 200,
        "warmup_iterations": 1,
        "cloning_weight": 0.1,
        "action_likelihood": "censored",
        "outer_loss": "lagrangian",
        "multiplier_update": "sgd",
        "gap_unit": "limit",
    },
    "the coherent reward": {"method": "ccil", "cloning_updates": 200, "imitation_reward": "coherent"},
    "iq_learn": {"method": "iq_learn", "critic_minibatch_size": 8},
    "iq_learn from a clone": {"method": "iq_learn", "critic_minibatch_size": 8, "cloning_updates": 200},
    "expert": {"method": "expert", "cost_limit": 2.0},
}
# One robot of each kind, every aim, every sort of reward term.
TASKS = ("Swimmer", "Hopper", "Humanoid", "PointGoal1", "CarPush1", "DoggoButton1")


@contextlib.contextmanager
def strict_tracing(x64: bool) -> Iterator[None]:
    """All modes whose errors JAX raises while it traces: types, ranks, and random keys that are used twice.

    With 64 bits the types may mix: demonstrations and actions have 32.
    """
    with (
        jax.numpy_dtype_promotion("standard" if x64 else "strict"),
        jax.numpy_rank_promotion("raise"),
        jax.debug_key_reuse(True),
        jax.enable_x64(x64),
    ):
        yield


@pytest.mark.parametrize(
    ("name", "x64"),
    [*((name, False) for name in LEARNERS), *((name, True) for name in ("malm", "a clone", "iq_learn"))],
)
def test_learners_mix_neither_types_nor_ranks_and_use_keys_once(name: str, x64: bool) -> None:
    env, choices = Walk(), LEARNERS[name]
    with strict_tracing(x64):
        demonstrations = None if choices["method"] == "expert" else walk_demonstrations()
        config = build.resolve(walk_config(**choices), env, demonstrations)
        agent = guard.protect(build.make(config, env, expert_data(demonstrations)), config.max_skipped_updates)
        state = jax.eval_shape(jax.vmap(agent.init), jax.random.split(jax.random.key(0), 2))
        after, _ = jax.eval_shape(jax.vmap(agent.step), state)
    assert jax.tree.map(_form, after) == jax.tree.map(_form, state)


def _form(leaf: Any) -> tuple[Any, Any]:
    return leaf.shape, leaf.dtype


@pytest.mark.parametrize(("name", "x64"), [*((name, False) for name in TASKS), ("Swimmer", True), ("PointGoal1", True)])
def test_tasks_mix_neither_types_nor_ranks_and_use_keys_once(name: str, x64: bool) -> None:
    with strict_tracing(x64):
        env = envs.make(name, physics="native")
        state = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), 2))
        after = jax.eval_shape(jax.vmap(env.step), state, jax.ShapeDtypeStruct((2, env.action_dim), jnp.float32))
    assert jax.tree.map(_form, after) == jax.tree.map(_form, state)


def test_mjx_keeps_its_own_rules() -> None:
    with strict_tracing(x64=False):
        env = envs.make("Swimmer", physics="mjx")
        state = jax.eval_shape(env.reset, jax.random.key(0))
        after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((2,), jnp.float32))
    assert after.obs.shape == (8,)


def test_evaluation_mixes_neither_types_nor_ranks() -> None:
    with strict_tracing(x64=False):
        found = jax.eval_shape(
            lambda key: evaluation.run_episodes(Walk(), lambda obs, key: jax.random.normal(key, (len(obs), 1)), 3, key),
            jax.random.key(0),
        )
    assert found.action.shape == (7, 3, 1)


def test_a_policy_whose_actions_lack_an_axis_is_refused() -> None:
    with pytest.raises(ValueError, match=r"Walk: an action must have shape \(1,\), but has shape \(\)"):
        jax.eval_shape(
            lambda key: evaluation.run_episodes(Walk(), lambda obs, key: jnp.zeros(len(obs)), 3, key),
            jax.random.key(0),
        )


def test_training_makes_no_nan_and_no_transfer_that_was_not_meant() -> None:
    config = walk_config(method="malm", env_steps=2 * 64)
    with quick_compilation(), jax.debug_nans(True), jax.transfer_guard("disallow"):
        result = ccil_jax.train(config, Walk(), walk_demonstrations())
        found = ccil_jax.evaluate(result.config, result.actor, Walk(), num_episodes=3)
    assert result.metrics["skipped_updates"].max() == 0
    assert found.episode_length.shape == (1, 3)


def test_a_task_makes_no_nan_and_no_transfer_that_was_not_meant() -> None:
    env = GymnasiumVectorEnv(envs.make("PointGoal1", physics="native", max_episode_steps=2), 2)
    with jax.debug_nans(True), jax.transfer_guard("disallow"):
        env.reset(seed=0)
        for _ in range(2):
            obs, *_, info = env.step(np.zeros((2, 2), np.float32))
    assert np.isfinite(obs).all()
    assert info["_final_obs"].all()
