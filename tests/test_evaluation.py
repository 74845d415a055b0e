"""Evaluation: every seed plays episodes of its own, whatever else is evaluated beside it."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ccil_jax.acting import evaluation, networks, rollout, running_statistics
from ccil_jax.acting.evaluation import Evaluation
from ccil_jax.acting.rollout import Actor
from envs.base import State
from tests.probe_envs import Walk, assert_same_bits, walk_config

CONFIG = walk_config(method="trpo")


def actor(num_seeds: int) -> Actor:
    """The same policy for every seed, so that only the episodes can differ."""
    policy = networks.make_policy(CONFIG, Walk().obs_dim, Walk().action_dim)
    one = Actor(policy_params=policy.init(jax.random.key(1)), obs_statistics=running_statistics.init(Walk().obs_dim))
    return jax.tree.map(lambda leaf: np.stack([leaf] * num_seeds), one)


def evaluate(num_seeds: int, **settings: Any) -> Evaluation:
    return evaluation.evaluate(CONFIG, actor(num_seeds), Walk(), num_episodes=8, seed=3, **settings)


@pytest.fixture(scope="module")
def three() -> Evaluation:
    return evaluate(3)


def test_every_seed_plays_episodes_of_its_own(three: Evaluation) -> None:
    assert three.episode_return.shape == (3, 8)
    assert np.unique(three.episode_return).size == 3 * 8  # no episode twice


def test_a_seeds_episodes_do_not_depend_on_the_others(three: Evaluation) -> None:
    np.testing.assert_allclose(evaluate(1).episode_return[0], three.episode_return[0], rtol=1e-5)
    np.testing.assert_allclose(evaluate(1, draws=[2]).episode_return[0], three.episode_return[2], rtol=1e-5)


def test_seeds_with_the_same_draw_play_the_same_episodes(three: Evaluation) -> None:
    shared = evaluate(3, draws=[0, 0, 0])
    for name in ("episode_return", "episode_cost", "episode_length"):
        rows = getattr(shared, name)
        np.testing.assert_array_equal(rows, np.stack([rows[0]] * 3))
        np.testing.assert_allclose(rows[0], getattr(three, name)[0], rtol=1e-5)


def test_a_policy_acts_as_its_training_says_unless_told_otherwise(three: Evaluation) -> None:
    """Modes are the same for all noise: recorded actions are then a function of the observations."""
    by_mode = CONFIG.replace(evaluated_action="mode")
    settings: dict[str, Any] = {"num_episodes": 8, "seed": 3}
    modes = evaluation.evaluate(by_mode, actor(3), Walk(), **settings)
    assert_same_bits(modes, evaluate(3, deterministic=True))
    assert_same_bits(evaluation.evaluate(by_mode, actor(3), Walk(), deterministic=False, **settings), three)
    assert not np.allclose(modes.episode_return, three.episode_return)

    one = jax.tree.map(lambda leaf: leaf[0], actor(1))
    policy = networks.make_policy(CONFIG, Walk().obs_dim, Walk().action_dim)
    for config, is_mode in ((by_mode, True), (CONFIG, False)):
        found = evaluation.record(config, one, Walk(), **settings)
        mode = rollout.act(policy.apply, one, jnp.asarray(found.obs), jnp.zeros_like(jnp.asarray(found.actions)))
        executed = np.clip(mode, Walk().action_low, Walk().action_high)
        assert np.allclose(found.actions, executed, atol=1e-6) == is_mode


def test_a_recording_ends_with_the_observation_after_the_last_step() -> None:
    """The task's position is its reward, and its second number changes its sign in every step."""
    one = jax.tree.map(lambda leaf: leaf[0], actor(1))
    found = evaluation.record(CONFIG, one, Walk(), num_episodes=64, seed=3)
    last = found.episode_ends - 1
    assert found.terminated[last].any()
    assert found.truncated[last].any()
    rewards = np.asarray(found.rewards)
    np.testing.assert_array_equal(found.final_obs, np.stack([rewards[last], -found.obs[last, 1]], axis=1))


def test_the_random_policys_episodes_do_not_depend_on_how_they_are_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    """On 1 device and, as far as the padding goes, on 3; an episode's draws follow from its number alone."""
    few, many = (evaluation.random_policy(Walk(), num_episodes=count, seed=5) for count in (4, 7))
    assert many.episode_return.shape == (1, 7)
    assert np.unique(many.episode_return).size == 7
    np.testing.assert_allclose(few.episode_return, many.episode_return[:, :4], rtol=1e-5)
    monkeypatch.setattr(evaluation, "usable_devices", lambda: [None] * 3)
    assert_same_bits(evaluation.random_policy(Walk(), num_episodes=7, seed=5), many)


@dataclasses.dataclass(frozen=True)
class Column(Walk):
    """Returns its reward as [1] instead of []."""

    def step(self, state: State, action: jax.Array) -> State:
        stepped = super().step(state, action)
        return dataclasses.replace(stepped, reward=stepped.reward[None])


def test_what_a_policy_or_an_environment_returns_must_have_the_right_shape() -> None:
    """A column in the place of numbers would be broadcast without an error."""
    with pytest.raises(AssertionError, match="shape"):
        evaluation.run_episodes(Column(), lambda obs, key: jnp.zeros((len(obs), 1)), 2, jax.random.key(0))
    with pytest.raises(ValueError, match="shape"):
        evaluation.run_episodes(Walk(), lambda obs, key: jnp.zeros((len(obs), 3)), 2, jax.random.key(0))
    policy = networks.make_policy(CONFIG, Walk().obs_dim, 3)
    three = Actor(policy_params=policy.init(jax.random.key(1)), obs_statistics=None)
    for env, apply, params in (
        (Walk(), policy.apply, three),
        (Column(), networks.make_policy(CONFIG, 2, 1).apply, jax.tree.map(lambda leaf: leaf[0], actor(1))),
    ):
        with pytest.raises(AssertionError, match="shape"):
            rollout.rollout(env, apply, params, rollout.init(env, 2, jax.random.key(0)), 3, jax.random.key(1))


def test_an_evaluation_tells_how_far_it_is() -> None:
    told: list[tuple[int, int]] = []
    evaluate(1, on_progress=lambda done, total: told.append((done, total)))
    length = Walk().max_episode_steps
    assert told[-1] == (length, length)
    assert len(told) > 1
    assert np.unique(np.diff([0, *(done for done, _ in told)])).size == 1
