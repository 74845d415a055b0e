"""Whole training runs on environments whose answers are known: values, and a multiplier that must settle."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ccil_jax.acting import networks, running_statistics
from ccil_jax.agents import on_policy
from ccil_jax.config import Config
from ccil_jax.training import runner
from ccil_jax.training.runner import Result
from tests.probe_envs import Conflict, Sign, quick_compilation

pytestmark = pytest.mark.once

# Values --------------------------------------------------------------------------------------------------------------


def fitted_values(**probe: Any) -> np.ndarray:
    """[seed, critic, sign] values that the critics give to the signs -1 and 1 after training on `Sign`."""
    config = Config(
        method="trpo",
        env_steps=200 * 64,
        num_envs=8,
        batch_size=64,
        generator_steps=1,
        hidden_sizes=(8,),
        gamma=0.5,
        critic_learning_rate=0.02,
        critic_minibatch_size=32,
    )
    with quick_compilation():
        state = runner.train(config, Sign(**probe), num_seeds=2).state.agent
    critic = networks.make_scalar(config, 1)
    values = np.zeros((2, 2, 2))
    for seed in range(2):
        statistics, params = jax.tree.map(lambda x, i=seed: x[i], (state.actor.obs_statistics, state.critics.params))
        obs = running_statistics.normalize(statistics, jnp.array([[-1.0], [1.0]]))
        for index in range(2):
            values[seed, index] = critic.apply(jax.tree.map(lambda x, i=index: x[i], params), obs)
    return values


def test_values_of_an_observation_and_of_a_constant_when_the_episode_terminates() -> None:
    values = fitted_values(terminates=True)
    np.testing.assert_allclose(values[:, on_policy.REWARD], [[-1.0, 1.0]] * 2, atol=0.03)
    np.testing.assert_allclose(values[:, on_policy.COST], 0.5, atol=0.03)


def test_values_at_a_time_limit_go_on_beyond_it() -> None:
    """V = z + gamma V: twice the signal at gamma = 1/2, though every episode is cut after one step."""
    values = fitted_values(terminates=False)
    np.testing.assert_allclose(values[:, on_policy.REWARD], [[-2.0, 2.0]] * 2, atol=0.06)
    np.testing.assert_allclose(values[:, on_policy.COST], 1.0, atol=0.06)


# Reward against cost -------------------------------------------------------------------------------------------------

DEVIATION = 0.8  # of the policy at the optimum; the mean there is 1
SPREAD = math.sqrt(DEVIATION**2 + DEVIATION**4 / 2)  # of the reward under that policy
MULTIPLIER = 1 / SPREAD
ENTROPY_COEFFICIENT = 2 * DEVIATION**2 / SPREAD
COST_LIMIT = (1 + DEVIATION**2) / 2


def train_on_conflict(**changes: Any) -> Result:
    base = {
        "method": "expert",
        "cost_limit": COST_LIMIT,
        "policy_entropy_coefficient": ENTROPY_COEFFICIENT,
        "env_steps": 500 * 512,
        "num_envs": 512,
        "batch_size": 512,
        "generator_steps": 1,
        "hidden_sizes": (4,),
        "fisher_stride": 16,
        "max_kl": 1e-3,
        "critic_epochs": 1,
        "critic_learning_rate": 0.01,
        "multiplier_update": "sgd",
        "initial_multiplier": 0.0,
        "multiplier_learning_rate": 0.1,
    }
    with quick_compilation():
        return runner.train(Config.from_base(base, changes), Conflict(), num_seeds=3)


def check_settled(result: Result) -> None:
    """Over the last half of the run, every seed's multiplier and cost are within 5% of the solution and stay there."""
    half = len(result.metrics["multiplier"]) // 2
    multiplier, cost = (result.metrics[name][half:] for name in ("multiplier", "episode_cost"))
    np.testing.assert_allclose(multiplier.mean(axis=0), MULTIPLIER, rtol=0.05)
    np.testing.assert_allclose(cost.mean(axis=0), COST_LIMIT, rtol=0.05)
    assert (multiplier.std(axis=0) < 0.05 * MULTIPLIER).all()


def test_the_multiplier_settles_where_the_kkt_conditions_put_it() -> None:
    """The step ascends A_r / std(A_r) - lambda A_c + beta H, and the dual moves lambda until the cost meets its limit.

    One step an episode, so that (up to its critic's value, a constant, which no gradient sees) A_r is the reward and
    A_c the cost. Reward -(a - 2)^2 / 2, cost a^2 / 2, a ~ N(m, s^2), hence

        E r = -((m - 2)^2 + s^2) / 2      E d = (m^2 + s^2) / 2      H = log s + constant
        std(r) = sqrt((m - 2)^2 s^2 + s^4 / 2)    (the variance of u^2 / 2 for u ~ N(m - 2, s^2))

    The advantages are divided by the deviation of the batch at hand, so the gradients are those of E r over std(r) held
    constant, and the KKT conditions are

        d/dm:       -(m - 2) / std(r) - lambda m = 0
        d/dlog s:   -s^2 / std(r) - lambda s^2 + beta = 0
        cost:       (m^2 + s^2) / 2 = limit

    Three equations; the test picks m = 1 and s = 0.8 and asks for the beta and the limit that put the optimum there:
    lambda = 1 / std(r), beta = 2 s^2 / std(r), limit = (1 + s^2) / 2 with std(r) = sqrt(s^2 + s^4 / 2). Without the
    constraint the mean would be 2, without the entropy s would shrink to 0.
    """
    result = train_on_conflict()
    check_settled(result)
    # The surplus that drove it there is gone, and so is the slack: both signs of the gap occur.
    gaps = result.metrics["episode_cost"][-100:] - COST_LIMIT
    assert (gaps.min(axis=0) < 0).all()
    assert (gaps.max(axis=0) > 0).all()
    policy = result.actor.policy_params
    np.testing.assert_allclose(np.exp(policy["log_std"][:, 0]), DEVIATION, rtol=0.2)


def test_a_pid_controller_settles_there_too() -> None:
    check_settled(train_on_conflict(multiplier_update="pid", pid_integral_gain=0.1))


def test_the_optimal_multiplier_of_each_step_keeps_the_cost_at_its_limit() -> None:
    """It has no memory, so it follows the noise of each batch: its mean is judged, and the cost."""
    result = train_on_conflict(multiplier_update="optimal")
    half = len(result.metrics["cost_weight"]) // 2
    np.testing.assert_allclose(result.metrics["episode_cost"][half:].mean(axis=0), COST_LIMIT, rtol=0.05)
    weight = np.median(result.metrics["cost_weight"][half:], axis=0)
    np.testing.assert_allclose(weight, MULTIPLIER, rtol=0.25)


def test_swapping_reward_and_cost_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mutation that the test above must catch: the learner takes the one's advantage for the other's."""
    monkeypatch.setattr(on_policy, "REWARD", 1)
    monkeypatch.setattr(on_policy, "COST", 0)
    with pytest.raises(AssertionError):
        check_settled(train_on_conflict(env_steps=200 * 512))
