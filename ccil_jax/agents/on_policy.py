"""The on-policy agent: Algorithms 1 and 2 of the paper as one iteration, for the rows of `METHODS` that have it.

`Parts` holds what the agent is made of, and every function below takes it first, so that an iteration can be carried
out, timed or differentiated piece by piece.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from ccil_jax.acting import distributions, networks, rollout, running_statistics
from ccil_jax.acting.networks import Network, Policy
from ccil_jax.acting.rollout import Actor, RolloutState
from ccil_jax.agents import behavior_cloning, contracts
from ccil_jax.agents.base import (
    Agent,
    EpisodeEstimates,
    episode_metrics,
    estimate_episodes,
    polynomial_decay_mean,
    running_mean,
)
from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.learning import constraints, policy_step, regression, reward_models
from ccil_jax.learning.constraints import Constraint, EpisodeCosts
from ccil_jax.learning.optimizers import Optimizer, adam
from ccil_jax.learning.policy_step import ExpertSteps, PolicyStep
from ccil_jax.learning.regression import Critic
from ccil_jax.learning.returns import gae, successor_values
from ccil_jax.learning.reward_models import RewardModel
from ccil_jax.types import Batch, ExpertData, Metrics, PyTree, Transition
from envs.base import Environment
from envs.jax_tools import scan

REWARD, COST = 0, 1  # order along every axis of length 2: critics, signals, directions, weights


@struct.dataclass(kw_only=True)
class AgentState:
    """Everything one seed needs to continue exactly."""

    actor: Actor  # what is judged: the newest policy, or an average of all so far
    critics: Critic  # [2]-leading: reward, cost
    reward_model: PyTree
    constraint: PyTree
    rollout: RolloutState
    estimates: EpisodeEstimates
    cost_rate: jax.Array  # [] cost so far per environment step so far
    iteration: jax.Array  # [] int32
    key: jax.Array

    @property
    def learner(self) -> Actor:
        """The newest policy, which collects the next batch and is improved by it."""
        return self.actor


@struct.dataclass(kw_only=True)
class AveragingState(AgentState):
    """Where `actor` is an average of the policies. A class of its own: checkpoints of others have no such part."""

    newest_params: PyTree  # of the newest policy

    @property
    def learner(self) -> Actor:
        """The newest policy; its observation statistics are the average's too."""
        return dataclasses.replace(self.actor, policy_params=self.newest_params)


@struct.dataclass(kw_only=True)
class LastBatch:
    """What an iteration keeps of its last generator step."""

    transition: Transition  # [T, N]
    taken: PolicyStep
    order: jax.Array  # [K] in which its samples were split


class Parts(NamedTuple):
    """What an on-policy agent is made of: everything but the numbers that it learns."""

    config: Config  # resolved
    env: Environment
    policy: Policy
    critic: Network  # [..., obs_dim] -> [...]; one set of parameters each for reward and cost
    reward_model: RewardModel
    constraint: Constraint
    optimizer: Optimizer  # of the critics
    expert: ExpertData | None = None
    clone: Agent | None = None  # learns the first policy by behaviour cloning

    @property
    def limit(self) -> jax.Array:
        """[] J_E, per episode; 0 for a method without a limit, which never reads it."""
        limit = self.config.cost_limit
        return jnp.asarray(0.0 if limit is None else limit, jnp.result_type(float))


def make_parts(
    config: Config,
    env: Environment,
    expert: ExpertData | None,
    *,
    constraint: Constraint | None = None,
    reward_model: RewardModel | None = None,
    policy: Policy | None = None,
    critic: Network | None = None,
    optimizer: Optimizer = adam,
) -> Parts:
    """The parts of the agent of `config.method`; what is given takes the place of the method's own."""
    own = networks.policy_of(config, env) if policy is None else policy
    observed = None if expert is None else expert.obs
    clone = None
    if config.reads("cloning_updates") and config.cloning_updates:
        clone = behavior_cloning.make(config, env, expert, policy=own, optimizer=optimizer)
    acting = networks.with_likelihood(config, env, contracts.policy(own, env.action_dim))
    if reward_model is None:
        reward_model = reward_models.make(config, env, expert, optimizer, acting)
    return Parts(
        config=config,
        env=env,
        policy=acting,
        critic=contracts.critic(networks.make_critic(config, env, observed) if critic is None else critic),
        reward_model=contracts.reward_model(reward_model),
        constraint=contracts.constraint(constraints.make(config) if constraint is None else constraint),
        optimizer=optimizer,
        expert=expert,
        clone=clone,
    )


def make(config: Config, env: Environment, expert: ExpertData | None, **own: object) -> Agent:
    """Builds the agent of `config.method`.

    Args:
        config: resolved.
        env: the task, unbatched.
        expert: the demonstrations; None for a method that learns without.
        **own: parts to put in the place of the method's own; see `make_parts`.
    """
    parts = make_parts(config, env, expert, **own)  # type: ignore[arg-type]  # checked by `build.make_agent`
    return Agent(init=functools.partial(init, parts), step=functools.partial(step, parts))


def resolve(config: Config, env: Environment, demonstrations: Demonstrations) -> Config:
    """The configuration with the weight of the demonstrations' likelihood set."""
    if config.cloning_weight is None:
        config = config.replace(cloning_weight=demonstrations.num_steps / config.batch_size)
    return config


def init(parts: Parts, key: jax.Array) -> AgentState:
    """An agent before its first iteration, whose simulations have begun. The key is consumed."""
    config, env = parts.config, parts.env
    key, policy_key, critic_key, reward_key, env_key = jax.random.split(key, 5)
    critic_params = jax.vmap(parts.critic.init)(jax.random.split(critic_key, 2))
    kind = regression.init_normalized if config.normalize_values else regression.init
    init_critic = functools.partial(kind, optimizer=parts.optimizer)
    zero = jnp.zeros(())
    actor = first_actor(parts, policy_key)
    state = AgentState(
        actor=actor,
        critics=jax.vmap(init_critic, in_axes=(0, None))(critic_params, config.critic_learning_rate),
        reward_model=parts.reward_model.begin(parts.reward_model.init(reward_key), actor),
        constraint=parts.constraint.init(),
        rollout=rollout.init(env, config.num_envs, env_key),
        estimates=EpisodeEstimates(episode_return=zero, episode_cost=parts.limit, episode_length=zero),
        cost_rate=zero,
        iteration=jnp.zeros((), jnp.int32),
        key=key,
    )
    if config.policy_average == "none":
        return state
    fields = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
    # Buffers of its own: those of the average are donated too.
    return AveragingState(**fields, newest_params=jax.tree.map(jnp.copy, actor.policy_params))


def first_actor(parts: Parts, key: jax.Array) -> Actor:
    """The policy before the first iteration: the clone where there is one, with the demonstrations' statistics."""
    if parts.clone is None:
        return Actor(policy_params=parts.policy.init(key), obs_statistics=running_statistics.init(parts.env.obs_dim))
    return behavior_cloning.learn(parts.clone, parts.config.num_cloning_iterations, key)


def step(parts: Parts, state: AgentState) -> tuple[AgentState, Metrics]:
    """One iteration: generator steps, then the reward model, then the constraint (Algorithm 1 lines 3 to 17)."""
    key, generator_key, reward_key = jax.random.split(state.key, 3)
    state, last, generator_metrics = generator_steps(parts, state, generator_key)
    reward_state, reward_metrics = parts.reward_model.update(state.reward_model, last.transition, reward_key)
    constraint_state, constraint_metrics = update_constraint(parts, state, reward_state, last)

    iteration = state.iteration + 1
    cost_rate = running_mean(state.cost_rate, jnp.mean(generator_metrics.pop("mean_cost")), iteration)
    metrics = {
        **episode_metrics(state.estimates, cost_rate),
        **({"multiplier": parts.constraint.multiplier(constraint_state)} if parts.config.has_multiplier else {}),
        "entropy": distributions.entropy(
            parts.policy.apply(state.learner.policy_params, jnp.zeros((1, parts.env.obs_dim)))
        ),
    }
    metrics |= {name: jnp.mean(value) for name, value in generator_metrics.items()}
    metrics["episodes_finished"] = jnp.sum(generator_metrics["episodes_finished"])
    new = dataclasses.replace(
        state,
        actor=judged(parts, state, iteration),
        reward_model=reward_state,
        constraint=constraint_state,
        cost_rate=cost_rate,
        iteration=iteration,
        key=key,
    )
    return new, contracts.join_metrics(metrics, reward_model=reward_metrics, constraint=constraint_metrics)


def judged(parts: Parts, state: AgentState, iteration: jax.Array) -> Actor:
    """The policy to evaluate after an iteration: the newest, or the average of all so far with the newest in it."""
    if not isinstance(state, AveragingState):
        return state.actor
    power = parts.config.policy_average_power
    mean = functools.partial(polynomial_decay_mean, count=iteration, power=power)
    params = jax.tree.map(mean, state.actor.policy_params, state.newest_params)
    return dataclasses.replace(state.actor, policy_params=params)


def with_learner(state: AgentState, learner: Actor) -> AgentState:
    """`state` with another newest policy. The average keeps its parameters, and has the statistics of the newest."""
    if not isinstance(state, AveragingState):
        return dataclasses.replace(state, actor=learner)
    actor = dataclasses.replace(state.actor, obs_statistics=learner.obs_statistics)
    return dataclasses.replace(state, actor=actor, newest_params=learner.policy_params)


def generator_steps(parts: Parts, state: AgentState, key: jax.Array) -> tuple[AgentState, LastBatch, Metrics]:
    """`config.generator_steps` policy updates, each on a fresh batch. Metrics are stacked, one row a step."""
    # Jitted, so that its shapes and the loop over it take one trace.
    one = jax.jit(functools.partial(generator_step, parts))
    keys = jax.random.split(key, parts.config.generator_steps)
    shapes = jax.eval_shape(one, state, keys[0])[1]
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def keep_last(carry: tuple[AgentState, LastBatch], key: jax.Array) -> tuple[tuple[AgentState, LastBatch], Metrics]:
        """Carries the newest batch along, so that no earlier one takes memory: only the last is needed later."""
        state, last, metrics = one(carry[0], key)
        return (state, last), metrics

    (state, last), metrics = scan(keep_last, (state, blank), keys)
    return state, last, metrics


def generator_step(parts: Parts, state: AgentState, key: jax.Array) -> tuple[AgentState, LastBatch, Metrics]:
    """One batch and what is learnt from it: policy and critics (Algorithm 1 lines 4 to 12)."""
    config, policy, constraint, learner = parts.config, parts.policy, parts.constraint, state.learner
    rollout_key, split_key, critic_key, expert_key = jax.random.split(key, 4)
    rollout_state, transition = rollout.rollout(
        parts.env, policy.apply, learner, state.rollout, config.num_steps, rollout_key
    )
    estimates, finished = estimate_episodes(state.estimates, transition)
    cost_gap = estimates.episode_cost - parts.limit
    step_gap = cost_gap / jnp.maximum(estimates.episode_length, 1.0)
    multiplier = constraint.multiplier(state.constraint)

    samples, assess_metrics = assess(parts, state, transition)
    order = policy_step.random_order(config, split_key)
    held_out, training = policy_step.split(samples, config.num_held_out, order)
    params, taken, step_metrics = policy_step.improve(
        config,
        policy.apply,
        constraint,
        learner.policy_params,
        training,
        multiplier,
        step_gap,
        held_out,
        expert_steps(parts, state, expert_key),
    )
    if parts.clone is not None:
        warming_up = state.iteration < config.warmup_iterations
        params, taken, step_metrics = policy_step.unless(warming_up, params, taken, step_metrics)
    critics, critic_losses = fit_critics(parts, state.critics, training, critic_key)

    assert learner.obs_statistics is not None
    statistics = learner.obs_statistics
    if parts.clone is None:  # other statistics would make another policy of the clone's parameters
        statistics = running_statistics.update(statistics, transition.obs)
    metrics = step_metrics | assess_metrics
    metrics |= {
        "episodes_finished": finished,
        "mean_cost": jnp.mean(transition.cost),
        "reward_critic_loss": critic_losses[REWARD],
        "cost_critic_loss": critic_losses[COST],
    }
    new = dataclasses.replace(
        with_learner(state, Actor(policy_params=params, obs_statistics=statistics)),
        critics=critics,
        rollout=rollout_state,
        estimates=estimates,
    )
    return new, LastBatch(transition=transition, taken=taken, order=order), metrics


def expert_steps(parts: Parts, state: AgentState, key: jax.Array) -> ExpertSteps | None:
    """Steps of the demonstrations, as many as the policy step has samples, drawn at random; None without a clone."""
    if parts.clone is None:
        return None
    assert parts.expert is not None
    indices = jax.random.randint(key, (parts.config.num_training,), 0, len(parts.expert.obs))
    obs = running_statistics.normalize(state.actor.obs_statistics, parts.expert.obs[indices])
    return ExpertSteps(obs=obs, action=parts.expert.action[indices])


def update_constraint(parts: Parts, state: AgentState, reward_state: PyTree, last: LastBatch) -> tuple[PyTree, Metrics]:
    """The dual step and, where samples are held out, the outer step (Algorithm 1 lines 14 to 16)."""
    config, outer = parts.config, None
    if config.num_held_out:
        taken = last.taken
        if config.outer_advantage == "re-evaluated":
            updated = dataclasses.replace(state, reward_model=reward_state)
            samples, _ = assess(parts, updated, last.transition)
            held_out, _ = policy_step.split(samples, config.num_held_out, last.order)
            taken = dataclasses.replace(taken, held_out=held_out)
        outer = policy_step.outer_problem(config, parts.policy.apply, parts.constraint, taken)
    return parts.constraint.update(state.constraint, state.estimates.episode_cost - parts.limit, outer)


def episodes_of_steps(transition: Transition, limit: jax.Array, max_episode_steps: int) -> EpisodeCosts:
    """The cost of each step's episode: known if it ends within the batch, else extrapolated at its rate so far."""
    rate = transition.episode_cost / transition.episode_length.astype(transition.episode_cost.dtype)
    last = transition.done.at[-1].set(True)
    final = jnp.where(transition.done, transition.episode_cost, rate * max_episode_steps)

    def backwards(following: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        cost = jnp.where(step[0], step[1], following)
        return cost, cost

    _, cost = jax.lax.scan(backwards, jnp.zeros_like(final[0]), (last, final), reverse=True)
    return EpisodeCosts(cost=cost, limit=limit)


def assess(parts: Parts, state: AgentState, transition: Transition) -> tuple[Batch, Metrics]:
    """Scores a batch: rewards, values, advantages and returns of both signals. Returns [K] samples and metrics."""
    config = parts.config

    def normalize(obs: jax.Array) -> jax.Array:
        return running_statistics.normalize(state.actor.obs_statistics, obs)

    def values(obs: jax.Array) -> jax.Array:
        return jax.vmap(functools.partial(regression.predict, parts.critic.apply), in_axes=(0, None))(
            state.critics, obs
        )

    obs = normalize(transition.obs)
    reward = parts.reward_model.reward(state.reward_model, transition)
    signals = jnp.stack([reward, transition.cost])
    no_future = transition.terminated if config.bootstrap_at_truncation else transition.done
    value = values(obs)
    next_value = successor_values(
        lambda obs: values(normalize(obs)), value, transition.next_obs, no_future, transition.done
    )
    lambdas = jnp.stack([jnp.asarray(config.gae_lambda), jnp.asarray(config.cost_gae_lambda)])
    cost_gamma = config.gamma if config.cost_gamma is None else config.cost_gamma
    gammas = jnp.stack([jnp.asarray(config.gamma), jnp.asarray(cost_gamma)])
    both = jax.vmap(gae, in_axes=(0, 0, 0, None, None, 0, 0))
    advantage, returns = both(signals, value, next_value, no_future, transition.done, gammas, lambdas)
    if config.critic_target == "td_lambda":
        lambdas = jnp.broadcast_to(jnp.asarray(config.critic_lambda), (2,))
        _, returns = both(signals, value, next_value, no_future, transition.done, gammas, lambdas)

    reward_advantage, cost_advantage = advantage[REWARD], advantage[COST]
    reward_advantage = (reward_advantage - jnp.mean(reward_advantage)) / (jnp.std(reward_advantage) + 1e-8)
    if config.standardize_cost_advantage and config.reads("standardize_cost_advantage"):
        cost_advantage = (cost_advantage - jnp.mean(cost_advantage)) / (jnp.std(cost_advantage) + 1e-8)
    episodes = episodes_of_steps(transition, parts.limit, parts.env.max_episode_steps)
    batch = Batch(
        obs=obs,
        action=transition.action,
        reward_advantage=parts.constraint.gate(reward_advantage, cost_advantage, episodes),
        cost_advantage=cost_advantage,
        returns=jnp.moveaxis(returns, 0, -1),
        cost=transition.cost,
    )
    explained = explained_variance(value, returns)
    metrics = {
        "imitation_reward": jnp.mean(reward),
        "reward_critic_explained_variance": explained[REWARD],
        "cost_critic_explained_variance": explained[COST],
    }
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch), metrics


def explained_variance(value: jax.Array, target: jax.Array) -> jax.Array:
    """1 - Var(target - value) / Var(target) over the last two axes; 0 where the targets do not vary.

    1 is a perfect critic and 0 one that knows no more than a constant. Steps of a new batch are new to the critics, so
    one that has memorised earlier batches is below 0.
    """
    total, left = (jnp.var(x, axis=(-2, -1)) for x in (target, target - value))
    return jnp.where(total > 0, 1 - left / jnp.where(total > 0, total, 1.0), 0.0)


def fit_critics(parts: Parts, critics: Critic, batch: Batch, key: jax.Array) -> tuple[Critic, jax.Array]:
    """Both critics on their returns (Algorithm 1 lines 11 and 12), through the same minibatches. Losses are [2]."""
    config = parts.config

    def fit(critic: Critic, target: jax.Array) -> tuple[Critic, jax.Array]:
        return regression.fit(
            parts.critic.apply,
            critic,
            batch.obs,
            target,
            key,
            learning_rate=config.critic_learning_rate,
            num_epochs=config.critic_epochs,
            minibatch_size=config.critic_minibatch_size,
            optimizer=parts.optimizer,
        )

    return jax.vmap(fit, in_axes=(0, -1))(critics, batch.returns)
