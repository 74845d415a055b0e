"""Checks what the parts of an agent return, where they may be a user's own.

Each function here gives a part back with its functions wrapped. The wrappers look at shapes and types while a program
is traced, and raise a `ConfigError` that names the function and what it must return.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import optax

from ccil_jax import user_code
from ccil_jax.acting.distributions import Gaussian, TanhGaussian
from ccil_jax.acting.networks import Network, Policy, SquashedPolicy
from ccil_jax.errors import ConfigError
from ccil_jax.learning.constraints import Constraint
from ccil_jax.learning.optimizers import Optimizer
from ccil_jax.learning.reward_models import RewardModel
from ccil_jax.trees import difference
from ccil_jax.types import Metrics, PyTree


def _check_shape(what: str, array: Any, wanted: tuple[int, ...], meaning: str) -> None:
    """Raises `ConfigError` where what a function returned is no array of this shape."""
    found = getattr(array, "shape", () if isinstance(array, int | float) else None)
    if found != wanted:
        returned = type(array).__name__ if found is None else f"an array of shape {found}"
        form = f"an array of shape {wanted}" if wanted else "one number"
        raise ConfigError(f"{what}: returned {returned}; return {meaning}, {form}")


def _updating(what: str, update: Callable[..., Any]) -> Callable[..., tuple[PyTree, Metrics]]:
    """An `update` that has to return a state like its first argument, and metrics that are numbers."""

    def checked(state: PyTree, *arguments: Any) -> tuple[PyTree, Metrics]:
        result = user_code.call(what, update, state, *arguments)
        if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)):
            returned = "an array" if isinstance(result, jax.Array) else type(result).__name__
            raise ConfigError(
                f"{what}: returned {returned}; return the new state and a dict of metrics, which may be empty"
            )
        if differs := difference(state, result[0]):
            raise ConfigError(f"{what}: the new state has another form than that of `init` ({differs}); keep its form")
        for name, value in result[1].items():
            _check_shape(f"{what}: metric {name!r}", value, (), "its value")
        return result[0], result[1]

    return checked


def constraint(part: Constraint) -> Constraint:
    """`part`, checked: lambda [], gated advantages [T, N], weights [2], and the state after `update`."""
    user_code.check_type("constraint", part, Constraint)

    def multiplier(state: PyTree) -> jax.Array:
        value: jax.Array = user_code.call("constraint.multiplier", part.multiplier, state)
        _check_shape("constraint.multiplier", value, (), "lambda")
        return value

    def gate(reward_advantage: jax.Array, *arguments: Any) -> jax.Array:
        value: jax.Array = user_code.call("constraint.gate", part.gate, reward_advantage, *arguments)
        _check_shape("constraint.gate", value, reward_advantage.shape, "the advantages [T, N] to ascend")
        return value

    def combine(*arguments: jax.Array) -> jax.Array:
        weights: jax.Array = user_code.call("constraint.combine", part.combine, *arguments)
        _check_shape("constraint.combine", weights, (2,), "the weights (w_r, w_c)")
        return weights

    return part._replace(
        init=functools.partial(user_code.call, "constraint.init", part.init),
        multiplier=multiplier,
        gate=gate,
        combine=combine,
        update=_updating("constraint.update", part.update),
    )


def reward_model(part: RewardModel) -> RewardModel:
    """`part`, checked: rewards [T, N], and the state after `update`."""
    user_code.check_type("reward_model", part, RewardModel)

    def reward(state: PyTree, transition: Any) -> jax.Array:
        value: jax.Array = user_code.call("reward_model.reward", part.reward, state, transition)
        _check_shape("reward_model.reward", value, transition.cost.shape, "one reward for each step, [T, N]")
        return value

    return part._replace(
        reward=reward,
        init=functools.partial(user_code.call, "reward_model.init", part.init),
        begin=functools.partial(user_code.call, "reward_model.begin", part.begin),
        update=_updating("reward_model.update", part.update),
    )


def policy(part: Policy, action_dim: int) -> Policy:
    """`part`, checked: a `Gaussian` with means [..., action_dim] and log-deviations [action_dim]."""
    user_code.check_type("policy", part, Policy)

    def apply(params: PyTree, obs: jax.Array) -> Gaussian:
        distribution: Gaussian = user_code.call("policy.apply", part.apply, params, obs)
        _check_gaussian(distribution, Gaussian)
        _check_shape("policy.apply: mean", distribution.mean, (*obs.shape[:-1], action_dim), "the means")
        meaning = "log-deviations that are the same in every state"
        _check_shape("policy.apply: log_std", distribution.log_std, (action_dim,), meaning)
        return distribution

    return part._replace(init=functools.partial(user_code.call, "policy.init", part.init), apply=apply)


def squashed_policy(part: Policy | SquashedPolicy, action_dim: int) -> SquashedPolicy:
    """`part`, checked: a `TanhGaussian` whose means and log-deviations are [..., action_dim]."""
    if not isinstance(part, SquashedPolicy):
        user_code.check_type("policy", part, Policy)

    def apply(params: PyTree, obs: jax.Array) -> TanhGaussian:
        distribution: TanhGaussian = user_code.call("policy.apply", part.apply, params, obs)
        _check_gaussian(distribution, TanhGaussian)
        wanted = (*obs.shape[:-1], action_dim)
        _check_shape("policy.apply: mean", distribution.gaussian.mean, wanted, "the means")
        _check_shape("policy.apply: log_std", distribution.gaussian.log_std, wanted, "log-deviations of every state")
        return distribution

    return SquashedPolicy(init=functools.partial(user_code.call, "policy.init", part.init), apply=apply)


def _check_gaussian(distribution: Any, wanted: type) -> None:
    if not isinstance(distribution, wanted):
        raise ConfigError(
            f"policy.apply: returned {type(distribution).__name__}; return a {wanted.__name__} of "
            "ccil_jax.acting.distributions"
        )


def critic(part: Network) -> Network:
    """`part`, checked: one value for each observation, [..., obs_dim] -> [...]."""
    user_code.check_type("critic", part, Network)

    def apply(params: PyTree, obs: jax.Array) -> jax.Array:
        value: jax.Array = user_code.call("critic.apply", part.apply, params, obs)
        _check_shape("critic.apply", value, obs.shape[:-1], "one value for each observation")
        return value

    return part._replace(init=functools.partial(user_code.call, "critic.init", part.init), apply=apply)


def optimizer(part: Optimizer) -> Optimizer:
    """`part`, checked: it maps a learning rate to an `optax.GradientTransformation`."""

    def make(learning_rate: jax.Array | float) -> optax.GradientTransformation:
        rule = user_code.call("optimizer", part, learning_rate)
        if not isinstance(rule, optax.GradientTransformation):
            raise ConfigError(
                f"optimizer: returned {type(rule).__name__}; return an optax.GradientTransformation, "
                "as optax.adamw does for a learning rate"
            )
        return rule

    return make


def join_metrics(metrics: Metrics, **of_parts: Metrics) -> Metrics:
    """All metrics in one dict. Raises `ConfigError` where a part has one of a name that is taken."""
    joined = dict(metrics)
    for part, added in of_parts.items():
        if taken := sorted(added.keys() & joined.keys()):
            raise ConfigError(f"{part}.update: metric {taken[0]!r} is there already; give it another name")
        joined |= added
    return joined
