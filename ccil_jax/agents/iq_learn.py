"""IQ-Learn (Garg et al. 2021): a soft Q-function whose own Bellman residual is the reward, learnt off policy.

SAC's networks and updates, but the critic's loss needs no reward: it raises r = Q(s, a) - y on the expert's steps and
keeps r small everywhere by a chi-square term. Settings are those of the authors' published code. The policy may begin
as a clone of the demonstrations (`cloning_updates`), which is no part of the published method.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float

from ccil_jax.acting import distributions, networks, rollout
from ccil_jax.acting.networks import Network, SquashedPolicy
from ccil_jax.acting.rollout import Actor, RolloutState
from ccil_jax.agents import behavior_cloning, contracts, replay
from ccil_jax.agents.base import Agent, EpisodeEstimates, episode_metrics, estimate_episodes, running_mean
from ccil_jax.agents.replay import Replay
from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.errors import ConfigError
from ccil_jax.learning.optimizers import Optimizer, adam
from ccil_jax.types import ExpertData, ExpertTransitions, Metrics, PyTree, Transition
from envs.base import Environment
from envs.jax_tools import scan

TEMPERATURES = {"Ant": 1e-3, "Humanoid": 0.3}  # published, by task
USUAL_TEMPERATURE = 1e-2  # Hopper, Walker2d, HalfCheetah


@struct.dataclass(kw_only=True)
class Learner:
    """What gradient updates change."""

    policy_params: PyTree
    policy_optimizer: PyTree
    critic_params: PyTree
    critic_optimizer: PyTree
    target_params: PyTree  # Polyak average of the critic's


@struct.dataclass(kw_only=True)
class AgentState:
    """Everything one seed needs to continue exactly."""

    learner: Learner
    replay: Replay
    rollout: RolloutState
    estimates: EpisodeEstimates
    cost_rate: jax.Array  # [] cost so far per environment step so far
    iteration: jax.Array  # [] int32
    key: jax.Array

    @property
    def actor(self) -> Actor:
        """The policy; observations are not normalised."""
        return Actor(policy_params=self.learner.policy_params, obs_statistics=None)


@struct.dataclass(kw_only=True)
class Minibatch:
    """M steps of the expert, then M of the learner."""

    obs: jax.Array  # [2M, obs_dim]
    action: jax.Array  # [2M, action_dim] scaled to [-1, 1]
    next_obs: jax.Array  # [2M, obs_dim]
    terminated: jax.Array  # [2M] float
    initial_obs: jax.Array  # [E, obs_dim]


def loss(
    q: Float[Array, " K"],
    value: Float[Array, " K"],
    target: Float[Array, " K"],
    initial_value: Float[Array, " E"],
    config: Config,
) -> Float[Array, ""]:
    """The critic's loss: -mean r on the expert, a value term, and mean r^2 / (4 alpha), with r = Q - y.

    Args:
        q: Q(s, a); the first half are the expert's steps.
        value: V(s) = Q(s, a') - temperature log pi(a'|s), a' drawn from the policy.
        target: y = gamma V_target(s'), 0 after termination.
        initial_value: V at the demonstrations' first states.
        config: `value_loss` chooses mean(V - y) over both sources, or (1 - gamma) mean V(s_0).
    """
    reward = q - target
    on_expert = jnp.mean(reward[: len(reward) // 2])
    v0 = config.value_loss == "v0"
    value_term = (1 - config.gamma) * jnp.mean(initial_value) if v0 else jnp.mean(value - target)
    return value_term - on_expert + jnp.mean(reward**2) / (4 * config.chi2_coefficient)


Drawn = tuple[jax.Array, jax.Array]  # actions [K, action_dim] in [-1, 1], and their log-probabilities [K]


class SoftValues(NamedTuple):
    """Pure functions of the networks on observations [K, obs_dim]."""

    q: Callable[[PyTree, jax.Array, jax.Array], jax.Array]  # critic's parameters, obs, action -> Q [K]
    draw: Callable[[PyTree, jax.Array, jax.Array], Drawn]  # policy's parameters, obs, key
    value: Callable[[PyTree, jax.Array, Drawn], jax.Array]  # critic's parameters, obs, drawn -> V [K]


def soft_values(config: Config, policy: Any, critic: Network, action_dim: int) -> SoftValues:
    """Q(s, a), a drawn from the policy, and V(s) = Q(s, a) - temperature log pi(a|s) for that action."""
    assert config.temperature is not None, "resolved beforehand"
    temperature = config.temperature

    def q(params: PyTree, obs: jax.Array, action: jax.Array) -> jax.Array:
        return critic.apply(params, jnp.concatenate([obs, action], axis=-1))

    def draw(params: PyTree, obs: jax.Array, key: jax.Array) -> Drawn:
        noise = jax.random.normal(key, (*obs.shape[:-1], action_dim))
        return distributions.sample_unit(policy.apply(params, obs), noise)

    def value(params: PyTree, obs: jax.Array, drawn: Drawn) -> jax.Array:
        action, log_prob = drawn
        return q(params, obs, action) - temperature * log_prob

    return SoftValues(q, draw, value)


class Updates(NamedTuple):
    """Pure functions of the networks and one minibatch."""

    init: Callable[[jax.Array], Learner]
    step: Callable[[Learner, Minibatch, jax.Array], tuple[Learner, Metrics]]


def updates(config: Config, policy: Any, critic: Network, action_dim: int, optimizer: Optimizer = adam) -> Updates:
    """One update of the critic, then one of the policy (SAC's), then the target critic follows."""
    policy_optimizer, critic_optimizer = optimizer(config.actor_learning_rate), optimizer(config.critic_learning_rate)
    q, draw, value = soft_values(config, policy, critic, action_dim)

    def init(key: jax.Array) -> Learner:
        policy_key, critic_key = jax.random.split(key)
        policy_params, critic_params = policy.init(policy_key), critic.init(critic_key)
        return Learner(
            policy_params=policy_params,
            policy_optimizer=policy_optimizer.init(policy_params),
            critic_params=critic_params,
            critic_optimizer=critic_optimizer.init(critic_params),
            target_params=jax.tree.map(jnp.copy, critic_params),  # buffers of its own: both are donated
        )

    def step(learner: Learner, batch: Minibatch, key: jax.Array) -> tuple[Learner, Metrics]:
        here_key, next_key, first_key, policy_key = jax.random.split(key, 4)
        drawn, drawn_next, drawn_first = (
            draw(learner.policy_params, obs, key)
            for obs, key in ((batch.obs, here_key), (batch.next_obs, next_key), (batch.initial_obs, first_key))
        )
        next_value = value(learner.target_params, batch.next_obs, drawn_next)
        target = (1 - batch.terminated) * config.gamma * next_value

        def critic_loss(params: PyTree) -> tuple[jax.Array, jax.Array]:
            action_value = q(params, batch.obs, batch.action)
            values, first = value(params, batch.obs, drawn), value(params, batch.initial_obs, drawn_first)
            return loss(action_value, values, target, first, config), action_value - target

        (critic_error, reward), gradient = jax.value_and_grad(critic_loss, has_aux=True)(learner.critic_params)
        change, critic_state = critic_optimizer.update(gradient, learner.critic_optimizer, learner.critic_params)
        critic_params = optax.apply_updates(learner.critic_params, change)

        def policy_loss(params: PyTree) -> tuple[jax.Array, jax.Array]:
            action, log_prob = draw(params, batch.obs, policy_key)
            return -jnp.mean(value(critic_params, batch.obs, (action, log_prob))), -jnp.mean(log_prob)

        (policy_error, entropy), gradient = jax.value_and_grad(policy_loss, has_aux=True)(learner.policy_params)
        change, policy_state = policy_optimizer.update(gradient, learner.policy_optimizer, learner.policy_params)
        new = Learner(
            policy_params=optax.apply_updates(learner.policy_params, change),
            policy_optimizer=policy_state,
            critic_params=critic_params,
            critic_optimizer=critic_state,
            target_params=optax.incremental_update(critic_params, learner.target_params, config.target_update_rate),
        )
        return new, {"critic_loss": critic_error, "policy_loss": policy_error, "entropy": entropy, **_recovered(reward)}

    return Updates(init, step)


def _recovered(reward: jax.Array) -> Metrics:
    """The mean of the reward r = Q - y [2M] on the expert's and on the learner's steps."""
    half = len(reward) // 2
    return {
        "recovered_reward_expert": jnp.mean(reward[:half]),
        "recovered_reward_learner": jnp.mean(reward[half:]),
    }


class Parts(NamedTuple):
    """What the agent is made of."""

    config: Config
    env: Environment
    policy: Any  # a `SquashedPolicy`, or another whose actions `distributions.sample_unit` can draw
    expert: ExpertTransitions
    update: Updates


def make(
    config: Config,
    env: Environment,
    expert: ExpertData | None,
    *,
    policy: Any = None,
    critic: Network | None = None,
    optimizer: Optimizer = adam,
) -> Agent:
    """Builds the agent: acts in N simulations and after each step makes N `updates_per_step` updates."""
    assert expert is not None and expert.transitions is not None, "iq_learn learns from demonstrations"
    policy = networks.policy_of(config, env) if policy is None else policy
    policy = contracts.squashed_policy(policy, env.action_dim)
    if config.cloning_updates:
        policy = beginning_as_a_clone(config, policy, expert, optimizer)
    critic = networks.make_scalar(config, env.obs_dim + env.action_dim) if critic is None else critic
    critic = contracts.critic(critic)
    update = updates(config, policy, critic, env.action_dim, optimizer)
    parts = Parts(config=config, env=env, policy=policy, expert=expert.transitions, update=update)
    return Agent(init=functools.partial(init, parts), step=functools.partial(step, parts))


def beginning_as_a_clone(
    config: Config, policy: SquashedPolicy, expert: ExpertData, optimizer: Optimizer
) -> SquashedPolicy:
    """The policy with the parameters that behaviour cloning learns in the place of random ones.

    It is the most likely policy given the actions as they were executed, those near a bound of the range moved inwards
    (`distributions.LARGEST_UNIT`). Observations are not normalised, as this agent's never are.
    """
    cloning = behavior_cloning.descent(config, policy, expert, None, optimizer)

    def init(key: jax.Array) -> PyTree:
        return behavior_cloning.learn(cloning, config.num_cloning_iterations, key).policy_params

    return policy._replace(init=init)


def init(parts: Parts, key: jax.Array) -> AgentState:
    """An agent before its first iteration, whose simulations have begun. The key is consumed."""
    config, env = parts.config, parts.env
    key, learner_key, env_key = jax.random.split(key, 3)
    capacity = config.replay_size // config.num_envs * config.num_envs
    zero = jnp.zeros(())
    return AgentState(
        learner=parts.update.init(learner_key),
        replay=replay.init(capacity, env.obs_dim, env.action_dim),
        rollout=rollout.init(env, config.num_envs, env_key),
        estimates=EpisodeEstimates(episode_return=zero, episode_cost=zero, episode_length=zero),
        cost_rate=zero,
        iteration=jnp.zeros((), jnp.int32),
        key=key,
    )


def step(parts: Parts, state: AgentState) -> tuple[AgentState, Metrics]:
    """One iteration: as many environment steps as an on-policy method takes, with the updates after each."""
    config = parts.config
    key, steps_key = jax.random.split(state.key)
    keys = jax.random.split(steps_key, config.generator_steps * config.num_steps)
    state, (transition, metrics) = scan(functools.partial(act_and_learn, parts), state, keys)
    estimates, finished = estimate_episodes(state.estimates, transition)
    iteration = state.iteration + 1
    cost_rate = running_mean(state.cost_rate, jnp.mean(transition.cost), iteration)
    new = dataclasses.replace(state, estimates=estimates, cost_rate=cost_rate, iteration=iteration, key=key)
    return new, {
        **episode_metrics(estimates, cost_rate),
        "episodes_finished": finished,
        **jax.tree.map(jnp.mean, metrics),
    }


def act_and_learn(parts: Parts, state: AgentState, key: jax.Array) -> tuple[AgentState, tuple[Transition, Metrics]]:
    """One step of the N simulations, then N `updates_per_step` updates."""
    config = parts.config
    rollout_key, learning_key = jax.random.split(key)
    keys = jax.random.split(learning_key, config.num_envs * config.updates_per_step)
    rollout_state, transition = rollout.rollout(
        parts.env, parts.policy.apply, state.actor, state.rollout, 1, rollout_key
    )
    memory = replay.add(state.replay, transition)

    def learn(learner: Learner, key: jax.Array) -> tuple[Learner, Metrics]:
        batch_key, noise_key = jax.random.split(key)
        return parts.update.step(learner, minibatch(parts, memory, batch_key), noise_key)

    learner, metrics = scan(learn, state.learner, keys)
    new = dataclasses.replace(state, learner=learner, replay=memory, rollout=rollout_state)
    return new, (jax.tree.map(lambda x: x[0], transition), metrics)


def minibatch(parts: Parts, memory: Replay, key: jax.Array) -> Minibatch:
    """Steps of the demonstrations and of the replay memory, drawn with replacement."""
    steps, size = parts.expert, parts.config.critic_minibatch_size
    low, high = jnp.asarray(parts.env.action_low), jnp.asarray(parts.env.action_high)
    expert_key, learner_key = jax.random.split(key)
    chosen = jax.random.randint(expert_key, (size,), 0, steps.terminated.shape[0])
    remembered = replay.choose(memory, size, learner_key)

    def both(name: str) -> jax.Array:
        return jnp.concatenate([getattr(steps, name)[chosen], getattr(memory, name)[remembered]])

    return Minibatch(
        obs=both("obs"),
        action=(2 * both("action") - (high + low)[None]) / (high - low)[None],
        next_obs=both("next_obs"),
        terminated=both("terminated"),
        initial_obs=steps.initial_obs,
    )


def resolve(config: Config, env: Environment, demonstrations: Demonstrations) -> Config:
    """The configuration with its temperature set. Raises `ConfigError` where no step has a known successor."""
    if demonstrations.num_steps == len(demonstrations.episode_ends) and not demonstrations.terminated.any():
        raise ConfigError(
            "demonstrations: every trajectory is one step long and cut off, so no step's successor is known"
        )
    if config.temperature is None:
        config = config.replace(temperature=TEMPERATURES.get(env.name, USUAL_TEMPERATURE))
    return config
