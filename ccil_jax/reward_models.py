"""Where the policy's reward comes from: a discriminator against the expert, or the task itself.

Sign convention, stated once: logits h are high on the expert. The paper's D tends to 1 on the learner, so
h = -logit(D) and its reward -log D is softplus(h): an expert-like learner earns more.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float

from ccil_jax import running_statistics
from ccil_jax.config import Config
from ccil_jax.networks import Network
from ccil_jax.running_statistics import RunningStatistics
from ccil_jax.shuffling import minibatches
from ccil_jax.types import ExpertData, Metrics, PyTree, Transition


class RewardModel(NamedTuple):
    """A reward and how it learns."""

    init: Callable[[jax.Array], PyTree]  # key -> state
    reward: Callable[[PyTree, Transition], jax.Array]  # state, [T, N] -> [T, N], state held fixed
    update: Callable[[PyTree, Transition, jax.Array], tuple[PyTree, Metrics]]  # state, [T, N], key


REWARD_FORMS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "softplus": jax.nn.softplus,  # -log D: always positive, so it favours long episodes
    "logit": lambda logits: logits,
    "log_sigmoid": jax.nn.log_sigmoid,  # log(1 - D): always negative, so it favours short episodes
}


def task() -> RewardModel:
    """The environment's own reward."""
    return RewardModel(
        init=lambda key: (),
        reward=lambda state, transition: transition.reward,
        update=lambda state, transition, key: (state, {}),
    )


@struct.dataclass(kw_only=True)
class Discriminator:
    """Classifier of state-action pairs, expert against learner."""

    params: PyTree
    optimizer: PyTree
    statistics: RunningStatistics  # of observations, learner's and expert's


def classification_loss(
    expert_logits: Float[Array, " E"], learner_logits: Float[Array, " L"], entropy_coefficient: Float[Array, ""] | float
) -> Float[Array, ""]:
    """Logistic loss, -(E_pi[log D] + E_E[log(1 - D)]), less an entropy bonus (equation 2 of the paper)."""
    loss = jnp.mean(jax.nn.softplus(-expert_logits)) + jnp.mean(jax.nn.softplus(learner_logits))
    logits = jnp.concatenate([expert_logits, learner_logits])
    entropy = jnp.mean(jax.nn.softplus(logits) - jax.nn.sigmoid(logits) * logits)
    return loss - entropy_coefficient * entropy


def discriminator(
    config: Config, network: Network, expert: ExpertData, action_bounds: tuple[jax.Array, jax.Array], obs_dim: int
) -> RewardModel:
    """The adversarial reward of GAIL (Ho and Ermon 2016).

    Learner actions are clipped to `action_bounds` first, as the environment executes them and as demonstrations record
    them: otherwise the tail of the Gaussian alone would give the learner away.
    """
    optimizer = optax.adam(config.discriminator_learning_rate)

    def logits(params: PyTree, statistics: RunningStatistics, obs: jax.Array, action: jax.Array) -> jax.Array:
        inputs = [running_statistics.normalize(statistics, obs), jnp.clip(action, *action_bounds)]
        return network.apply(params, jnp.concatenate(inputs, axis=-1))

    def init(key: jax.Array) -> Discriminator:
        params = network.init(key)
        statistics = running_statistics.update(running_statistics.init(obs_dim), expert.obs)
        return Discriminator(params=params, optimizer=optimizer.init(params), statistics=statistics)

    def reward(state: Discriminator, transition: Transition) -> jax.Array:
        return REWARD_FORMS[config.reward_form](
            logits(state.params, state.statistics, transition.obs, transition.action)
        )

    def descend(
        state: Discriminator, learner: tuple[jax.Array, jax.Array], key: jax.Array
    ) -> tuple[Discriminator, Metrics]:
        indices = jax.random.randint(key, (learner[0].shape[0],), 0, expert.obs.shape[0])
        expert_obs, expert_action = expert.obs[indices], expert.action[indices]
        statistics = running_statistics.update(state.statistics, jnp.concatenate([learner[0], expert_obs]))

        def loss(params: PyTree) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            on_expert = logits(params, statistics, expert_obs, expert_action)
            on_learner = logits(params, statistics, *learner)
            value = classification_loss(on_expert, on_learner, config.discriminator_entropy_coefficient)
            return value, (on_expert, on_learner)

        (value, (on_expert, on_learner)), gradient = jax.value_and_grad(loss, has_aux=True)(state.params)
        updates, optimizer_state = optimizer.update(gradient, state.optimizer)
        new = Discriminator(
            params=optax.apply_updates(state.params, updates), optimizer=optimizer_state, statistics=statistics
        )
        return new, {
            "discriminator_loss": value,
            "discriminator_accuracy_expert": jnp.mean(on_expert > 0),
            "discriminator_accuracy_learner": jnp.mean(on_learner < 0),
        }

    def update(state: Discriminator, transition: Transition, key: jax.Array) -> tuple[Discriminator, Metrics]:
        learner = jax.tree.map(
            lambda x: x.reshape(-1, x.shape[-1]), (transition.obs, jnp.clip(transition.action, *action_bounds))
        )
        order_key, expert_key = jax.random.split(key)
        epochs = [
            minibatches(key, len(learner[0]), config.discriminator_minibatch_size)
            for key in jax.random.split(order_key, config.discriminator_steps)
        ]
        indices = jnp.concatenate(epochs)

        def step(state: Discriminator, inputs: tuple[jax.Array, jax.Array]) -> tuple[Discriminator, Metrics]:
            indices, key = inputs
            return descend(state, jax.tree.map(lambda x: x[indices], learner), key)

        state, metrics = jax.lax.scan(step, state, (indices, jax.random.split(expert_key, len(indices))))
        held_out = logits(state.params, state.statistics, expert.held_out_obs, expert.held_out_action)
        return state, jax.tree.map(jnp.mean, metrics) | {"discriminator_accuracy_held_out": jnp.mean(held_out > 0)}

    return RewardModel(init, reward, update)
