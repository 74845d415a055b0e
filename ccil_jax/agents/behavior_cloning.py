"""Behaviour cloning: the most likely policy given the demonstrations' actions, with held-out early stopping."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from flax import struct

from ccil_jax.acting import distributions, networks, running_statistics
from ccil_jax.acting.distributions import CensoredGaussian, Gaussian, TanhGaussian
from ccil_jax.acting.networks import Policy, SquashedPolicy
from ccil_jax.acting.rollout import Actor
from ccil_jax.acting.running_statistics import RunningStatistics
from ccil_jax.agents import contracts
from ccil_jax.agents.base import Agent, polynomial_decay_mean
from ccil_jax.config import CLONING_UPDATES_PER_ITERATION, Config
from ccil_jax.learning.optimizers import Optimizer, adam
from ccil_jax.types import ExpertData, Metrics, PyTree
from envs.base import Environment
from envs.jax_tools import scan

SMALLEST_LOG_STD = -4.0  # the likelihood of an action that the expert never varies has no maximum


@struct.dataclass(kw_only=True)
class AgentState:
    """Everything one seed needs to continue exactly."""

    actor: Actor  # the parameters that are kept so far
    held_out_loss: jax.Array  # [] what parameters may have on the held-out steps to be kept
    params: PyTree  # still training
    optimizer: PyTree
    key: jax.Array


@struct.dataclass(kw_only=True)
class AveragingState(AgentState):
    """Where the policy is an average. A class of its own: checkpoints of others have no such parts."""

    average: PyTree  # of `params` after every gradient step so far
    updates: jax.Array  # [] int32 gradient steps so far


def negative_log_likelihood(
    apply: Callable[[PyTree, jax.Array], Gaussian | CensoredGaussian | TanhGaussian],
    params: PyTree,
    obs: jax.Array,
    action: jax.Array,
) -> jax.Array:
    """Mean over the samples [M], nats."""
    return jnp.mean(negative_log_likelihoods(apply, params, obs, action))


def negative_log_likelihoods(
    apply: Callable[[PyTree, jax.Array], Gaussian | CensoredGaussian | TanhGaussian],
    params: PyTree,
    obs: jax.Array,
    action: jax.Array,
) -> jax.Array:
    """[M] of the samples, nats."""
    return -distributions.log_prob(apply(params, obs), action)


def _keep_wide(params: PyTree) -> PyTree:
    """The parameters with log-deviations of at least `SMALLEST_LOG_STD`, where the policy has them as `log_std`."""
    if not (isinstance(params, dict) and "log_std" in params):
        return params
    return {**params, "log_std": jnp.maximum(params["log_std"], SMALLEST_LOG_STD)}


def make(
    config: Config,
    env: Environment,
    expert: ExpertData | None,
    *,
    policy: Policy | None = None,
    optimizer: Optimizer = adam,
) -> Agent:
    """Builds the agent: the `descent` of a Gaussian policy, observations normalised by the demonstrations' moments."""
    assert expert is not None, "bc learns from demonstrations"
    own = contracts.policy(networks.policy_of(config, env) if policy is None else policy, env.action_dim)
    acting = networks.with_likelihood(config, env, own)
    statistics = running_statistics.update(running_statistics.init(env.obs_dim), expert.obs)
    held_out_obs = running_statistics.normalize(statistics, expert.held_out_obs)
    cloning = descent(config, acting, expert, statistics, optimizer)

    def step(state: AgentState) -> tuple[AgentState, Metrics]:
        new, metrics = cloning.step(state)
        return new, metrics | {"entropy": distributions.entropy(acting.apply(new.actor.policy_params, held_out_obs))}

    return Agent(cloning.init, step)


def learn(cloning: Agent, num_iterations: int, key: jax.Array) -> Actor:
    """The clone after so many iterations of `make` or `descent`: what was kept for its held-out loss."""
    state, _ = scan(lambda state, _: cloning.step(state), cloning.init(key), jnp.arange(num_iterations))
    return state.actor


def descent(
    config: Config,
    policy: Policy | SquashedPolicy,
    expert: ExpertData,
    statistics: RunningStatistics | None,
    optimizer: Optimizer,
) -> Agent:
    """The cloning of any policy; an iteration is `CLONING_UPDATES_PER_ITERATION` gradient steps.

    With the `policy_average` polynomial_decay, what is held against the held-out steps, and kept, is an average of the
    parameters after all gradient steps so far. The noise of single steps hardly shows in the likelihood, but grows over
    an episode (Block et al. 2024).

    With the `cloning_selection` one_standard_error, the newest parameters are kept whose held-out loss is at most the
    lowest so far plus its standard error. The steps of an episode are taken as independent for that, so it is rather
    small. The loss hardly changes over many gradient steps in which the mean action still becomes more exact, in states
    that are rare in the demonstrations and decide how a rollout goes on.

    Args:
        config: the learning rate, the size of a minibatch, the average and the selection.
        policy: with the likelihood that is to be maximised.
        expert: the demonstrations; the held-out steps tell which parameters are kept.
        statistics: of observations, to normalise what the policy gets; None where it gets them as they are.
        optimizer: learning rate -> update rule.
    """
    apply, rule = policy.apply, optimizer(config.actor_learning_rate)
    obs = running_statistics.normalize(statistics, expert.obs)
    held_out_obs = running_statistics.normalize(statistics, expert.held_out_obs)
    minibatch_size = min(config.critic_minibatch_size, obs.shape[0])

    def init(key: jax.Array) -> AgentState:
        key, policy_key = jax.random.split(key)
        params = policy.init(policy_key)
        state = AgentState(
            # Buffers of its own: those of the parameters still training are donated too.
            actor=Actor(policy_params=jax.tree.map(jnp.copy, params), obs_statistics=statistics),
            held_out_loss=jnp.asarray(jnp.inf),
            params=params,
            optimizer=rule.init(params),
            key=key,
        )
        if not (config.reads("policy_average") and config.policy_average == "polynomial_decay"):
            return state
        average, updates = jax.tree.map(jnp.copy, params), jnp.zeros((), jnp.int32)
        return AveragingState(**state.__dict__, average=average, updates=updates)

    def descend(state: AgentState, indices: jax.Array) -> tuple[AgentState, jax.Array]:
        loss, gradient = jax.value_and_grad(negative_log_likelihood, argnums=1)(
            apply, state.params, obs[indices], expert.action[indices]
        )
        change, optimizer_state = rule.update(gradient, state.optimizer, state.params)
        params = _keep_wide(optax.apply_updates(state.params, change))
        new = dataclasses.replace(state, params=params, optimizer=optimizer_state)
        if isinstance(new, AveragingState):
            updates = new.updates + 1
            mean = functools.partial(polynomial_decay_mean, count=updates, power=config.policy_average_power)
            new = dataclasses.replace(new, average=jax.tree.map(mean, new.average, params), updates=updates)
        return new, loss

    def step(state: AgentState) -> tuple[AgentState, Metrics]:
        key, minibatch_key = jax.random.split(state.key)
        minibatches = jax.random.randint(
            minibatch_key, (CLONING_UPDATES_PER_ITERATION, minibatch_size), 0, obs.shape[0]
        )
        new, losses = jax.lax.scan(descend, dataclasses.replace(state, key=key), minibatches)
        params = new.average if isinstance(new, AveragingState) else new.params
        losses_held_out = negative_log_likelihoods(apply, params, held_out_obs, expert.held_out_action)
        held_out, margin = jnp.mean(losses_held_out), jnp.zeros(())
        if config.cloning_selection == "one_standard_error":
            margin = jnp.std(losses_held_out) / losses_held_out.size**0.5
        bar = jnp.minimum(state.held_out_loss, held_out + margin)
        kept = jax.tree.map(lambda new, old: jnp.where(held_out <= bar, new, old), params, state.actor.policy_params)
        new = dataclasses.replace(new, actor=Actor(policy_params=kept, obs_statistics=statistics), held_out_loss=bar)
        return new, {"loss": jnp.mean(losses), "held_out_loss": held_out}

    return Agent(init, step)
