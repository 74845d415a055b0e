"""The policy step of one batch, and the same step as a function of the multiplier.

It joins `trust_region`, which takes gradients of any objectives, with `constraints`, which choose their weights.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree

from ccil_jax.acting import distributions
from ccil_jax.acting.distributions import CensoredGaussian, Gaussian
from ccil_jax.config import Config
from ccil_jax.learning import constraints, trust_region
from ccil_jax.learning.constraints import Constraint, Outer
from ccil_jax.learning.minibatches import permutation
from ccil_jax.learning.trust_region import Directions
from ccil_jax.types import Batch, Metrics, PyTree


@struct.dataclass(kw_only=True)
class ExpertSteps:
    """Steps of the demonstrations, whose likelihood is an objective of the policy step."""

    obs: jax.Array  # [M, obs_dim] normalised
    action: jax.Array  # [M, action_dim]


@struct.dataclass(kw_only=True)
class PolicyStep:
    """What is needed to carry out a policy step again under another multiplier, and to differentiate it."""

    policy_params: PyTree  # theta_k
    directions: Directions
    fraction: jax.Array  # [] of the full step that the line search accepted; 0 if it rejected the step
    step_gap: jax.Array  # [] J_k - J_E per step, when it was taken
    held_out: Batch  # [V]
    expert: ExpertSteps | None = None  # whose likelihood was an objective of the step


def random_order(config: Config, key: jax.Array) -> jax.Array:
    """Indices [K] of a batch's samples in random order, the V held-out ones first. The key is consumed.

    Sample i is step i // N of simulation i % N.
    """
    if config.held_out_unit == "transition":
        return permutation(key, config.batch_size)
    simulations = permutation(key, config.num_envs)  # all T steps of a simulation stay together
    steps = jnp.arange(config.num_steps) * config.num_envs
    return (simulations[:, None] + steps[None]).reshape(-1)


def split(samples: Batch, num_held_out: int, order: jax.Array) -> tuple[Batch, Batch]:
    """A partition into [V] held-out and [M] training samples (Algorithm 1 line 8); untouched if V is 0."""
    if num_held_out:
        samples = jax.tree.map(lambda x: x[order], samples)
    return jax.tree.map(lambda x: x[:num_held_out], samples), jax.tree.map(lambda x: x[num_held_out:], samples)


def importance(log_prob: jax.Array, old_log_prob: jax.Array) -> jax.Array:
    """Probability ratios; log-ratios are clipped to +-20, far outside any trust region, so that none overflows."""
    return jnp.exp(jnp.clip(log_prob - old_log_prob, -20.0, 20.0))


def improve(
    config: Config,
    policy_apply: Callable[[PyTree, jax.Array], Gaussian | CensoredGaussian],
    constraint: Constraint,
    policy_params: PyTree,
    batch: Batch,
    multiplier: jax.Array,
    step_gap: jax.Array,
    held_out: Batch,
    expert: ExpertSteps | None = None,
) -> tuple[PyTree, PolicyStep, Metrics]:
    """The policy step on the training samples (Algorithm 1 line 10, Algorithm 2 lines 8 to 11).

    Where `expert` is given, the demonstrations' mean log likelihood is a third objective beside reward and cost.
    """
    params, unravel = ravel_pytree(policy_params)
    old = policy_apply(policy_params, batch.obs)
    old_log_prob = distributions.log_prob(old, batch.action)

    def objectives(params: jax.Array) -> tuple[jax.Array, jax.Array]:
        new = policy_apply(unravel(params), batch.obs)
        weights = importance(distributions.log_prob(new, batch.action), old_log_prob)
        bonus = config.policy_entropy_coefficient * distributions.entropy(new)
        reward = jnp.mean(weights * batch.reward_advantage) + bonus
        cost = jnp.mean(weights * batch.cost_advantage) - bonus * float(constraint.entropy_in_cost)
        found = [reward, cost]
        if expert is not None:
            cloned = distributions.log_prob(policy_apply(unravel(params), expert.obs), expert.action)
            found.append(jnp.mean(cloned))
        return jnp.stack(found), jnp.mean(distributions.kl_divergence(old, new))

    gradients = jax.jacrev(lambda params: objectives(params)[0])(params)
    fisher_obs = batch.obs[:: config.fisher_stride]
    product = trust_region.fisher_vector_product(
        lambda params: policy_apply(unravel(params), fisher_obs), params, config.cg_damping
    )
    directions = trust_region.directions(product, gradients, config.cg_iterations)
    weights = _weights(config, constraint, multiplier, step_gap, directions.gram)
    new_params, fraction, metrics = trust_region.step(
        params,
        directions,
        weights,
        objectives,
        max_kl=config.max_kl,
        kl_tolerance=config.kl_tolerance,
        num_halvings=config.line_search_steps,
    )
    # Where the line search rejected the step, its replay must leave the policy as it is. Directions of 0 make sure of
    # that also where they were not finite, because 0 times NaN is NaN.
    replayed = jax.tree.map(lambda leaf: jnp.where(fraction > 0, leaf, 0.0), directions)
    taken = PolicyStep(
        policy_params=policy_params,
        directions=replayed,
        fraction=fraction,
        step_gap=step_gap,
        held_out=held_out,
        expert=expert,
    )
    return unravel(new_params), taken, metrics | {"cost_weight": -weights[1]}


def unless(
    held: jax.Array, policy_params: PyTree, taken: PolicyStep, metrics: Metrics
) -> tuple[PyTree, PolicyStep, Metrics]:
    """What `improve` returned; where `held` [] is true, as if there had been no step."""
    params = jax.tree.map(lambda old, new: jnp.where(held, old, new), taken.policy_params, policy_params)
    metrics = {name: value if name == "cost_weight" else jnp.where(held, 0.0, value) for name, value in metrics.items()}
    return params, dataclasses.replace(taken, fraction=jnp.where(held, 0.0, taken.fraction)), metrics


def _weights(
    config: Config, constraint: Constraint, multiplier: jax.Array, step_gap: jax.Array, gram: jax.Array
) -> jax.Array:
    """Of the objectives in the step: the constraint's for reward and cost, and that of the demonstrations, if any."""
    weights = constraint.combine(multiplier, step_gap, gram[:2, :2])
    if len(gram) == 2:
        return weights
    assert config.cloning_weight is not None, "resolved beforehand"
    return jnp.append(weights, config.cloning_weight)


def outer_problem(
    config: Config,
    policy_apply: Callable[[PyTree, jax.Array], Gaussian | CensoredGaussian],
    constraint: Constraint,
    taken: PolicyStep,
) -> Outer:
    """The held-out samples, and what the step would have been worth on them under another multiplier."""
    held_out, expert = taken.held_out, taken.expert
    old_params, unravel = ravel_pytree(taken.policy_params)

    def log_prob(params: jax.Array) -> jax.Array:
        return distributions.log_prob(policy_apply(unravel(params), held_out.obs), held_out.action)

    def stepped(multiplier: jax.Array) -> jax.Array:
        weights = _weights(config, constraint, multiplier, taken.step_gap, taken.directions.gram)
        return trust_region.propose(old_params, taken.directions, weights, config.max_kl, taken.fraction)

    def importance_weights(multiplier: jax.Array) -> jax.Array:
        return importance(log_prob(stepped(multiplier)), log_prob(old_params))

    def likelihood(multiplier: jax.Array) -> jax.Array:
        assert expert is not None
        assert config.cloning_weight is not None, "resolved beforehand"
        cloned = policy_apply(unravel(stepped(multiplier)), expert.obs)
        return config.cloning_weight * jnp.mean(distributions.log_prob(cloned, expert.action))

    return Outer(
        reward_advantage=held_out.reward_advantage,
        cost_advantage=held_out.cost_advantage,
        cost=held_out.cost,
        importance_weights=importance_weights,
        likelihood=constraints.no_likelihood if expert is None else likelihood,
    )
