"""IQ-Learn (Garg et al. 2021): a soft Q-function whose own Bellman residual is the reward, learnt off policy.

SAC's networks and updates, but the critic's loss needs no reward: it raises r = Q(s, a) - y on the expert's steps and
keeps r small everywhere by a chi-square term. Settings are those of the authors' published code.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float

from ccil_jax.acting import distributions, networks, rollout
from ccil_jax.acting.networks import Network, SquashedPolicy
from ccil_jax.acting.rollout import Actor, RolloutState
from ccil_jax.agents import replay
from ccil_jax.agents.on_policy import Agent, EpisodeEstimates, episode_metrics, estimate_episodes, running_mean
from ccil_jax.agents.replay import Replay
from ccil_jax.config import Config
from ccil_jax.learning.optimizers import adam
from ccil_jax.types import ExpertData, Metrics, PyTree, Transition
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


class Updates(NamedTuple):
    """Pure functions of the networks and one minibatch."""

    init: Callable[[jax.Array], Learner]
    step: Callable[[Learner, Minibatch, jax.Array], tuple[Learner, Metrics]]


def updates(config: Config, policy: SquashedPolicy, critic: Network, action_dim: int) -> Updates:
    """One update of the critic, then one of the policy (SAC's), then the target critic follows."""
    assert config.temperature is not None, "resolved by the runner"
    temperature = config.temperature
    policy_optimizer, critic_optimizer = adam(config.actor_learning_rate), adam(config.critic_learning_rate)

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

    def q(params: PyTree, obs: jax.Array, action: jax.Array) -> jax.Array:
        return critic.apply(params, jnp.concatenate([obs, action], axis=-1))

    def draw(params: PyTree, obs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        noise = jax.random.normal(key, (*obs.shape[:-1], action_dim))
        return distributions.sample_unit(policy.apply(params, obs), noise)

    def value(params: PyTree, obs: jax.Array, drawn: tuple[jax.Array, jax.Array]) -> jax.Array:
        action, log_prob = drawn
        return q(params, obs, action) - temperature * log_prob

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
        change, critic_state = critic_optimizer.update(gradient, learner.critic_optimizer)
        critic_params = optax.apply_updates(learner.critic_params, change)

        def policy_loss(params: PyTree) -> tuple[jax.Array, jax.Array]:
            drawn = draw(params, batch.obs, policy_key)
            return -jnp.mean(value(critic_params, batch.obs, drawn)), -jnp.mean(drawn[1])

        (policy_error, entropy), gradient = jax.value_and_grad(policy_loss, has_aux=True)(learner.policy_params)
        change, policy_state = policy_optimizer.update(gradient, learner.policy_optimizer)
        new = Learner(
            policy_params=optax.apply_updates(learner.policy_params, change),
            policy_optimizer=policy_state,
            critic_params=critic_params,
            critic_optimizer=critic_state,
            target_params=optax.incremental_update(critic_params, learner.target_params, config.target_update_rate),
        )
        half = len(reward) // 2
        return new, {
            "critic_loss": critic_error,
            "policy_loss": policy_error,
            "entropy": entropy,
            "recovered_reward_expert": jnp.mean(reward[:half]),
            "recovered_reward_learner": jnp.mean(reward[half:]),
        }

    return Updates(init, step)


def make(config: Config, env: Environment, expert: ExpertData | None) -> Agent:
    """Builds the agent: acts in N simulations and after each step makes N `updates_per_step` updates."""
    assert expert is not None and expert.transitions is not None, "iq_learn learns from demonstrations"
    steps = expert.transitions
    policy = networks.make_squashed_policy(config, env)
    critic = networks.make_scalar(config, env.obs_dim + env.action_dim)
    update = updates(config, policy, critic, env.action_dim)
    capacity = config.replay_size // config.num_envs * config.num_envs
    low, high = jnp.asarray(env.action_low), jnp.asarray(env.action_high)

    def init(key: jax.Array) -> AgentState:
        key, learner_key, env_key = jax.random.split(key, 3)
        zero = jnp.zeros(())
        return AgentState(
            learner=update.init(learner_key),
            replay=replay.init(capacity, env.obs_dim, env.action_dim),
            rollout=rollout.init(env, config.num_envs, env_key),
            estimates=EpisodeEstimates(episode_return=zero, episode_cost=zero, episode_length=zero),
            cost_rate=zero,
            iteration=jnp.zeros((), jnp.int32),
            key=key,
        )

    def minibatch(memory: Replay, key: jax.Array) -> Minibatch:
        expert_key, learner_key = jax.random.split(key)
        size = config.critic_minibatch_size
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

    def act_and_learn(state: AgentState, key: jax.Array) -> tuple[AgentState, tuple[Transition, Metrics]]:
        rollout_key, learning_key = jax.random.split(key)
        keys = jax.random.split(learning_key, config.num_envs * config.updates_per_step)
        rollout_state, transition = rollout.rollout(env, policy.apply, state.actor, state.rollout, 1, rollout_key)
        memory = replay.add(state.replay, transition)

        def learn(learner: Learner, key: jax.Array) -> tuple[Learner, Metrics]:
            batch_key, noise_key = jax.random.split(key)
            return update.step(learner, minibatch(memory, batch_key), noise_key)

        learner, metrics = scan(learn, state.learner, keys)
        new = dataclasses.replace(state, learner=learner, replay=memory, rollout=rollout_state)
        return new, (jax.tree.map(lambda x: x[0], transition), metrics)

    def step(state: AgentState) -> tuple[AgentState, Metrics]:
        key, steps_key = jax.random.split(state.key)
        keys = jax.random.split(steps_key, config.generator_steps * config.num_steps)
        state, (transition, metrics) = scan(act_and_learn, state, keys)
        estimates, finished = estimate_episodes(state.estimates, transition)
        iteration = state.iteration + 1
        cost_rate = running_mean(state.cost_rate, jnp.mean(transition.cost), iteration)
        new = dataclasses.replace(state, estimates=estimates, cost_rate=cost_rate, iteration=iteration, key=key)
        return new, {
            **episode_metrics(estimates, cost_rate),
            "episodes_finished": finished,
            **jax.tree.map(jnp.mean, metrics),
        }

    return Agent(init, step)
