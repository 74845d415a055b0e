"""The coherent reward: the log-likelihood ratio of clone and prior, which stays as it is while a policy learns."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import ccil_jax
from ccil_jax.acting import networks, running_statistics
from ccil_jax.acting.distributions import Gaussian
from ccil_jax.acting.rollout import Actor
from ccil_jax.agents import build, on_policy
from ccil_jax.agents.expert import expert_data
from ccil_jax.agents.on_policy import Parts
from ccil_jax.config import Config, validate
from ccil_jax.errors import ConfigError
from ccil_jax.learning import policy_step, reward_models
from ccil_jax.training import runner
from ccil_jax.types import Transition
from tests.probe_envs import (
    Walk,
    agent_of,
    assert_same_bits,
    gae_by_loop,
    numpy_policy,
    quick_compilation,
    same_bits,
    steps_to_judge,
    walk_config,
    walk_demonstrations,
)

pytestmark = pytest.mark.once

NARROW = Walk(action_bound=0.4)  # so that the prior's standard deviation is not 1
COHERENT: dict[str, Any] = {"imitation_reward": "coherent", "cloning_updates": 200, "actor_learning_rate": 0.01}


def parts_of(env: Walk, method: str, **changes: Any) -> Parts:
    demonstrations = walk_demonstrations()
    config = build.resolve(walk_config(method=method, **COHERENT, **changes), env, demonstrations)
    return on_policy.make_parts(config, env, expert_data(demonstrations))


def steps_of(env: Walk) -> Transition:
    """[6, 4] steps whose actions lie within the range, at its bounds and, the last ones, beyond it."""
    rng = np.random.default_rng(1)
    action = np.clip(rng.normal(0, 0.5, (6, 4, 1)), env.action_low, env.action_high)
    action[-1] *= 3
    return steps_to_judge(rng.normal(0, 2, (6, 4, 2)), action, reward=np.nan)


def numpy_likelihood(mean: Any, std: Any, action: np.ndarray, bound: float) -> np.ndarray:
    """Log likelihoods of actions [..., 1] by SciPy; an action at the bound is the whole tail beyond it."""
    density = scipy.stats.norm.logpdf(action, mean, std)
    below, above = scipy.stats.norm.logcdf(-bound, mean, std), scipy.stats.norm.logsf(bound, mean, std)
    return np.sum(np.where(action <= -bound, below, np.where(action >= bound, above, density)), axis=-1)


def numpy_reward(clone: Actor, transition: Any, env: Walk, likelihood: str) -> np.ndarray:
    """The ratio in NumPy, with the moments of the demonstrations computed anew."""
    expert = expert_data(walk_demonstrations())
    assert expert is not None
    demonstrated = np.asarray(expert.obs, np.float64)
    obs = np.clip((np.asarray(transition.obs) - demonstrated.mean(axis=0)) / demonstrated.std(axis=0), -5, 5)
    action = np.asarray(transition.action, np.float64)
    bound = env.action_bound if likelihood == "censored" else np.inf
    mean, log_std = numpy_policy(clone.policy_params, obs)
    prior_std = min(1.0, env.action_bound)
    return numpy_likelihood(mean, np.exp(log_std), action, bound) - numpy_likelihood(0.0, prior_std, action, bound)


# The reward ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("likelihood", ["gaussian", "censored"])
def test_it_is_the_ratio_of_the_clones_likelihood_and_the_priors(likelihood: str) -> None:
    parts, steps = parts_of(NARROW, "gail", action_likelihood=likelihood), steps_of(NARROW)
    with quick_compilation():
        state = agent_of(parts).init(jax.random.key(3))
        found = jax.jit(parts.reward_model.reward)(state.reward_model, steps)
    assert_same_bits(state.reward_model, state.actor)
    assert not same_bits(state.actor.policy_params, parts.policy.init(jax.random.split(jax.random.key(3), 5)[1]))
    bounds = np.abs(np.asarray(steps.action)) == np.float32(NARROW.action_bound)
    assert 0 < bounds.mean() < 1
    expected = numpy_reward(state.reward_model, steps, NARROW, likelihood)
    assert np.ptp(expected) > 1
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("likelihood", ["gaussian", "censored"])
def test_it_is_0_where_the_clone_is_the_prior(likelihood: str) -> None:
    """A policy with mean 0 everywhere and the initial deviation; and not 0 with another deviation."""
    config = walk_config(method="gail", action_likelihood=likelihood, **COHERENT)
    policy = networks.with_likelihood(config, NARROW, networks.gaussian(config, NARROW))
    params = policy.init(jax.random.key(0))
    np.testing.assert_allclose(np.exp(params["log_std"]), 0.4, rtol=1e-6)
    zeros = jax.tree.map(jnp.zeros_like, params)
    reward = reward_models.coherent(config, NARROW, policy).reward
    for log_std, equal in ((params["log_std"], True), (params["log_std"] + 0.1, False)):
        clone = Actor(policy_params={**zeros, "log_std": log_std}, obs_statistics=running_statistics.init(2))
        assert bool(np.all(np.asarray(reward(clone, steps_of(NARROW))) == 0)) is equal


def test_the_clone_of_an_own_policy_is_judged_by_that_policy() -> None:
    """One whose means are linear in the observations."""

    def apply(params: Any, obs: jax.Array) -> Gaussian:
        return Gaussian(mean=obs @ params["weights"], log_std=params["log_std"])

    def init(key: jax.Array) -> Any:
        return {"weights": jnp.full((2, 1), 0.3), "log_std": jnp.full(1, -0.2)}

    config = walk_config(method="gail", **COHERENT)
    expert = expert_data(walk_demonstrations())
    parts = on_policy.make_parts(config, Walk(), expert, policy=ccil_jax.Policy(init, apply))
    state = agent_of(parts).init(jax.random.key(0))
    steps = steps_of(Walk())
    clone = state.reward_model
    mean = running_statistics.normalize(clone.obs_statistics, steps.obs) @ clone.policy_params["weights"]
    action, std = np.asarray(steps.action), np.exp(clone.policy_params["log_std"])
    expected = numpy_likelihood(mean, std, action, np.inf) - numpy_likelihood(0.0, 1.0, action, np.inf)
    np.testing.assert_allclose(parts.reward_model.reward(clone, steps), expected, rtol=1e-4, atol=1e-4)


# While a policy learns ------------------------------------------------------------------------------------------------


def test_it_stays_as_it_is_while_the_policy_moves() -> None:
    parts = parts_of(Walk(), "malm")
    with quick_compilation():
        agent = agent_of(parts)
        first = agent.init(jax.random.key(2))
        state, metrics = agent.step(first)
        state, _ = agent.step(state)
    assert_same_bits(state.reward_model, first.actor)
    assert not same_bits(state.actor.policy_params, first.actor.policy_params)
    assert all(np.isfinite(value).all() for value in metrics.values())
    assert metrics["imitation_reward"] != 0
    assert not [name for name in metrics if name.startswith("discriminator")]


def test_it_leads_a_policy_back_to_the_clone() -> None:
    """From means that were shifted by two of the clone's deviations; the demonstrations have no weight of their own."""
    parts = parts_of(Walk(), "gail", action_likelihood="censored")
    with quick_compilation():
        agent = agent_of(parts)
        state = agent.init(jax.random.key(2))
        clone = jax.tree.map(np.array, state.actor)
        layers = dict(state.actor.policy_params["mean"]["params"])
        last = layers[f"Dense_{len(layers) - 1}"]
        std = jnp.exp(state.actor.policy_params["log_std"])
        layers[f"Dense_{len(layers) - 1}"] = {**last, "bias": last["bias"] + 2 * std}
        moved = {**state.actor.policy_params, "mean": {"params": layers}}
        state = dataclasses.replace(state, actor=dataclasses.replace(state.actor, policy_params=moved))
        rewards, distances = [], []
        obs = np.random.default_rng(0).normal(size=(50, 2))
        for _ in range(40):
            state, metrics = agent.step(state)
            rewards.append(float(metrics["imitation_reward"]))
            shift = numpy_policy(state.actor.policy_params, obs)[0] - numpy_policy(clone.policy_params, obs)[0]
            distances.append(float(np.mean(np.abs(shift))))
    assert np.mean(rewards[-5:]) > np.mean(rewards[:5]) + 0.3
    assert distances[-1] < 0.7 * 2 * float(std[0])


def test_the_outer_step_replays_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the outer loss sees of a batch are advantages of this reward, by a loop in NumPy."""
    seen: dict[str, Any] = {}
    outer_problem = policy_step.outer_problem

    def watched(config: Config, apply: Any, constraint: Any, taken: policy_step.PolicyStep) -> Any:
        seen["held_out"] = taken.held_out
        return outer_problem(config, apply, constraint, taken)

    monkeypatch.setattr(policy_step, "outer_problem", watched)
    parts = parts_of(Walk(), "malm", outer_advantage="re-evaluated", held_out_fraction=0.5)
    state = agent_of(parts).init(jax.random.key(5))
    state, last, _ = on_policy.generator_steps(parts, state, jax.random.key(6))
    _, metrics = on_policy.update_constraint(parts, state, state.reward_model, last)  # not jitted: numbers are seen
    assert metrics["meta_gradient"] != 0

    transition, held_out = jax.tree.map(np.asarray, (last.transition, seen["held_out"]))
    critic = jax.tree.map(lambda leaf: leaf[on_policy.REWARD], state.critics.params)
    value, next_value = (
        np.asarray(parts.critic.apply(critic, running_statistics.normalize(state.actor.obs_statistics, jnp.asarray(x))))
        for x in (transition.obs, transition.next_obs)
    )
    reward = numpy_reward(state.reward_model, transition, Walk(), "gaussian")
    ends = transition.terminated, transition.done
    advantage = gae_by_loop(reward, value, next_value, *ends, parts.config.gamma, parts.config.gae_lambda).ravel()
    advantage = (advantage - advantage.mean()) / advantage.std()
    actions = transition.action.reshape(len(advantage), -1)
    rows = [int(np.flatnonzero((actions == action).all(axis=1)).item()) for action in held_out.action]
    assert len(set(rows)) == parts.config.num_held_out == 16
    np.testing.assert_allclose(held_out.reward_advantage, advantage[rows], rtol=1e-3, atol=1e-4)


def test_a_stopped_and_resumed_run_is_the_unbroken_run(tmp_path: Path) -> None:
    def train(directory: Path | None = None, **options: Any) -> runner.Result:
        config = walk_config(method="malm", env_steps=4 * 64, **COHERENT)
        with quick_compilation():
            return runner.train(config, Walk(), walk_demonstrations(), num_seeds=2, checkpoint_dir=directory, **options)

    whole = train()
    train(tmp_path, stop_after=2)
    resumed = train(tmp_path, resume=True)
    assert_same_bits(resumed.state, whole.state)
    assert_same_bits({name: resumed.metrics[name] for name in whole.metrics}, whole.metrics)


# What is refused -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["malm", "gail"])
def test_without_a_clone_it_is_refused(method: str) -> None:
    message = r"^imitation_reward coherent: is computed from a clone .*; give cloning_updates a number such as 20000"
    with pytest.raises(ConfigError, match=message) as refused:
        validate(Config(method=method, imitation_reward="coherent"))
    assert refused.value.on_command_line().startswith("--imitation-reward coherent: ")
    validate(Config(method=method, imitation_reward="coherent", cloning_updates=100))


def test_what_a_preset_says_of_the_discriminator_is_left_out() -> None:
    config = Config.from_preset("printed", method="ccil", cloning_updates=100, imitation_reward="coherent")
    assert (config.discriminator_minibatch_size, config.discriminator_regularizer) == (128, "gradient_penalty")
    validate(config)


def test_an_own_model_learns_what_the_first_policy_is() -> None:
    """`begin` is given what `init` returned, and the policy before the first iteration, with a clone or without."""
    model = ccil_jax.RewardModel(
        init=lambda key: {"mine": jnp.ones(3)},
        begin=lambda state, actor: {**state, "log_std": 2 * actor.policy_params["log_std"]},
        reward=lambda state, transition: transition.obs[..., 0] * state["log_std"][0],
    )
    for updates in (0, 100):
        config = walk_config(method="gail", cloning_updates=updates)
        agent = ccil_jax.make_agent(config, Walk(), walk_demonstrations(), reward_model=model)
        with quick_compilation():
            state = jax.jit(agent.init)(jax.random.key(0))
        expected = {"mine": np.ones(3, np.float32), "log_std": 2 * state.actor.policy_params["log_std"]}
        assert_same_bits(jax.tree.map(np.asarray, state.reward_model), jax.tree.map(np.asarray, expected))


def test_an_error_of_an_own_beginning_is_named() -> None:
    model = ccil_jax.RewardModel(begin=lambda state, actor: [][0], reward=lambda state, transition: transition.reward)
    agent = ccil_jax.make_agent(walk_config(method="gail"), Walk(), walk_demonstrations(), reward_model=model)
    with pytest.raises(ConfigError, match=r"reward_model.begin: .*, line \d+, raised IndexError"):
        jax.eval_shape(agent.init, jax.random.key(0))
