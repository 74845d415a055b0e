"""Critics: the encoding of their observations (numbers, range, what it is for) and what they are fitted to."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ccil_jax.acting import networks, rollout, running_statistics
from ccil_jax.acting.networks import Network
from ccil_jax.agents import build, on_policy
from ccil_jax.agents.expert import expert_data
from ccil_jax.config import Config, validate
from ccil_jax.errors import ConfigError
from ccil_jax.learning import regression
from ccil_jax.types import Batch
from tests.probe_envs import Walk, quick_compilation, walk_config, walk_demonstrations

pytestmark = pytest.mark.once

IDENTITY = Network(init=lambda key: (), apply=lambda params, x: x)


def encode(x: Any, low: Any, high: Any, num_intervals: int) -> np.ndarray:
    network = networks.piecewise_linear(IDENTITY, jnp.asarray(low), jnp.asarray(high), num_intervals)
    return np.asarray(network.apply((), jnp.asarray(x, jnp.float32)))


def test_an_encoding_by_hand() -> None:
    """Two entries, in [0, 4] and [-1, 1], and four intervals of each; the numbers of an interval are side by side."""
    encoded = encode([[2.5, -0.75], [-1.0, 1.5]], [0.0, -1.0], [4.0, 1.0], 4).reshape(2, 4, 2)
    np.testing.assert_array_equal(encoded[0, :, 0], [1, 1, 0.5, 0])
    np.testing.assert_array_equal(encoded[0, :, 1], [0.5, 0, 0, 0])
    np.testing.assert_array_equal(encoded[1, :, 0], [-1, 0, 0, 0])  # below the range
    np.testing.assert_array_equal(encoded[1, :, 1], [1, 1, 1, 2])  # above it


@pytest.mark.parametrize("num_intervals", [1, 5])
def test_nothing_is_lost(num_intervals: int) -> None:
    """The numbers of an entry, times the width of an interval, add up to its distance from the lower end."""
    x = np.random.default_rng(0).normal(size=(3, 7, 2)).astype(np.float32) * 3
    low, high = np.array([-1.0, 0.5], np.float32), np.array([2.0, 0.75], np.float32)
    encoded = encode(x, low, high, num_intervals).reshape(3, 7, num_intervals, 2)
    np.testing.assert_allclose(encoded.sum(2) * (high - low) / num_intervals + low, x, rtol=1e-5, atol=1e-5)


def test_a_step_that_a_plain_network_blurs() -> None:
    """A cost that jumps within a hundredth of the range: after the same fit, the encoded critic explains most of it."""
    obs = jax.random.uniform(jax.random.key(0), (4000, 2), minval=-1, maxval=1)
    target = jnp.where(obs[:, 0] > 0.75, 1.0, 0.0)
    config, bound = Config(hidden_sizes=(16,)), jnp.ones(2)
    encoded = networks.piecewise_linear(networks.make_scalar(config, 2 * 16), -bound, bound, 16)
    unexplained = []
    for network in (networks.make_scalar(config, 2), encoded):
        critic = regression.init(network.init(jax.random.key(1)), 1e-3)
        fit = jax.jit(
            lambda critic, network=network: regression.fit(
                network.apply,
                critic,
                obs,
                target,
                jax.random.key(2),
                learning_rate=1e-3,
                num_epochs=5,
                minibatch_size=64,
            )
        )
        unexplained.append(float(fit(critic)[1] / jnp.var(target)))
    assert unexplained[0] > 0.5
    assert unexplained[1] < 0.3


def parts_of(method: str, **changes: Any) -> on_policy.Parts:
    demonstrations = walk_demonstrations() if method != "trpo" else None
    config = build.resolve(walk_config(method=method, **changes), Walk(), demonstrations)
    return on_policy.make_parts(config, Walk(), expert_data(demonstrations))


@pytest.mark.parametrize("method", ["malm", "trpo"])
def test_the_critics_range_is_that_of_the_demonstrations(method: str) -> None:
    """Or, without any, that of clipped observations: the value bends at the edges of the intervals and nowhere else."""
    with quick_compilation():
        parts = parts_of(method, critic_intervals=2, hidden_sizes=(1,), activation="relu")
        params = parts.critic.init(jax.random.key(0))
    kernel = params["params"]["Dense_0"]["kernel"]
    assert kernel.shape == (2 * Walk().obs_dim, 1)
    # A first layer that sums the upper intervals of the first entry, a second that passes it on.
    weights = jnp.zeros_like(kernel).at[Walk().obs_dim].set(1.0)
    first = {"kernel": weights, "bias": jnp.zeros(1)}
    second = {"kernel": jnp.ones((1, 1)), "bias": jnp.zeros(1)}
    params = {"params": {"Dense_0": first, "Dense_1": second}}
    if method == "trpo":
        low, high = -running_statistics.CLIP, running_statistics.CLIP
    else:
        assert parts.expert is not None
        obs = parts.expert.obs
        z = (obs[:, 0] - obs[:, 0].mean()) / obs[:, 0].std()
        low, high = min(float(z.min()), -1.0), max(float(z.max()), 1.0)
    middle = (low + high) / 2
    points = jnp.zeros((3, Walk().obs_dim)).at[:, 0].set(jnp.array([middle - 0.1, middle, high]))
    np.testing.assert_allclose(parts.critic.apply(params, points), [0.0, 0.0, 1.0], atol=2e-3)


def test_no_fewer_than_no_intervals() -> None:
    with pytest.raises(ConfigError, match="critic_intervals -1: must be at least 0"):
        validate(Config(critic_intervals=-1))


# What they are fitted to ---------------------------------------------------------------------------------------------


def assessed(**changes: Any) -> Batch:
    """The same steps, as untrained critics see them."""
    parts = parts_of("ccil", **{"gae_lambda": 0.9, "cost_gae_lambda": 0.3, "gamma": 0.95} | changes)
    with quick_compilation():
        state = jax.jit(functools.partial(on_policy.init, parts))(jax.random.key(0))
        _, transition = rollout.rollout(
            Walk(), parts.policy.apply, state.actor, state.rollout, parts.config.num_steps, jax.random.key(1)
        )
        return jax.jit(functools.partial(on_policy.assess, parts))(state, transition)[0]


@pytest.mark.parametrize("critic_lambda", [0.0, 0.7])
def test_the_target_has_a_lambda_of_its_own(critic_lambda: float) -> None:
    """It is that of a method whose advantages have this lambda; advantages, and samples, stay what they are."""
    own = assessed(critic_target="td_lambda", critic_lambda=critic_lambda)
    usual, expected = assessed(), assessed(gae_lambda=critic_lambda, cost_gae_lambda=critic_lambda)
    np.testing.assert_allclose(own.returns, expected.returns, rtol=1e-5, atol=1e-6)
    assert np.abs(own.returns - usual.returns).max() > 1e-3
    np.testing.assert_array_equal(own.reward_advantage, usual.reward_advantage)
    np.testing.assert_array_equal(own.cost_advantage, usual.cost_advantage)


def test_without_a_choice_the_advantages_lambda_is_that_of_the_target() -> None:
    with pytest.raises(ConfigError, match=r"critic_lambda 0\.5: makes no difference .*critic_target is td_lambda"):
        validate(Config(critic_lambda=0.5))
    with pytest.raises(ConfigError, match=r"critic_lambda 1\.5: must be at most 1"):
        validate(Config(critic_target="td_lambda", critic_lambda=1.5))


def test_the_cost_has_a_discount_of_its_own() -> None:
    """The cost's is that of a method with this discount for both signals; the reward's stays what it is."""
    own, usual, both = assessed(cost_gamma=0.5), assessed(), assessed(gamma=0.5)
    np.testing.assert_array_equal(assessed(cost_gamma=0.95).cost_advantage, usual.cost_advantage)
    np.testing.assert_allclose(own.cost_advantage, both.cost_advantage, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(own.returns[:, on_policy.COST], both.returns[:, on_policy.COST], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(own.reward_advantage, usual.reward_advantage)
    np.testing.assert_array_equal(own.returns[:, on_policy.REWARD], usual.returns[:, on_policy.REWARD])
    assert np.abs(own.cost_advantage - usual.cost_advantage).max() > 1e-3


def test_the_costs_discount_is_refused_beyond_1_and_without_a_cost() -> None:
    with pytest.raises(ConfigError, match=r"cost_gamma 1\.5: must be at most 1"):
        validate(Config(cost_gamma=1.5))
    with pytest.raises(ConfigError, match=r"cost_gamma 0\.5: makes no difference to this run of method gail"):
        validate(Config(method="gail", cost_gamma=0.5))


def test_explained_variance_by_hand() -> None:
    """Of a perfect critic, of one that is off by a constant, of one that knows nothing, of one that is worse."""
    target = np.array([[1.0, 2.0], [3.0, 6.0]], np.float32)
    values = np.stack([target, target + 5, np.zeros((2, 2)), -target]).astype(np.float32)
    explained = on_policy.explained_variance(jnp.asarray(values), jnp.broadcast_to(target, (4, 2, 2)))
    np.testing.assert_allclose(explained, [1, 1, 0, -3], rtol=1e-6)
    nothing = jnp.ones((1, 2, 2))
    np.testing.assert_array_equal(on_policy.explained_variance(nothing * 7, nothing), [0.0])
