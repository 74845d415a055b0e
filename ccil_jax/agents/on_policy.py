"""The on-policy agent: Algorithms 1 and 2 of the paper as one iteration, for the rows of `methods.METHODS` with it."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from ccil_jax.acting import distributions, networks, rollout, running_statistics
from ccil_jax.acting.distributions import Gaussian
from ccil_jax.acting.rollout import Actor, RolloutState
from ccil_jax.config import Config
from ccil_jax.learning import constraints, policy_step, regression, reward_models
from ccil_jax.learning.constraints import Constraint, Episodes
from ccil_jax.learning.policy_step import PolicyStep
from ccil_jax.learning.regression import Critic
from ccil_jax.learning.returns import gae, successor_values
from ccil_jax.learning.reward_models import RewardModel
from ccil_jax.types import Batch, ExpertData, Metrics, PyTree, Transition
from envs.base import Environment
from envs.jax_tools import scan

REWARD, COST = 0, 1  # order along every axis of length 2: critics, signals, directions, weights


class Agent(NamedTuple):
    """What the runner knows of a learner: pure functions of one seed. A state has a field `actor`, an `Actor`."""

    init: Callable[[jax.Array], Any]  # key -> state
    step: Callable[[Any], tuple[Any, Metrics]]  # one iteration


@struct.dataclass(kw_only=True)
class EpisodeEstimates:
    """Means over the whole episodes that finished last; carried over while none finishes."""

    episode_return: jax.Array  # []
    episode_cost: jax.Array  # [] J_k; starts at the limit, so that the first gap is 0
    episode_length: jax.Array  # []


@struct.dataclass(kw_only=True)
class AgentState:
    """Everything one seed needs to continue exactly."""

    actor: Actor
    critics: Critic  # [2]-leading: reward, cost
    reward_model: PyTree
    constraint: PyTree
    rollout: RolloutState
    estimates: EpisodeEstimates
    cost_rate: jax.Array  # [] cost so far per environment step so far
    iteration: jax.Array  # [] int32
    key: jax.Array


LastBatch = tuple[Transition, PolicyStep, jax.Array]  # of an iteration; the last is the order of its samples


def initial_std(env: Environment) -> np.ndarray:
    """1 (authors), but no wider than the range's half: Humanoid's actions in +-0.4 would nearly all be clipped."""
    return np.minimum(1.0, (np.asarray(env.action_high) - np.asarray(env.action_low)) / 2)


def make(config: Config, env: Environment, expert: ExpertData | None) -> Agent:
    """Builds the agent of `config.method`. `config` must be resolved; `expert` is None for task rewards."""
    constraint = constraints.make(config)
    policy = networks.make_policy(config, env.obs_dim, env.action_dim, initial_std(env))
    critic = networks.make_scalar(config, env.obs_dim)
    if config.row.reward == "discriminator":
        assert expert is not None, f"{config.method} learns from demonstrations"
        # A small last layer: an untrained discriminator must not reward anything in particular.
        network = networks.make_scalar(config, env.obs_dim + env.action_dim, final_scale=0.01)
        reward_model = reward_models.discriminator(config, network, expert, env.obs_dim)
    else:
        reward_model = reward_models.task()
    # A method without a limit has none to look at: the number enters nothing.
    limit = jnp.asarray(0.0 if config.cost_limit is None else config.cost_limit, jnp.result_type(float))

    def init(key: jax.Array) -> AgentState:
        key, policy_key, critic_key, reward_key, env_key = jax.random.split(key, 5)
        critic_params = jax.vmap(critic.init)(jax.random.split(critic_key, 2))
        zero = jnp.zeros(())
        return AgentState(
            actor=Actor(policy_params=policy.init(policy_key), obs_statistics=running_statistics.init(env.obs_dim)),
            critics=jax.vmap(regression.init, in_axes=(0, None))(critic_params, config.critic_learning_rate),
            reward_model=reward_model.init(reward_key),
            constraint=constraint.init(),
            rollout=rollout.init(env, config.num_envs, env_key),
            estimates=EpisodeEstimates(episode_return=zero, episode_cost=limit, episode_length=zero),
            cost_rate=zero,
            iteration=jnp.zeros((), jnp.int32),
            key=key,
        )

    @jax.jit  # so that its shapes and the loop over it take one trace
    def generator_step(state: AgentState, key: jax.Array) -> tuple[AgentState, LastBatch, Metrics]:
        rollout_key, split_key, critic_key = jax.random.split(key, 3)
        rollout_state, transition = rollout.rollout(
            env, policy.apply, state.actor, state.rollout, config.num_steps, rollout_key
        )
        estimates, finished = estimate_episodes(state.estimates, transition)
        cost_gap = estimates.episode_cost - limit
        multiplier = constraint.multiplier(state.constraint)

        episodes = episodes_of_steps(transition, limit, env.max_episode_steps)
        samples, mean_reward = assess(config, critic.apply, reward_model, constraint, state, transition, episodes)
        order = policy_step.random_order(config, split_key)
        held_out, training = policy_step.split(samples, config.num_held_out, order)
        step_gap = cost_gap / jnp.maximum(estimates.episode_length, 1.0)
        params, taken, step_metrics = policy_step.improve(
            config, policy.apply, constraint, state.actor.policy_params, training, multiplier, step_gap, held_out
        )
        critics, critic_losses = fit_critics(config, critic.apply, state.critics, training, critic_key)

        assert state.actor.obs_statistics is not None
        statistics = running_statistics.update(state.actor.obs_statistics, transition.obs)
        metrics = step_metrics | {
            "episodes_finished": finished,
            "imitation_reward": mean_reward,
            "mean_cost": jnp.mean(transition.cost),
            "reward_critic_loss": critic_losses[REWARD],
            "cost_critic_loss": critic_losses[COST],
        }
        new = dataclasses.replace(
            state,
            actor=Actor(policy_params=params, obs_statistics=statistics),
            critics=critics,
            rollout=rollout_state,
            estimates=estimates,
        )
        return new, (transition, taken, order), metrics

    def keep_last(carry: tuple[AgentState, LastBatch], key: jax.Array) -> tuple[tuple[AgentState, LastBatch], Metrics]:
        """A generator step of the scan: only the last batch is wanted afterwards, so no other is kept."""
        state, last, metrics = generator_step(carry[0], key)
        return (state, last), metrics

    def reassess(state: AgentState, reward_state: PyTree, transition: Transition, order: jax.Array) -> Batch:
        """The held-out samples of the last batch, with advantages by the updated critics and reward model."""
        updated = dataclasses.replace(state, reward_model=reward_state)
        episodes = episodes_of_steps(transition, limit, env.max_episode_steps)
        samples, _ = assess(config, critic.apply, reward_model, constraint, updated, transition, episodes)
        held_out, _ = policy_step.split(samples, config.num_held_out, order)
        return held_out

    def step(state: AgentState) -> tuple[AgentState, Metrics]:
        key, generator_key, reward_key = jax.random.split(state.key, 3)
        generator_keys = jax.random.split(generator_key, config.generator_steps)
        (state, (transition, taken, order)), generator_metrics = scan(
            keep_last, (state, _blank(generator_step, state, generator_keys[0])), generator_keys
        )

        reward_state, reward_metrics = reward_model.update(state.reward_model, transition, reward_key)
        if config.num_held_out and config.outer_advantage == "re-evaluated":
            taken = dataclasses.replace(taken, held_out=reassess(state, reward_state, transition, order))
        outer = policy_step.outer_problem(config, policy.apply, constraint, taken) if config.num_held_out else None
        cost_gap = state.estimates.episode_cost - limit
        constraint_state, constraint_metrics = constraint.update(state.constraint, cost_gap, outer)

        iteration = state.iteration + 1
        cost_rate = running_mean(state.cost_rate, jnp.mean(generator_metrics.pop("mean_cost")), iteration)
        metrics = {
            **episode_metrics(state.estimates, cost_rate),
            **({"multiplier": constraint.multiplier(constraint_state)} if config.has_multiplier else {}),
            "entropy": distributions.entropy(
                Gaussian(mean=jnp.zeros(()), log_std=state.actor.policy_params["log_std"])
            ),
        }
        metrics |= {name: jnp.mean(value) for name, value in generator_metrics.items()}
        metrics["episodes_finished"] = jnp.sum(generator_metrics["episodes_finished"])
        new = dataclasses.replace(
            state,
            reward_model=reward_state,
            constraint=constraint_state,
            cost_rate=cost_rate,
            iteration=iteration,
            key=key,
        )
        return new, metrics | reward_metrics | constraint_metrics

    return Agent(init, step)


def _blank(
    generator_step: Callable[[AgentState, jax.Array], tuple[AgentState, LastBatch, Metrics]],
    state: AgentState,
    key: jax.Array,
) -> LastBatch:
    """Zeros in the place of a batch before the first generator step."""
    batch = jax.eval_shape(generator_step, state, key)[1]
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), batch)


def estimate_episodes(previous: EpisodeEstimates, transition: Transition) -> tuple[EpisodeEstimates, jax.Array]:
    """Means over the whole episodes that end in this batch, or `previous` if none does; and how many did."""
    ends = transition.done & transition.whole
    count = jnp.sum(ends)

    def mean(totals: jax.Array, carried: jax.Array) -> jax.Array:
        total = jnp.sum(jnp.where(ends, totals.astype(carried.dtype), 0.0))
        return jnp.where(count > 0, total / jnp.maximum(count, 1).astype(carried.dtype), carried)

    return EpisodeEstimates(
        episode_return=mean(transition.episode_return, previous.episode_return),
        episode_cost=mean(transition.episode_cost, previous.episode_cost),
        episode_length=mean(transition.episode_length, previous.episode_length),
    ), count


def running_mean(mean: jax.Array, new: jax.Array, count: jax.Array) -> jax.Array:
    """The mean of `count` values, of which `new` is the last and `mean` that of the others."""
    return mean + (new - mean) / count.astype(mean.dtype)


def episode_metrics(estimates: EpisodeEstimates, cost_rate: jax.Array) -> Metrics:
    """What every agent that acts reports."""
    return {
        "episode_return": estimates.episode_return,
        "episode_cost": estimates.episode_cost,
        "episode_length": estimates.episode_length,
        "cost_rate": cost_rate,
    }


def episodes_of_steps(transition: Transition, limit: jax.Array, max_episode_steps: int) -> Episodes:
    """The cost of each step's episode: known if it ends within the batch, else extrapolated at its rate so far."""
    rate = transition.episode_cost / transition.episode_length.astype(transition.episode_cost.dtype)
    last = transition.done.at[-1].set(True)
    final = jnp.where(transition.done, transition.episode_cost, rate * max_episode_steps)

    def backwards(following: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        cost = jnp.where(step[0], step[1], following)
        return cost, cost

    _, cost = jax.lax.scan(backwards, jnp.zeros_like(final[0]), (last, final), reverse=True)
    return Episodes(cost=cost, limit=limit)


def assess(
    config: Config,
    critic_apply: Callable[[PyTree, jax.Array], jax.Array],
    reward_model: RewardModel,
    constraint: Constraint,
    state: AgentState,
    transition: Transition,
    episodes: Episodes,
) -> tuple[Batch, jax.Array]:
    """Scores a batch: rewards, values, advantages and returns of both signals. Returns [K] samples and mean reward."""

    def normalize(obs: jax.Array) -> jax.Array:
        return running_statistics.normalize(state.actor.obs_statistics, obs)

    def values(obs: jax.Array) -> jax.Array:
        return jax.vmap(critic_apply, in_axes=(0, None))(state.critics.params, obs)

    obs = normalize(transition.obs)
    reward = reward_model.reward(state.reward_model, transition)
    signals = jnp.stack([reward, transition.cost])
    no_future = transition.terminated if config.bootstrap_at_truncation else transition.done
    value = values(obs)
    next_value = successor_values(
        lambda obs: values(normalize(obs)), value, transition.next_obs, no_future, transition.done
    )
    lambdas = jnp.stack([jnp.asarray(config.gae_lambda), jnp.asarray(config.cost_gae_lambda)])
    both = jax.vmap(gae, in_axes=(0, 0, 0, None, None, None, 0))
    advantage, returns = both(signals, value, next_value, no_future, transition.done, config.gamma, lambdas)

    reward_advantage, cost_advantage = advantage[REWARD], advantage[COST]
    reward_advantage = (reward_advantage - jnp.mean(reward_advantage)) / (jnp.std(reward_advantage) + 1e-8)
    if config.standardize_cost_advantage:
        cost_advantage = (cost_advantage - jnp.mean(cost_advantage)) / (jnp.std(cost_advantage) + 1e-8)
    batch = Batch(
        obs=obs,
        action=transition.action,
        reward_advantage=constraint.gate(reward_advantage, cost_advantage, episodes),
        cost_advantage=cost_advantage,
        returns=jnp.moveaxis(returns, 0, -1),
        cost=transition.cost,
    )
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch), jnp.mean(reward)


def fit_critics(
    config: Config,
    critic_apply: Callable[[PyTree, jax.Array], jax.Array],
    critics: Critic,
    batch: Batch,
    key: jax.Array,
) -> tuple[Critic, jax.Array]:
    """Both critics on their returns (Algorithm 1 lines 11 and 12), through the same minibatches. Losses are [2]."""

    def fit(critic: Critic, target: jax.Array) -> tuple[Critic, jax.Array]:
        return regression.fit(
            critic_apply,
            critic,
            batch.obs,
            target,
            key,
            learning_rate=config.critic_learning_rate,
            num_epochs=config.critic_epochs,
            minibatch_size=config.critic_minibatch_size,
        )

    return jax.vmap(fit, in_axes=(0, -1))(critics, batch.returns)
