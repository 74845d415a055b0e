"""The networks: policies, critics and discriminator. The rest of the package sees only init and apply."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ccil_jax.acting import distributions, running_statistics
from ccil_jax.acting.distributions import CensoredGaussian, Gaussian, TanhGaussian
from ccil_jax.config import Config
from ccil_jax.methods import function_of
from ccil_jax.types import PyTree
from envs.base import Environment

ACTIVATIONS = {"tanh": nn.tanh, "relu": nn.relu, "swish": nn.swish}


class MLP(nn.Module):
    """Fully connected network; `final_scale` shrinks the initial last layer.

    Initial weights are Glorot and Bengio's (2010), for tanh. Not orthogonal ones: their batched QR kernel on the CPU
    waits for helpers from the very threads it occupies, and hung with 5 seeds on 2 and on 3 threads (jaxlib 0.10).
    """

    sizes: Sequence[int]
    activation: Callable[[jax.Array], jax.Array]
    final_scale: float = 1.0

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for size in self.sizes[:-1]:
            x = self.activation(nn.Dense(size, kernel_init=_glorot(1.0))(x))
        return nn.Dense(self.sizes[-1], kernel_init=_glorot(self.final_scale))(x)


def _glorot(scale: float) -> jax.nn.initializers.Initializer:
    return nn.initializers.variance_scaling(scale**2, "fan_avg", "uniform")


class Network(NamedTuple):
    """A pair of pure functions."""

    init: Callable[[jax.Array], PyTree]
    apply: Callable[..., jax.Array]


class Policy(NamedTuple):
    """`init(key) -> params`; `apply(params, normalized_obs) -> Gaussian`, or what `censored` makes of it."""

    init: Callable[[jax.Array], PyTree]
    apply: Callable[[PyTree, jax.Array], Gaussian | CensoredGaussian]


class SquashedPolicy(NamedTuple):
    """`init(key) -> params`; `apply(params, obs) -> TanhGaussian`."""

    init: Callable[[jax.Array], PyTree]
    apply: Callable[[PyTree, jax.Array], TanhGaussian]


def _mlp(config: Config, out: int, final_scale: float) -> MLP:
    return MLP((*config.hidden_sizes, out), ACTIVATIONS[config.activation], final_scale)


def make_policy(config: Config, obs_dim: int, action_dim: int, initial_std: jax.typing.ArrayLike = 1.0) -> Policy:
    """Gaussian policy: mean from an MLP whose last layer starts small, log-std a free vector (authors).

    `initial_std` is [action_dim] or one for all.
    """
    mlp = _mlp(config, action_dim, final_scale=0.01)

    def init(key: jax.Array) -> PyTree:
        log_std = jnp.broadcast_to(jnp.log(jnp.asarray(initial_std, jnp.result_type(float))), action_dim)
        return {"mean": mlp.init(key, jnp.zeros((1, obs_dim))), "log_std": log_std}

    def apply(params: PyTree, obs: Float[Array, "... D"]) -> Gaussian:
        mean: jax.Array = mlp.apply(params["mean"], obs)  # type: ignore[assignment]  # flax: Any or a tuple
        return Gaussian(mean=mean, log_std=params["log_std"])

    return Policy(init, apply)


def censored(policy: Policy, env: Environment) -> Policy:
    """The policy whose actions are clipped to the environment's range when they are drawn, as they are executed."""
    low, high = (jnp.asarray(bound, jnp.result_type(float)) for bound in (env.action_low, env.action_high))

    def apply(params: PyTree, obs: Float[Array, "... D"]) -> CensoredGaussian:
        gaussian = distributions.gaussian_of(policy.apply(params, obs))
        return CensoredGaussian(gaussian=gaussian, low=low, high=high)

    return Policy(policy.init, apply)


def with_likelihood(config: Config, env: Environment, policy: Policy) -> Policy:
    """The policy with the likelihood `config.action_likelihood` of its actions."""
    return censored(policy, env) if config.action_likelihood == "censored" else policy


LOG_STD_RANGE = (-5.0, 2.0)  # of a squashed policy (the published code of IQ-Learn, after pytorch_sac)


def make_squashed_policy(config: Config, env: Environment) -> SquashedPolicy:
    """Tanh-Gaussian policy within the environment's action range; mean and deviation from one MLP."""
    mlp = _mlp(config, 2 * env.action_dim, final_scale=1.0)
    low, high = jnp.asarray(env.action_low), jnp.asarray(env.action_high)
    smallest, largest = LOG_STD_RANGE

    def init(key: jax.Array) -> PyTree:
        return {"squashed": mlp.init(key, jnp.zeros((1, env.obs_dim)))}

    def apply(params: PyTree, obs: Float[Array, "... D"]) -> TanhGaussian:
        output: jax.Array = mlp.apply(params["squashed"], obs)  # type: ignore[assignment]  # flax: Any or a tuple
        mean, spread = jnp.split(output, 2, axis=-1)
        log_std = smallest + (largest - smallest) * (jnp.tanh(spread) + 1) / 2
        return TanhGaussian(
            gaussian=Gaussian(mean=mean, log_std=log_std), center=(low + high) / 2, half_range=(high - low) / 2
        )

    return SquashedPolicy(init, apply)


def initial_std(env: Environment) -> np.ndarray:
    """1 (authors), but no wider than the range's half: Humanoid's actions in +-0.4 would nearly all be clipped."""
    return np.minimum(1.0, (np.asarray(env.action_high) - np.asarray(env.action_low)) / 2)


def gaussian(config: Config, env: Environment) -> Policy:
    """`make_policy` for a task."""
    return make_policy(config, env.obs_dim, env.action_dim, initial_std(env))


POLICIES: Mapping[str, Callable[[Config, Environment], Policy | SquashedPolicy]] = {  # by the names in `METHODS`
    "gaussian": gaussian,
    "squashed": make_squashed_policy,
}


def policy_of(config: Config, env: Environment) -> Any:
    """The policy network of `config.method`: a `Policy`, or a `SquashedPolicy`."""
    return function_of(config.row.policy, POLICIES, "policy")(config, env)


def piecewise_linear(
    network: Network, low: Float[Array, " D"], high: Float[Array, " D"], num_intervals: int
) -> Network:
    """The network on a piecewise linear encoding of its inputs (Gorishniy, Rubachev and Babenko 2022).

    The range [low, high] of each entry x is divided into K equal intervals with the edges e_0 to e_K. K numbers take
    the place of x: the i-th is (x - e_i) / (e_i+1 - e_i), clipped to [0, 1]. So a network can tell apart values that
    lie close together, and bend its function at every edge, which a small network on x itself learns slowly or never.
    The first number is not clipped at 0 nor the last at 1, so that values outside the range can be told apart too.

    Args:
        network: takes [..., D K] inputs, the K numbers of each interval side by side.
        low: lower end of the range of each entry.
        high: upper end, larger than `low`.
        num_intervals: K, at least 1.

    Returns:
        The network of [..., D] inputs.
    """
    width = (high - low) / num_intervals
    edges = low + width * jnp.arange(num_intervals)[:, None]  # [K, D]
    smallest = jnp.zeros((num_intervals, 1)).at[0].set(-jnp.inf)
    largest = jnp.ones((num_intervals, 1)).at[-1].set(jnp.inf)

    def apply(params: PyTree, x: Float[Array, "... D"]) -> jax.Array:
        encoded = jnp.clip((x[..., None, :] - edges) / width, smallest, largest)
        return network.apply(params, encoded.reshape(*x.shape[:-1], -1))

    return Network(network.init, apply)


def make_critic(config: Config, env: Environment, demonstrated: Float[Array, "n D"] | None) -> Network:
    """A value function of normalised observations, [..., obs_dim] -> [...].

    With `config.critic_intervals` above 0 the observations are encoded, see `piecewise_linear`. The range of each entry
    is that of the demonstrations once they are normalised, but at least one standard deviation to each side of their
    mean, so that an entry that never varies in them has a range too. Without demonstrations it is where normalised
    observations are clipped.

    Args:
        config: resolved.
        env: the task.
        demonstrated: observations of the demonstrations, None where there are none.
    """
    if not config.critic_intervals:
        return make_scalar(config, env.obs_dim)
    network = make_scalar(config, env.obs_dim * config.critic_intervals)
    if demonstrated is None:
        high = jnp.full(env.obs_dim, running_statistics.CLIP)
        return piecewise_linear(network, -high, high, config.critic_intervals)
    statistics = running_statistics.update(running_statistics.init(env.obs_dim), demonstrated)
    normalized = running_statistics.normalize(statistics, demonstrated)
    low, high = jnp.minimum(jnp.min(normalized, 0), -1.0), jnp.maximum(jnp.max(normalized, 0), 1.0)
    return piecewise_linear(network, low, high, config.critic_intervals)


def make_scalar(config: Config, input_dim: int, final_scale: float = 1.0) -> Network:
    """A critic or discriminator: [..., input_dim] -> [...]."""
    mlp = _mlp(config, 1, final_scale)

    def init(key: jax.Array) -> PyTree:
        return mlp.init(key, jnp.zeros((1, input_dim)))

    def apply(params: PyTree, x: Float[Array, "... D"]) -> Float[Array, "..."]:
        values: jax.Array = mlp.apply(params, x)  # type: ignore[assignment]  # flax: Any or a tuple with collections
        return values[..., 0]

    return Network(init, apply)
