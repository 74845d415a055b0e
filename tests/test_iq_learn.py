"""IQ-Learn: its loss by hand, its expert data, what its critic and policy converge to, and its state on disk."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from ccil_jax.acting import networks
from ccil_jax.acting.distributions import LARGEST_UNIT
from ccil_jax.agents import behavior_cloning, iq_learn
from ccil_jax.agents.expert import expert_data, expert_transitions
from ccil_jax.agents.iq_learn import Minibatch
from ccil_jax.config import CLONING_UPDATES_PER_ITERATION, Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.learning.optimizers import adam
from ccil_jax.training import runner
from envs.jax_tools import full_precision
from tests.probe_envs import Walk, assert_same_bits, quick_compilation, same_bits, walk_config, walk_demonstrations

pytestmark = pytest.mark.once


def iq_config(**changes: Any) -> Config:
    settings = {"method": "iq_learn", "generator_steps": 1, "replay_size": 64, "activation": "relu", "temperature": 0.1}
    return walk_config(**{**settings, **changes})


@pytest.mark.parametrize(
    ("kind", "value_term"), [("value", (1.0 + 0.0 - 1.0 + 3.0) / 4), ("v0", 0.1 * (4.0 + 6.0) / 2)]
)
def test_the_loss_by_hand(kind: str, value_term: float) -> None:
    """r = (1, 2, -1, 0): on the expert 1.5; mean r^2 = 6 / 4; alpha 0.5 makes its weight 1 / 2."""
    q, target = jnp.array([2.0, 2.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 1.0, 1.0])
    value = jnp.array([2.0, 0.0, 0.0, 4.0])
    config = iq_config(value_loss=kind, gamma=0.9, chi2_coefficient=0.5)
    found = iq_learn.loss(q, value, target, jnp.array([4.0, 6.0]), config)
    np.testing.assert_allclose(found, value_term - 1.5 + 1.5 / 2, rtol=1e-6)


def test_a_last_step_counts_only_where_the_task_ended() -> None:
    """Three episodes end after steps 2, 4 and 5 (exclusive); the first by termination."""
    demonstrations = Demonstrations(
        obs=np.arange(5.0, dtype=np.float32)[:, None] * [[1, 1]],
        actions=np.zeros((5, 1), np.float32),
        rewards=None,
        costs=np.zeros(5, np.float32),
        terminated=np.array([0, 1, 0, 0, 0], bool),
        truncated=np.array([0, 0, 0, 1, 1], bool),
        episode_ends=np.array([2, 4, 5]),
    )
    found = expert_transitions(demonstrations)
    np.testing.assert_array_equal(found.obs[:, 0], [0, 1, 2])
    np.testing.assert_array_equal(found.next_obs[[0, 2], 0], [1, 3])
    np.testing.assert_array_equal(found.terminated, [0, 1, 0])
    np.testing.assert_array_equal(found.initial_obs[:, 0], [0, 2, 4])


def test_one_state_has_a_known_solution() -> None:
    """A bandit: each step terminates, the expert always plays 0.5, the learner's steps are uniform.

    With y = 0 the loss is mean(V) - mean_E r + mean(r^2) / 2 over both sources, r = Q. Away from the expert's action Q
    is pressed below 0 by V, at it it is raised, and the policy settles where Q is highest. There the two cancel, so Q
    goes round its solution: looked at is its mean over time and eight learners.
    """
    env = Walk()
    config = iq_config(hidden_sizes=(32, 32), critic_learning_rate=3e-3, actor_learning_rate=3e-3, temperature=0.01)
    policy, critic = networks.make_squashed_policy(config, env), networks.make_scalar(config, 3)
    update = iq_learn.updates(config, policy, critic, 1)
    obs = jnp.zeros((128, 2))
    grid = jnp.linspace(-1, 1, 41)[:, None]

    def step(learner: iq_learn.Learner, key: jax.Array) -> tuple[iq_learn.Learner, Any]:
        action_key, step_key = jax.random.split(key)
        uniform = jax.random.uniform(action_key, (64, 1), minval=-1.0, maxval=1.0)
        action = jnp.concatenate([jnp.full((64, 1), 0.5), uniform])
        batch = Minibatch(obs=obs, action=action, next_obs=obs, terminated=jnp.ones(128), initial_obs=obs[:1])
        learner, metrics = update.step(learner, batch, step_key)
        q = critic.apply(learner.critic_params, jnp.concatenate([jnp.zeros((41, 2)), grid], axis=-1))
        return learner, (q, metrics)

    def learn(key: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
        init_key, steps_key = jax.random.split(key)
        learner, (q, metrics) = jax.lax.scan(step, update.init(init_key), jax.random.split(steps_key, 1500))
        return jnp.mean(q[500:], axis=0), policy.apply(learner.policy_params, obs[:1]).gaussian.mean, metrics

    q, played, metrics = jax.jit(jax.vmap(learn))(jax.random.split(jax.random.key(0), 8))
    at = {round(float(a), 2): float(value) for a, value in zip(grid[:, 0], jnp.mean(q, axis=0), strict=True)}
    assert max(at, key=at.__getitem__) == 0.5
    assert at[0.5] > 0.1
    assert max(at[0.4], at[0.6], at[0.75]) < -0.3
    np.testing.assert_allclose(np.tanh(played), 0.5, atol=0.15)
    assert all(np.isfinite(values).all() for values in metrics.values())


def train(directory: Path | None = None, num_seeds: int = 2, **options: Any) -> runner.Result:
    with quick_compilation():
        return runner.train(
            iq_config(env_steps=20 * 32, critic_minibatch_size=8),
            Walk(),
            walk_demonstrations(),
            num_seeds=num_seeds,
            checkpoint_dir=directory,
            **options,
        )


@pytest.fixture(scope="module")
def whole() -> runner.Result:
    return train()


def test_a_stopped_and_resumed_run_is_the_unbroken_run(whole: runner.Result, tmp_path: Path) -> None:
    train(tmp_path, stop_after=10)
    resumed = train(tmp_path, resume=True)
    assert_same_bits(resumed.state, whole.state)
    assert_same_bits({name: resumed.metrics[name] for name in whole.metrics}, whole.metrics)
    loaded = runner.load(iq_config(env_steps=20 * 32), Walk(), tmp_path, 2)
    assert_same_bits(loaded.actor, whole.actor)


def test_it_learns_from_every_step(whole: runner.Result) -> None:
    """20 iterations of 32 steps: as many updates, and the ring holds the last 64 true transitions."""
    assert (np.asarray(whole.state.agent.learner.policy_optimizer[0].count) == 20 * 32).all()
    ring = jax.tree.map(lambda leaf: np.asarray(leaf[0]), whole.state.agent.replay)
    assert ring.num_added == 20 * 32
    assert np.abs(ring.action).max() <= 1  # squashed into the range
    assert all(np.isfinite(rows).all() for rows in whole.metrics.values())
    assert not same_bits(ring, jax.tree.map(lambda leaf: np.asarray(leaf[1]), whole.state.agent.replay))


# The clone that it may begin with ------------------------------------------------------------------------------------


def policy_key(key: jax.Array) -> jax.Array:
    """The key of the first policy, from that of the agent."""
    return jax.random.split(jax.random.split(key, 3)[1])[0]


def test_the_first_policy_is_the_squashed_clone() -> None:
    """Three iterations of behaviour cloning on observations as they are, to the last bit; then it learns as ever."""
    updates = 2 * CLONING_UPDATES_PER_ITERATION + 1
    config = iq_config(cloning_updates=updates, actor_learning_rate=1e-3, critic_minibatch_size=8)
    expert, key = expert_data(walk_demonstrations()), jax.random.key(5)
    assert expert is not None
    policy = networks.make_squashed_policy(config, Walk())
    agent = iq_learn.make(config, Walk(), expert)
    cloning = behavior_cloning.descent(config, policy, expert, None, adam)
    with quick_compilation():
        state = jax.jit(full_precision(agent.init))(key)
        learnt, step = jax.jit(full_precision(cloning.init))(policy_key(key)), jax.jit(full_precision(cloning.step))
        actors = [learnt.actor]
        for _ in range(3):
            learnt, _ = step(learnt)
            actors.append(learnt.actor)
        after, metrics = jax.jit(full_precision(agent.step))(state)
    assert_same_bits(state.actor, actors[3])
    assert not same_bits(state.actor, actors[2])
    assert state.actor.obs_statistics is None
    assert not same_bits(after.actor, state.actor)
    assert all(np.isfinite(value).all() for value in metrics.values())
    # The likelihood that chose it is that of the held-out actions as they were executed, by SciPy.
    gaussian = policy.apply(state.actor.policy_params, expert.held_out_obs).gaussian
    unit = np.clip(np.asarray(expert.held_out_action, np.float64), -LARGEST_UNIT, LARGEST_UNIT)
    density = scipy.stats.norm.logpdf(np.arctanh(unit), gaussian.mean, np.exp(gaussian.log_std)) - np.log(1 - unit**2)
    np.testing.assert_allclose(learnt.held_out_loss, -np.mean(density.sum(axis=-1)), rtol=1e-4)


def test_without_cloning_the_first_policy_is_a_random_one() -> None:
    config, key = iq_config(), jax.random.key(4)
    agent = iq_learn.make(config, Walk(), expert_data(walk_demonstrations()))
    expected = networks.make_squashed_policy(config, Walk()).init(policy_key(key))
    assert_same_bits(agent.init(key).actor.policy_params, expected)


def test_the_squashed_clone_finds_the_expert() -> None:
    """Actions tanh(0.1 + SLOPE . obs + 0.3 noise); observations far from standard, as the policy gets them raw."""
    rng, slope = np.random.default_rng(0), np.array([0.5, -0.3])
    obs = np.array([1.0, -2.0]) + rng.normal(size=(2000, 2))
    middle = 0.1 + obs @ slope
    actions = np.tanh(middle + 0.3 * rng.normal(size=2000))[:, None]
    demonstrations = dataclasses.replace(
        walk_demonstrations(),
        obs=obs.astype(np.float32),
        actions=actions.astype(np.float32),
        costs=np.zeros(2000, np.float32),
        terminated=np.zeros(2000, bool),
        truncated=np.arange(2000) % 5 == 4,
        episode_ends=np.arange(5, 2001, 5),
    )
    config = iq_config(cloning_updates=2000, actor_learning_rate=3e-3, critic_minibatch_size=64, hidden_sizes=(16,))
    state = jax.jit(iq_learn.make(config, Walk(), expert_data(demonstrations)).init)(jax.random.key(0))
    policy = networks.make_squashed_policy(config, Walk())
    gaussian = policy.apply(state.actor.policy_params, jnp.asarray(obs, jnp.float32)).gaussian
    usual = np.abs(obs - [1.0, -2.0]).max(axis=1) < 2
    assert np.sqrt(np.mean((gaussian.mean[:, 0] - middle)[usual] ** 2)) < 0.05
    np.testing.assert_allclose(np.exp(gaussian.log_std[usual]).mean(), 0.3, rtol=0.1)
