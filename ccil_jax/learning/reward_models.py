"""Where the policy's reward comes from: a discriminator against the expert, the expert's clone, or the task itself.

Sign convention of the discriminator, stated once: logits h are high on the expert. The paper's D tends to 1 on the
learner, so h = -logit(D) and its reward -log D is softplus(h): an expert-like learner earns more.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float

from ccil_jax.acting import distributions, networks, running_statistics
from ccil_jax.acting.distributions import Gaussian
from ccil_jax.acting.networks import Network, Policy
from ccil_jax.acting.rollout import Actor
from ccil_jax.acting.running_statistics import RunningStatistics
from ccil_jax.config import Config
from ccil_jax.learning.minibatches import minibatches
from ccil_jax.learning.optimizers import Optimizer, adam
from ccil_jax.methods import function_of
from ccil_jax.types import ExpertData, Metrics, PyTree, Transition
from envs.base import Environment
from envs.jax_tools import scan


def _no_state(key: jax.Array) -> PyTree:
    return ()


def _learn_nothing(state: PyTree, transition: Transition, key: jax.Array) -> tuple[PyTree, Metrics]:
    return state, {}


def _as_it_is(state: PyTree, actor: Actor) -> PyTree:
    return state


class RewardModel(NamedTuple):
    """A reward and how it learns, as pure functions. By default it has nothing to learn."""

    reward: Callable[[PyTree, Transition], jax.Array]  # state, transitions [T, N] -> [T, N]; the state is held fixed
    init: Callable[[jax.Array], PyTree] = _no_state  # key -> state
    update: Callable[[PyTree, Transition, jax.Array], tuple[PyTree, Metrics]] = _learn_nothing  # state, [T, N], key
    # The state of `init`, and the policy before the first iteration (the clone where there is one) -> state to begin
    # with. Arrays of the policy that the state keeps have to be copied: the buffers of both are donated.
    begin: Callable[[PyTree, Actor], PyTree] = _as_it_is


REWARD_FORMS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "softplus": jax.nn.softplus,  # -log D: always positive, so it favours long episodes
    "logit": lambda logits: logits,
    "log_sigmoid": jax.nn.log_sigmoid,  # log(1 - D): always negative, so it favours short episodes
}


def task() -> RewardModel:
    """The environment's own reward."""
    return RewardModel(reward=lambda state, transition: transition.reward)


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


def gradient_penalty(
    logits: Callable[[jax.Array], jax.Array],
    expert_inputs: Float[Array, "M D"],
    learner_inputs: Float[Array, "M D"],
    key: jax.Array,
) -> Float[Array, ""]:
    """Mean (|d logits / d input| - 1)^2 between random expert and learner inputs (Gulrajani et al. 2017).

    It keeps the logits from growing steep where the classes part, so that the reward still tells a learner which way
    the expert lies when none of its samples is taken for one.
    """
    mix = jax.random.uniform(key, (expert_inputs.shape[0], 1))
    slopes = jax.vmap(jax.grad(logits))(mix * expert_inputs + (1 - mix) * learner_inputs)
    # The small term: a vanishing slope must not have a NaN derivative.
    return jnp.mean((jnp.sqrt(jnp.sum(slopes**2, axis=-1) + 1e-12) - 1) ** 2)


def spectrally_normalized(network: Network) -> Network:
    """The network with every kernel divided by its largest singular value (Miyato et al. 2018): Lipschitz 1 or less."""

    def normalize(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        return leaf / largest_singular_value(leaf) if path[-1].key == "kernel" else leaf

    def apply(params: PyTree, inputs: jax.Array) -> jax.Array:
        return network.apply(jax.tree_util.tree_map_with_path(normalize, params), inputs)

    return Network(network.init, apply)


def largest_singular_value(matrix: Float[Array, "N M"], num_iterations: int = 20) -> Float[Array, ""]:
    """By power iteration from a fixed random vector (no LAPACK: see `test_no_seed_waits_for_anothers_thread`)."""

    def iterate(right: jax.Array, _: None) -> tuple[jax.Array, None]:
        image = matrix.T @ (matrix @ right)
        return image / (jnp.linalg.norm(image) + 1e-12), None

    start = jax.random.normal(jax.random.key(0), matrix.shape[1:], matrix.dtype)
    right = jax.lax.stop_gradient(jax.lax.scan(iterate, start, None, length=num_iterations)[0])
    left = jax.lax.stop_gradient(matrix @ right)
    # Constant singular vectors: the derivative is that of u.W v, the outer product of the two, as it should be.
    return (left / (jnp.linalg.norm(left) + 1e-12)) @ matrix @ right


class _Classifier(NamedTuple):
    """Pure functions of a discriminator's logits."""

    inputs: Callable[[RunningStatistics, jax.Array, jax.Array], jax.Array]  # statistics, obs, action -> [..., D]
    # params, expert inputs [M, D], learner inputs [M, D], key -> loss, logits of both [M]
    loss: Callable[[PyTree, jax.Array, jax.Array, jax.Array], tuple[jax.Array, tuple[jax.Array, jax.Array]]]


def _classifier(config: Config, network: Network) -> _Classifier:
    def inputs(statistics: RunningStatistics, obs: jax.Array, action: jax.Array) -> jax.Array:
        return jnp.concatenate([running_statistics.normalize(statistics, obs), action], axis=-1)

    def loss(
        params: PyTree, expert_inputs: jax.Array, learner_inputs: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        logits = functools.partial(network.apply, params)
        on_expert, on_learner = logits(expert_inputs), logits(learner_inputs)
        value = classification_loss(on_expert, on_learner, config.discriminator_entropy_coefficient)
        if config.discriminator_regularizer == "gradient_penalty":
            penalty = gradient_penalty(logits, expert_inputs, learner_inputs, key)
            value = value + config.gradient_penalty_coefficient * penalty
        return value, (on_expert, on_learner)

    return _Classifier(inputs, loss)


def _descend(
    classifier: _Classifier,
    rule: optax.GradientTransformation,
    expert: ExpertData,
    state: Discriminator,
    learner: tuple[jax.Array, jax.Array],
    key: jax.Array,
) -> tuple[Discriminator, Metrics]:
    """One gradient step on a minibatch of the learner's steps, and on as many of the expert's, drawn at random."""
    choice_key, penalty_key = jax.random.split(key)
    learner_obs, learner_action = learner
    indices = jax.random.randint(choice_key, (learner_obs.shape[0],), 0, expert.obs.shape[0])
    expert_obs, expert_action = expert.obs[indices], expert.action[indices]
    statistics = running_statistics.update(state.statistics, jnp.concatenate([learner_obs, expert_obs]))
    expert_inputs = classifier.inputs(statistics, expert_obs, expert_action)
    learner_inputs = classifier.inputs(statistics, learner_obs, learner_action)
    (value, (on_expert, on_learner)), gradient = jax.value_and_grad(classifier.loss, has_aux=True)(
        state.params, expert_inputs, learner_inputs, penalty_key
    )
    updates, optimizer_state = rule.update(gradient, state.optimizer, state.params)
    new = Discriminator(
        params=optax.apply_updates(state.params, updates), optimizer=optimizer_state, statistics=statistics
    )
    return new, {
        "discriminator_loss": value,
        "discriminator_accuracy_expert": jnp.mean(on_expert > 0),
        "discriminator_accuracy_learner": jnp.mean(on_learner < 0),
    }


def discriminator(
    config: Config, network: Network, expert: ExpertData, obs_dim: int, optimizer: Optimizer = adam
) -> RewardModel:
    """The adversarial reward of GAIL (Ho and Ermon 2016).

    It judges the learner's actions as `config.action_likelihood` has them. As they were drawn (gaussian): once clipped,
    all actions beyond the range would earn alike, and a policy whose mean has left the range would have no way back. Or
    as they are executed (censored), like the expert's.
    """
    rule = optimizer(config.discriminator_learning_rate)
    if config.discriminator_regularizer == "spectral_norm":
        network = spectrally_normalized(network)
    classifier = _classifier(config, network)
    inputs = classifier.inputs

    def init(key: jax.Array) -> Discriminator:
        params = network.init(key)
        statistics = running_statistics.update(running_statistics.init(obs_dim), expert.obs)
        return Discriminator(params=params, optimizer=rule.init(params), statistics=statistics)

    def reward(state: Discriminator, transition: Transition) -> jax.Array:
        logits = network.apply(state.params, inputs(state.statistics, transition.obs, transition.action))
        return REWARD_FORMS[config.reward_form](logits)

    def update(state: Discriminator, transition: Transition, key: jax.Array) -> tuple[Discriminator, Metrics]:
        learner = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), (transition.obs, transition.action))
        order_key, expert_key = jax.random.split(key)
        indices = minibatches(
            order_key,
            len(learner[0]),
            minibatch_size=config.discriminator_minibatch_size,
            num_epochs=config.discriminator_steps,
        )

        def step(state: Discriminator, minibatch: tuple[jax.Array, jax.Array]) -> tuple[Discriminator, Metrics]:
            indices, key = minibatch
            return _descend(classifier, rule, expert, state, jax.tree.map(lambda x: x[indices], learner), key)

        state, metrics = scan(step, state, (indices, jax.random.split(expert_key, len(indices))))
        held_out = network.apply(state.params, inputs(state.statistics, expert.held_out_obs, expert.held_out_action))
        return state, jax.tree.map(jnp.mean, metrics) | {"discriminator_accuracy_held_out": jnp.mean(held_out > 0)}

    return RewardModel(reward, init, update)


def adversarial(
    config: Config, env: Environment, expert: ExpertData | None, optimizer: Optimizer, policy: Policy
) -> RewardModel:
    """`discriminator` with a network of `config.hidden_sizes`."""
    assert expert is not None, f"{config.method} learns from demonstrations"
    # A small last layer: an untrained discriminator must not reward anything in particular.
    network = networks.make_scalar(config, env.obs_dim + env.action_dim, final_scale=0.01)
    return discriminator(config, network, expert, env.obs_dim, optimizer)


def coherent(config: Config, env: Environment, policy: Policy) -> RewardModel:
    """The log-likelihood ratio of the expert's clone and a prior (Watson, Huang and Heess 2023), in nats,

        r(s, a) = log q(a|s) - log p(a).

    q is the policy as it was cloned from the demonstrations, with the observation statistics that it was cloned with;
    both are the state, which never changes. p is what a policy knows before it has learnt anything: a Gaussian of mean
    0 and standard deviation `networks.initial_std`. Both have the likelihood that `config.action_likelihood` says.

    The paper's learner maximises r less log pi(a|s) - log p(a), and the clone is the best policy for that: this is why
    the reward is called coherent. The policy step of this package has no such penalty. The paper's clone also becomes
    the prior far from the demonstrations, so that r is 0 there; an ordinary network promises nothing there.

    The ratio has no lower bound. It is not clipped: its slope is what leads a policy back to the clone, and on
    HalfCheetah and Swimmer the lowest of 4,000 steps was at most 10 standard deviations below the mean. It has no upper
    bound where the clone is wider than the prior, unless the likelihood is censored.

    Args:
        config: says which likelihood.
        env: the task, unbatched.
        policy: the agent's, with its likelihood; the clone is a set of its parameters.
    """
    log_std = jnp.log(jnp.asarray(networks.initial_std(env), jnp.result_type(float)))

    def know_nothing(params: PyTree, obs: jax.Array) -> Gaussian:
        return Gaussian(mean=jnp.zeros((*obs.shape[:-1], env.action_dim)), log_std=log_std)

    prior = networks.with_likelihood(config, env, Policy(_no_state, know_nothing))

    def reward(clone: Actor, transition: Transition) -> jax.Array:
        obs = running_statistics.normalize(clone.obs_statistics, transition.obs)
        likelihood = distributions.log_prob(policy.apply(clone.policy_params, obs), transition.action)
        return likelihood - distributions.log_prob(prior.apply((), obs), transition.action)

    return RewardModel(reward, begin=lambda state, actor: jax.tree.map(jnp.copy, actor))


Maker = Callable[[Config, Environment, ExpertData | None, Optimizer, Policy], RewardModel]
REWARD_MODELS: Mapping[str, Maker] = {  # by the names in `METHODS`; "discriminator" by `config.imitation_reward`
    "discriminator": adversarial,
    "coherent": lambda config, env, expert, optimizer, policy: coherent(config, env, policy),
    "task": lambda config, env, expert, optimizer, policy: task(),
}


def make(
    config: Config, env: Environment, expert: ExpertData | None, optimizer: Optimizer, policy: Policy
) -> RewardModel:
    """The reward model of `config.method`, an on-policy one.

    Args:
        config: resolved.
        env: the task, unbatched.
        expert: the demonstrations; None where the method does not imitate.
        optimizer: of what the reward model learns.
        policy: the agent's, with its likelihood. A reward of the user's own is built without it.
    """
    reward = config.row.reward
    assert reward is not None, f"{config.method} has no reward"
    part = config.imitation_reward if reward == "discriminator" else reward
    maker: Callable[..., RewardModel] = function_of(part, REWARD_MODELS, "reward")
    given = (config, env, expert, optimizer)
    return maker(*given) if callable(reward) else maker(*given, policy)
