"""How the cost enters the policy step: the part in which the methods differ.

The policy step moves along `weights @ [x_r, x_c]`, the natural directions of the reward and the cost surrogate. A
constraint chooses the weights (`combine`) and learns from the episode cost (`update`). `cost_gap` is J_k - J_E: the
mean cost of finished episodes less the limit; `step_gap` is the same per step, the unit of the surrogates.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from ccil_jax.config import Config
from ccil_jax.learning.multipliers import Gains, optimal_weights, pid_init, pid_step
from ccil_jax.learning.optimizers import adam
from ccil_jax.methods import function_of
from ccil_jax.types import Metrics, PyTree

# Within the limit Adam lowers xi by about its learning rate in every update, without end. A multiplier softplus(xi)
# that has nearly vanished would need as many updates to matter again, so it stays at least this large.
SMALLEST_SOFTPLUS_MULTIPLIER = 1e-3


@struct.dataclass(kw_only=True)
class Multiplier:
    """The Lagrange multiplier; `parameter` is xi with lambda = softplus(xi), or lambda itself."""

    parameter: jax.Array  # []
    optimizer: PyTree  # of the dual step
    outer_optimizer: PyTree  # of the outer step


def no_likelihood(multiplier: jax.Array) -> jax.Array:
    """[] of a policy step in which the demonstrations' likelihood is no objective."""
    return jnp.zeros_like(multiplier)


@struct.dataclass(kw_only=True)
class Outer:
    """The outer (validation) loss of MALM on V held-out samples."""

    reward_advantage: jax.Array  # [V]
    cost_advantage: jax.Array  # [V]
    cost: jax.Array  # [V]
    importance_weights: Callable[[jax.Array], jax.Array] = struct.field(
        pytree_node=False
    )  # lambda -> pi_theta'(lambda)(a|s) / pi_theta_k(a|s), [V]
    # lambda -> [] the demonstrations' mean log likelihood under pi_theta'(lambda), times its weight in the policy step
    likelihood: Callable[[jax.Array], jax.Array] = struct.field(pytree_node=False, default=no_likelihood)


@struct.dataclass(kw_only=True)
class EpisodeCosts:
    """The cost of the episode that each step of a batch belongs to, and the limit."""

    cost: jax.Array  # [T, N] total if it finished within the batch, else extrapolated to a full-length episode
    limit: jax.Array  # [] J_E


def _no_state() -> PyTree:
    return ()


def _no_multiplier(state: PyTree) -> jax.Array:
    return jnp.zeros(())


def _no_gate(reward_advantage: jax.Array, cost_advantage: jax.Array, episodes: EpisodeCosts) -> jax.Array:
    return reward_advantage


def _reward_alone(multiplier: jax.Array, step_gap: jax.Array, gram: jax.Array) -> jax.Array:
    return jnp.array([1.0, 0.0])


def _learn_nothing(state: PyTree, cost_gap: jax.Array, outer: Outer | None) -> tuple[PyTree, Metrics]:
    return state, {}


class Constraint(NamedTuple):
    """How the cost enters, as pure functions. By default it does not: a constraint states what differs.

    Attributes:
        init: the state before the first iteration.
        multiplier: lambda of a state.
        gate: what takes the place of the reward advantage, which the policy step ascends.
        combine: the weights (w_r, w_c) of the natural directions x_r and x_c; the policy step moves along
            w_r x_r + w_c x_c. `gram` holds the products of the surrogates' gradients with the directions, and so tells
            how fast either surrogate changes along either direction.
        update: the state after an iteration. `cost_gap` is J_k - J_E; `outer` is None for a method that holds no
            samples out.
        entropy_in_cost: whether a step may follow the cost alone. Then the cost's surrogate carries the entropy bonus.
    """

    init: Callable[[], PyTree] = _no_state
    multiplier: Callable[[PyTree], jax.Array] = _no_multiplier  # state -> lambda >= 0, []
    gate: Callable[[jax.Array, jax.Array, EpisodeCosts], jax.Array] = _no_gate  # A_r, A_c, episodes -> A_r, [T, N] each
    # lambda [], step_gap [], gram [2, 2] -> weights [2] of the reward's and the cost's direction
    combine: Callable[[jax.Array, jax.Array, jax.Array], jax.Array] = _reward_alone
    update: Callable[[PyTree, jax.Array, Outer | None], tuple[PyTree, Metrics]] = _learn_nothing  # state, cost_gap []
    entropy_in_cost: bool = False


def unconstrained(config: Config) -> Constraint:
    """The cost does not enter (GAIL, TRPO)."""
    return Constraint()


def lagrangian(config: Config) -> Constraint:
    """Reward less lambda times cost, lambda by the rule `config.multiplier_update` of `MULTIPLIER_UPDATES`."""
    return MULTIPLIER_UPDATES[config.multiplier_update](config)


def dual_ascent(config: Config) -> Constraint:
    """Reward less lambda times cost, lambda by dual ascent along the cost gap (Algorithm 1 line 14)."""
    multiplier = ascent(config)
    return Constraint(
        init=multiplier.init,
        multiplier=multiplier.read,
        combine=_less_cost,
        update=lambda state, cost_gap, outer: (multiplier.dual(state, cost_gap), {}),
    )


def _less_cost(multiplier: jax.Array, step_gap: jax.Array, gram: jax.Array) -> jax.Array:
    return jnp.stack([jnp.ones_like(multiplier), -multiplier])


def pid(config: Config) -> Constraint:
    """Reward less lambda times cost, lambda from a PID controller of the cost gap relative to the limit."""
    gains = Gains(
        proportional=config.pid_proportional_gain,
        integral=config.pid_integral_gain,
        derivative=config.pid_derivative_gain,
        smoothing=config.pid_smoothing,
    )
    scale = limit_unit(config)
    return Constraint(
        init=lambda: pid_init(config.initial_multiplier),
        multiplier=lambda state: state.multiplier,
        combine=_less_cost,
        update=lambda state, cost_gap, outer: (pid_step(state, cost_gap / scale, gains, config.multiplier_max), {}),
    )


def trust_region_optimal(config: Config) -> Constraint:
    """The multiplier that is optimal for each single policy step, in closed form (constrained policy optimisation)."""
    return Constraint(combine=lambda multiplier, step_gap, gram: optimal_weights(gram, step_gap, config.max_kl))


def meta_lagrangian(config: Config) -> Constraint:
    """`lagrangian`, then a gradient step of the outer loss (Algorithm 1 lines 15 and 16)."""
    inner = lagrangian(config)
    if config.meta_gradient == "none":
        return inner
    multiplier = ascent(config)

    def update(state: Multiplier, cost_gap: jax.Array, outer: Outer | None) -> tuple[Multiplier, Metrics]:
        assert outer is not None, "the meta-gradient needs held-out samples"
        after_dual = multiplier.dual(state, cost_gap)
        before, after = multiplier.read(state), multiplier.read(after_dual)
        if config.outer_loss == "lagrangian":
            weight = jnp.maximum(after + config.outer_penalty * cost_gap / limit_unit(config), 0.0)
            gradient = lagrangian_gradient(before, weight, outer)
        else:
            gradient = outer_gradient(config.meta_gradient, before, after, outer)
        gradient = jnp.where(jnp.isfinite(gradient), gradient, 0.0)
        return multiplier.outer(after_dual, gradient), {"meta_gradient": gradient}

    return inner._replace(update=update)


def limit_unit(config: Config) -> jax.Array:
    """[] what a cost gap is divided by to be relative to the limit; at least 1, since a limit may be 0."""
    return jnp.maximum(jnp.asarray(config.cost_limit, jnp.result_type(float)), 1.0)


def lagrangian_loss(
    importance_weights: Float[Array, " V"],
    reward_advantage: Float[Array, " V"],
    cost_advantage: Float[Array, " V"],
    weight: Float[Array, ""],
) -> Float[Array, ""]:
    """L = -mean w (A_r - weight A_c): what the policy step should have raised, on samples that it did not see."""
    return -jnp.mean(importance_weights * (reward_advantage - weight * cost_advantage))


def lagrangian_gradient(multiplier: Float[Array, ""], weight: Float[Array, ""], outer: Outer) -> Float[Array, ""]:
    """dL/dlambda of `lagrangian_loss` through the inner policy step theta'(lambda), by forward mode.

    `weight` is that of the augmented Lagrangian (Hestenes 1969, Powell 1969), max(0, lambda' + rho e) with the relative
    gap e = (J_k - J_E) / J_E. A step along x_r - lambda x_c changes with lambda along -x_c, so on the samples of the
    step itself the gradient is proportional to lambda - weight: descent takes lambda to a value that weighs the cost
    as the gap demands. Where no step changes the cost, the gradient is 0 and lambda stays. Where the demonstrations'
    likelihood is an objective of the step, it is one of the loss too. Without it a larger lambda would always look
    better, because it leaves less of the step's length to the likelihood.
    """

    def loss(multiplier: jax.Array) -> jax.Array:
        weights = outer.importance_weights(multiplier)
        surrogate = lagrangian_loss(weights, outer.reward_advantage, outer.cost_advantage, weight)
        return surrogate - outer.likelihood(multiplier)

    return jax.jvp(loss, (multiplier,), (jnp.ones_like(multiplier),))[1]


def outer_loss(
    importance_weights: Float[Array, " V"],
    reward_advantage: Float[Array, " V"],
    cost: Float[Array, " V"],
    multiplier: Float[Array, ""],
) -> Float[Array, ""]:
    """L = mean (w A_r - lambda' d)^2 on held-out samples (Algorithm 1 line 16)."""
    return jnp.mean((importance_weights * reward_advantage - multiplier * cost) ** 2)


def outer_gradient(
    kind: str, multiplier: Float[Array, ""], after_dual: Float[Array, ""], outer: Outer
) -> Float[Array, ""]:
    """dL/dlambda' by forward mode through the inner policy step theta'(lambda), with d lambda / d lambda' = 1.

    Args:
        kind: "direct" holds theta' fixed with w = 1 (line 16 as printed); "indirect" is only the path through theta';
            "full" is the total derivative.
        multiplier: lambda, which shaped the inner step.
        after_dual: lambda'.
        outer: the held-out samples.
    """
    if kind == "direct":
        ones = jnp.ones_like(outer.cost)
        return jax.grad(outer_loss, argnums=3)(ones, outer.reward_advantage, outer.cost, after_dual)

    def loss(multiplier: jax.Array, after_dual: jax.Array) -> jax.Array:
        return outer_loss(outer.importance_weights(multiplier), outer.reward_advantage, outer.cost, after_dual)

    one = jnp.ones_like(after_dual)
    tangent = one if kind == "full" else jnp.zeros_like(after_dual)
    return jax.jvp(loss, (multiplier, after_dual), (one, tangent))[1]


def alternating(config: Config) -> Constraint:
    """Ascend the reward while the cost is within the limit, else descend the cost (Algorithm 2 lines 8 to 11)."""

    def by_batch(multiplier: jax.Array, step_gap: jax.Array, gram: jax.Array) -> jax.Array:
        return jnp.where(step_gap <= 0, jnp.array([1.0, 0.0]), jnp.array([0.0, -1.0]))

    def by_episode(reward_advantage: jax.Array, cost_advantage: jax.Array, episodes: EpisodeCosts) -> jax.Array:
        mixed = jnp.where(episodes.cost <= episodes.limit, reward_advantage, -cost_advantage)
        return (mixed - jnp.mean(mixed)) / (jnp.std(mixed) + 1e-8)

    if config.gate == "episode":
        return Constraint(gate=by_episode)
    return Constraint(combine=by_batch, entropy_in_cost=True)


def inverse_softplus(value: Float[Array, ""]) -> Float[Array, ""]:
    """xi with softplus(xi) = value, for value >= SMALLEST_SOFTPLUS_MULTIPLIER (smaller values are raised to it)."""
    value = jnp.maximum(value, SMALLEST_SOFTPLUS_MULTIPLIER)
    return value + jnp.log(-jnp.expm1(-value))


MULTIPLIER_UPDATES: Mapping[str, Callable[[Config], Constraint]] = {  # `Config.multiplier_update`
    "adam": dual_ascent,
    "sgd": dual_ascent,
    "pid": pid,
    "optimal": trust_region_optimal,
}
CONSTRAINTS: Mapping[str, Callable[[Config], Constraint]] = {  # by the names in `methods.METHODS`
    "unconstrained": unconstrained,
    "lagrangian": lagrangian,
    "meta_lagrangian": meta_lagrangian,
    "alternating": alternating,
    "trust_region_optimal": trust_region_optimal,
    "pid": pid,
}


def make(config: Config) -> Constraint:
    """The constraint of `config.method`, an on-policy one."""
    assert config.row.constraint is not None, f"{config.method} has no policy step to constrain"
    constraint: Constraint = function_of(config.row.constraint, CONSTRAINTS, "constraint")(config)
    return constraint


class Ascent(NamedTuple):
    """A parametrisation of the multiplier and its two steps."""

    init: Callable[[], Multiplier]
    read: Callable[[Multiplier], jax.Array]  # lambda, in [0, multiplier_max]
    dual: Callable[[Multiplier, jax.Array], Multiplier]  # along the cost gap (Algorithm 1 line 14)
    outer: Callable[[Multiplier, jax.Array], Multiplier]  # against dL/dlambda' (Algorithm 1 line 16)


def ascent(config: Config) -> Ascent:
    """The parametrisation `config.multiplier_update` and the outer step `config.meta_update`."""
    parametrize = {"adam": softplus_parameter, "sgd": projected_parameter}[config.multiplier_update]
    read, write = parametrize(config.multiplier_max)
    optimizer, outer_optimizer = adam(config.multiplier_learning_rate), adam(config.meta_learning_rate)

    def init() -> Multiplier:
        parameter = write(jnp.asarray(config.initial_multiplier, jnp.result_type(float)))
        return Multiplier(
            parameter=parameter,
            optimizer=optimizer.init(parameter),
            outer_optimizer=outer_optimizer.init(parameter),
        )

    def moved(state: Multiplier, parameter: jax.Array, **optimizers: PyTree) -> Multiplier:
        # A parameter beyond either end would leave lambda as it is, but need as many updates to come back (wind-up).
        parameter = jnp.clip(parameter, write(jnp.zeros(())), write(jnp.asarray(config.multiplier_max)))
        return dataclasses.replace(state, parameter=parameter, **optimizers)

    def dual(state: Multiplier, cost_gap: jax.Array) -> Multiplier:
        if config.multiplier_update == "sgd":
            gap = cost_gap / limit_unit(config) if config.gap_unit == "limit" else cost_gap
            return moved(state, write(read(state) + config.multiplier_learning_rate * gap))
        updates, optimizer_state = optimizer.update(-cost_gap, state.optimizer)
        return moved(state, state.parameter + jnp.asarray(updates), optimizer=optimizer_state)

    def outer(state: Multiplier, gradient: jax.Array) -> Multiplier:
        if config.meta_update == "sgd":
            return moved(state, write(read(state) - config.meta_learning_rate * gradient))
        slope = jax.grad(lambda parameter: read(dataclasses.replace(state, parameter=parameter)))(state.parameter)
        updates, optimizer_state = outer_optimizer.update(gradient * slope, state.outer_optimizer)
        return moved(state, state.parameter + jnp.asarray(updates), outer_optimizer=optimizer_state)

    return Ascent(init, read, dual, outer)


Parameter = tuple[Callable[[Multiplier], jax.Array], Callable[[jax.Array], jax.Array]]  # read, write


def softplus_parameter(maximum: jax.Array | float) -> Parameter:
    """lambda = softplus(parameter), capped at `maximum`."""
    return (
        lambda state: jnp.minimum(jax.nn.softplus(state.parameter), maximum),
        lambda multiplier: inverse_softplus(jnp.minimum(multiplier, maximum)),
    )


def projected_parameter(maximum: jax.Array | float) -> Parameter:
    """lambda = parameter, projected to [0, maximum] when written."""
    return (
        lambda state: jnp.clip(state.parameter, 0.0, maximum),
        lambda multiplier: jnp.clip(multiplier, 0.0, maximum),
    )
