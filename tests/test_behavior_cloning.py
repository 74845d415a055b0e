"""Behaviour cloning on demonstrations whose best policy is known."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from ccil_jax.acting import networks
from ccil_jax.acting.running_statistics import normalize
from ccil_jax.agents import behavior_cloning, build
from ccil_jax.agents.expert import expert_data
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.training import runner
from tests.probe_envs import Walk, assert_same_bits, numpy_policy, quick_compilation, walk_config, walk_demonstrations

pytestmark = pytest.mark.once

SLOPE, STD = np.array([0.5, -0.3]), 0.2


def linear_expert(num_steps: int) -> Demonstrations:
    """Actions drawn from N(0.1 + SLOPE . obs, STD^2), in episodes as long as those of `Walk`."""
    rng = np.random.default_rng(0)
    ends = np.append(np.arange(Walk.max_episode_steps, num_steps, Walk.max_episode_steps), num_steps)
    obs = rng.normal(size=(num_steps, 2))
    actions = 0.1 + obs @ SLOPE[:, None] + STD * rng.normal(size=(num_steps, 1))
    return dataclasses.replace(
        walk_demonstrations(),
        obs=obs.astype(np.float32),
        actions=actions.astype(np.float32),
        costs=np.zeros(num_steps, np.float32),
        terminated=np.zeros(num_steps, bool),
        truncated=np.isin(np.arange(num_steps), ends - 1),
        episode_ends=ends,
    )


def clone(demonstrations: Demonstrations, num_seeds: int = 1, **changes: Any) -> runner.Result:
    config = walk_config(method="bc", hidden_sizes=(16,), critic_minibatch_size=32, **changes)
    return runner.train(config, Walk(), demonstrations, num_seeds=num_seeds)


def test_it_finds_the_mean_and_the_deviation_of_a_gaussian_expert() -> None:
    demonstrations = linear_expert(4000)
    result = clone(demonstrations, cloning_updates=4_500, actor_learning_rate=3e-3)
    actor = jax.tree.map(lambda leaf: leaf[0], result.actor)
    mean, log_std = numpy_policy(actor.policy_params, normalize(actor.obs_statistics, jnp.asarray(demonstrations.obs)))
    truth = 0.1 + demonstrations.obs @ SLOPE
    common = np.abs(demonstrations.obs).max(axis=1) < 2
    assert np.sqrt(np.mean((mean[:, 0] - truth)[common] ** 2)) < 0.04
    np.testing.assert_allclose(np.exp(log_std), STD, rtol=0.05)
    entropy = 0.5 * np.log(2 * np.pi * np.e * STD**2)  # the least loss that there is
    np.testing.assert_allclose(result.metrics["held_out_loss"].min(), entropy, atol=0.1)
    assert result.env_steps == 0
    assert not result.metrics["env_steps"].any()


def test_from_executed_actions_it_finds_the_gaussian_that_was_clipped() -> None:
    """Actions of N(0.2 + 2 SLOPE . obs, (2 STD)^2), clipped to [-1, 1]. Those at a bound would mislead a density."""
    demonstrations = linear_expert(4000)
    demonstrations = dataclasses.replace(demonstrations, actions=np.clip(2 * demonstrations.actions, -1, 1))
    assert 0.2 < np.mean(np.abs(demonstrations.actions) == 1) < 0.6
    truth, error, deviation = 0.2 + 2 * demonstrations.obs @ SLOPE, {}, {}
    common = np.abs(demonstrations.obs).max(axis=1) < 1.5
    for likelihood in ("censored", "gaussian"):
        result = clone(demonstrations, cloning_updates=4_500, actor_learning_rate=3e-3, action_likelihood=likelihood)
        actor = jax.tree.map(lambda leaf: leaf[0], result.actor)
        obs = normalize(actor.obs_statistics, jnp.asarray(demonstrations.obs))
        mean, log_std = numpy_policy(actor.policy_params, obs)
        error[likelihood] = np.sqrt(np.mean((mean[:, 0] - truth)[common] ** 2))
        deviation[likelihood] = np.exp(log_std).item()
    assert error["censored"] < 0.1 < 2 * 0.1 < error["gaussian"]
    np.testing.assert_allclose(deviation["censored"], 2 * STD, rtol=0.1)
    assert deviation["gaussian"] < 0.8 * 2 * STD


def test_what_acts_was_best_on_the_held_out_steps() -> None:
    """30 noisy samples are learnt by heart: the held-out loss turns, and the parameters of its lowest point stay."""
    demonstrations = linear_expert(30)
    env = Walk()
    config = build.resolve(
        walk_config(
            method="bc",
            cloning_updates=2_000,
            hidden_sizes=(32,),
            critic_minibatch_size=9,
            actor_learning_rate=0.001,
        ),
        env,
        demonstrations,
    )
    expert = expert_data(demonstrations)
    agent = behavior_cloning.make(config, env, expert)
    state, step, losses, seen = jax.jit(agent.init)(jax.random.key(1)), jax.jit(agent.step), [], []
    for _ in range(60):
        state, metrics = step(state)
        losses.append(float(metrics["held_out_loss"]))
        seen.append(state.params)
    best = int(np.argmin(losses))
    assert best < 50 and losses[-1] > losses[best] + 0.2
    assert_same_bits(state.actor.policy_params, seen[best])
    assert float(state.held_out_loss) == losses[best]


def test_of_policies_that_the_held_out_steps_cannot_tell_apart_the_newest_is_kept() -> None:
    """The loss of each is compared with the lowest so far plus its standard error, in NumPy."""
    demonstrations, env = linear_expert(100), Walk()
    own = {"hidden_sizes": (32,), "critic_minibatch_size": 9, "actor_learning_rate": 0.001}
    config = build.resolve(
        walk_config(method="bc", cloning_updates=2_000, cloning_selection="one_standard_error", **own),
        env,
        demonstrations,
    )
    expert = expert_data(demonstrations)
    assert expert is not None
    agent = behavior_cloning.make(config, env, expert)
    state, step, losses, bars, seen, kept = jax.jit(agent.init)(jax.random.key(1)), jax.jit(agent.step), [], [], [], []
    obs = normalize(state.actor.obs_statistics, expert.held_out_obs)
    for k in range(60):
        state, metrics = step(state)
        mean, log_std = numpy_policy(state.params, obs)
        residual = (np.asarray(expert.held_out_action) - mean) / np.exp(log_std)
        each = np.sum(residual**2 / 2 + log_std + np.log(2 * np.pi) / 2, axis=-1)
        np.testing.assert_allclose(metrics["held_out_loss"], each.mean(), rtol=1e-4)
        losses.append(each.mean())
        bars.append(each.mean() + each.std() / np.sqrt(len(each)))
        np.testing.assert_allclose(state.held_out_loss, min(bars), rtol=1e-4)
        seen.append(state.params)
        if losses[-1] <= min(bars):
            kept.append(k)
        assert_same_bits(state.actor.policy_params, seen[kept[-1]])
    assert kept[-1] > np.argmin(losses)  # not the lowest
    assert len(kept) < 60  # nor simply the last


def test_an_average_of_all_gradient_steps_is_judged_and_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its weights are those of polynomial decay, k for power 1; the steps themselves are those without an average."""
    monkeypatch.setattr(behavior_cloning, "CLONING_UPDATES_PER_ITERATION", 1)
    demonstrations, env, runs = linear_expert(200), Walk(), {}
    expert = expert_data(demonstrations)
    assert expert is not None
    for average in ({}, {"policy_average": "polynomial_decay", "policy_average_power": 1.0}):
        config = build.resolve(walk_config(method="bc", cloning_updates=100, **average), env, demonstrations)
        agent = behavior_cloning.make(config, env, expert)
        step = jax.jit(agent.step)
        states, losses = [jax.jit(agent.init)(jax.random.key(1))], []
        for _ in range(12):
            state, metrics = step(states[-1])
            states.append(state)
            losses.append(float(metrics["held_out_loss"]))
        runs[bool(average)] = states[1:], losses
    (plain, newest_losses), (averaging, losses) = runs[False], runs[True]
    newest = [ravel_pytree(state.params)[0] for state in plain]
    policy = networks.with_likelihood(config, env, networks.policy_of(config, env))
    obs = normalize(plain[0].actor.obs_statistics, expert.held_out_obs)
    for k, state in enumerate(averaging, start=1):
        assert isinstance(state, behavior_cloning.AveragingState)
        np.testing.assert_allclose(ravel_pytree(state.params)[0], newest[k - 1], rtol=1e-4, atol=1e-6)
        expected = np.average(newest[:k], axis=0, weights=np.arange(1, k + 1))
        np.testing.assert_allclose(ravel_pytree(state.average)[0], expected, rtol=1e-4, atol=1e-6)
        loss = behavior_cloning.negative_log_likelihood(policy.apply, state.average, obs, expert.held_out_action)
        np.testing.assert_allclose(losses[k - 1], loss, rtol=1e-5)
    assert_same_bits(averaging[-1].actor.policy_params, averaging[int(np.argmin(losses))].average)
    assert np.abs(np.subtract(losses, newest_losses)).max() > 1e-3
    assert not any(isinstance(state, behavior_cloning.AveragingState) for state in plain)


@pytest.mark.parametrize("average", ["none", "polynomial_decay"])
def test_a_stopped_and_resumed_run_is_the_unbroken_run(tmp_path: Path, average: str) -> None:
    own = walk_config(method="bc", cloning_updates=2_000, policy_average=average)

    def train(directory: Path | None = None, **options: Any) -> runner.Result:
        demonstrations = walk_demonstrations()
        with quick_compilation():
            return runner.train(own, Walk(), demonstrations, num_seeds=2, checkpoint_dir=directory, **options)

    whole = train()
    train(tmp_path, stop_after=10)
    resumed = train(tmp_path, resume=True)
    assert_same_bits(resumed.state, whole.state)
    assert_same_bits({name: resumed.metrics[name] for name in whole.metrics}, whole.metrics)
    loaded = runner.load(own, Walk(), tmp_path, 2)
    assert_same_bits(loaded.actor, whole.actor)
