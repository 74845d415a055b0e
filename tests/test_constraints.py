"""How the cost enters: dual steps, the gates of CVAG, and the entropy bonus."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from ccil_jax.agents.build import AGENTS
from ccil_jax.config import Config, validate
from ccil_jax.errors import ConfigError
from ccil_jax.learning import constraints, policy_step
from ccil_jax.learning.constraints import EpisodeCosts
from ccil_jax.methods import METHODS
from ccil_jax.types import PyTree
from tests.probe_envs import policy_problem

# Dual ascent ---------------------------------------------------------------------------------------------------------


def ascend(config: Config, gaps: list[float]) -> list[float]:
    """The multiplier after each dual step."""
    constraint = constraints.lagrangian(config)
    update = jax.jit(lambda state, gap: constraint.update(state, gap, None)[0])
    state, found = constraint.init(), []
    for gap in gaps:
        state = update(state, jnp.asarray(gap))
        found.append(float(constraint.multiplier(state)))
    return found


def test_sgd_is_projected_ascent_on_the_cost_gap() -> None:
    config = Config(multiplier_update="sgd", initial_multiplier=1.0, multiplier_learning_rate=0.05, multiplier_max=3.0)
    gaps = [10.0, -4.0, -100.0, 2.0, 1000.0, -20.0]
    #        1.5   1.3    0 (projected)  0.1  3 (capped)  2
    np.testing.assert_allclose(ascend(config, gaps), [1.5, 1.3, 0.0, 0.1, 3.0, 2.0], rtol=1e-6)


@pytest.mark.parametrize(("limit", "unit"), [(20.0, 20.0), (1.0, 1.0), (0.25, 1.0), (0.0, 1.0)])
def test_in_units_of_the_limit_a_gap_moves_the_multiplier_alike_on_every_task(limit: float, unit: float) -> None:
    """lambda + rate (J - J_E) / max(J_E, 1), to the last bit; on the cost's own scale where nothing is said."""
    fields: dict[str, Any] = {"multiplier_update": "sgd", "initial_multiplier": 0.5, "cost_limit": limit}
    rate, start = np.float32(0.3), np.float32(0.5)
    for gap in (7.0, -0.7):
        config = Config(**fields, multiplier_learning_rate=0.3, gap_unit="limit")
        assert ascend(config, [gap]) == [start + rate * (np.float32(gap) / np.float32(unit))]
        (plain,) = ascend(config.replace(gap_unit="cost", multiplier_learning_rate=0.01), [gap])
        assert plain == start + np.float32(0.01) * np.float32(gap)
    for update in ("adam", "pid"):
        with pytest.raises(ConfigError, match=r"gap_unit limit: makes no difference .*whose multiplier_update is sgd"):
            validate(Config(method="ccil", gap_unit="limit", multiplier_update=update))


def adam_on_softplus(initial: float, rate: float, gaps: list[float]) -> list[float]:
    """Kingma and Ba's Adam, line by line, descending xi along -(J_k - J_E)."""
    xi, m, v, found = math.log(math.expm1(initial)), 0.0, 0.0, []
    for t, gap in enumerate(gaps, 1):
        gradient = -gap
        m = 0.9 * m + 0.1 * gradient
        v = 0.999 * v + 0.001 * gradient**2
        xi -= rate * (m / (1 - 0.9**t)) / (math.sqrt(v / (1 - 0.999**t)) + 1e-8)
        found.append(math.log1p(math.exp(xi)))
    return found


def test_adam_moves_xi_and_reads_its_softplus() -> None:
    config = Config(multiplier_update="adam", initial_multiplier=0.01, multiplier_learning_rate=0.05)
    gaps = [10.0, 3.0, -50.0, -1.0, 0.0, 20.0]
    np.testing.assert_allclose(ascend(config, gaps), adam_on_softplus(0.01, 0.05, gaps), rtol=1e-4)
    # The first step of Adam has length `rate` whatever the gap: xi = log(e^0.01 - 1) + 0.05 = -4.55017.
    np.testing.assert_allclose(ascend(config, [1e-3])[0], math.log1p(math.exp(-4.5501661)), rtol=1e-4)


@pytest.mark.parametrize("form", ["adam", "sgd"])
def test_a_positive_gap_raises_the_multiplier_and_a_negative_gap_lowers_it(form: str) -> None:
    config = Config(multiplier_update=form, initial_multiplier=1.0)
    assert ascend(config, [5.0])[0] > 1 > ascend(config, [-5.0])[0] > 0


@pytest.mark.parametrize("form", ["adam", "sgd"])
def test_the_multiplier_is_capped_and_does_not_wind_up(form: str) -> None:
    config = Config(multiplier_update=form, initial_multiplier=1.0, multiplier_max=2.0)
    found = ascend(config, [100.0] * 200 + [-100.0] * 20)
    assert found[199] == 2.0
    assert max(found) <= 2.0
    assert found[-1] < 2.0  # unbounded, xi would have come to 10 and needed more than 100 updates to return


@pytest.mark.parametrize("form", ["adam", "sgd"])
def test_it_starts_at_the_initial_multiplier(form: str) -> None:
    constraint = constraints.lagrangian(Config(multiplier_update=form, initial_multiplier=0.01))
    np.testing.assert_allclose(constraint.multiplier(constraint.init()), 0.01, rtol=1e-5)


@pytest.mark.parametrize("value", [1e-3, 0.01, 0.5, 1.0, 5.0, 20.0, 100.0])
def test_inverse_softplus(value: float) -> None:
    xi = constraints.inverse_softplus(jnp.asarray(value))
    np.testing.assert_allclose(xi, value + math.log(-math.expm1(-value)), rtol=1e-5)
    np.testing.assert_allclose(jax.nn.softplus(xi), value, rtol=1e-5)


def test_inverse_softplus_of_what_no_xi_reaches_is_the_smallest_allowed() -> None:
    for value in (0.0, 1e-9, -3.0):
        xi = constraints.inverse_softplus(jnp.asarray(value))
        np.testing.assert_allclose(jax.nn.softplus(xi), 1e-3, rtol=1e-4)


# The table -----------------------------------------------------------------------------------------------------------


def test_a_limit_holds_where_the_cost_enters_and_nowhere_else() -> None:
    assert {name for name, row in METHODS.items() if row.limit == "prescribed"} == {"lgail", "expert"}
    assert {name for name, row in METHODS.items() if row.limit is None} == {"gail", "trpo", "bc", "iq_learn"}
    assert {name for name, row in METHODS.items() if row.constraint == "unconstrained"} == {"gail", "trpo"}


def test_every_name_in_the_table_stands_for_something() -> None:
    for row in METHODS.values():
        assert row.agent in AGENTS
        assert (row.constraint in constraints.CONSTRAINTS) == (row.agent == "on_policy")
        assert (row.reward is not None) == (row.agent == "on_policy")
        assert row.imitates == (row.reward != "task")


def test_lagrangian_combines_reward_less_lambda_times_cost_and_gail_ignores_the_cost() -> None:
    gram, gap = jnp.eye(2), jnp.asarray(7.0)
    lagrangian, unconstrained = constraints.lagrangian(Config()), constraints.unconstrained(Config())
    np.testing.assert_array_equal(lagrangian.combine(jnp.asarray(2.5), gap, gram), [1.0, -2.5])
    np.testing.assert_array_equal(unconstrained.combine(jnp.asarray(2.5), gap, gram), [1.0, 0.0])
    assert unconstrained.multiplier(unconstrained.init()) == 0


# CVAG ----------------------------------------------------------------------------------------------------------------


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def test_the_batch_gate_follows_the_reward_within_the_limit_and_else_descends_the_cost() -> None:
    with jax.enable_x64(True):
        problem = policy_problem(0, np.float64, method="cvag")
        constraint = constraints.alternating(problem.config)

        @jax.jit
        def run(gap: jax.Array) -> tuple[PyTree, policy_step.PolicyStep]:
            arguments = (problem.params, problem.training, jnp.zeros(()), gap, problem.held_out)
            return policy_step.improve(problem.config, problem.policy.apply, constraint, *arguments)[:2]

        for gap in (-1.0, 0.0, 1e-3, 10.0):
            new, taken = run(jnp.asarray(gap))
            moved = np.asarray(ravel_pytree(new)[0] - ravel_pytree(problem.params)[0])
            x_r, x_c = np.asarray(taken.directions.x)
            np.testing.assert_allclose(cosine(moved, x_r if gap <= 0 else -x_c), 1.0, rtol=1e-9)
            assert abs(cosine(x_r, x_c)) < 0.9  # so that the two cannot be confused


def test_the_episode_gate_takes_the_reward_on_steps_of_episodes_within_the_limit_and_else_less_cost() -> None:
    # [T = 4, N = 2]; episodes end mid-batch, their costs are known or extrapolated (tests/test_episodes.py).
    reward = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]])
    cost = np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0], [70.0, 80.0]])
    episode_cost = np.array([[3.0, 9.0], [3.0, 9.0], [5.0, 4.0], [5.0, 4.0]])
    # Limit 4: of the first simulation the first episode is within, of the second the last (exactly at the limit).
    mixed = np.array([[1.0, -20.0], [3.0, -40.0], [-50.0, 6.0], [-70.0, 8.0]])
    constraint = constraints.alternating(Config(method="cvag", gate="episode"))
    episodes = EpisodeCosts(cost=jnp.asarray(episode_cost), limit=jnp.asarray(4.0))
    gated = constraint.gate(jnp.asarray(reward), jnp.asarray(cost), episodes)
    np.testing.assert_allclose(gated, (mixed - mixed.mean()) / mixed.std(), rtol=1e-5)
    # The mixture is what the policy then ascends, whatever the batch's mean cost.
    np.testing.assert_array_equal(constraint.combine(jnp.zeros(()), jnp.asarray(5.0), jnp.eye(2)), [1.0, 0.0])


def test_no_other_method_gates_its_advantages() -> None:
    reward, episodes = jnp.ones((3, 2)), EpisodeCosts(cost=jnp.full((3, 2), 9.0), limit=jnp.asarray(1.0))
    for name in (name for name, row in METHODS.items() if row.constraint):
        gated = constraints.make(Config(method=name, cost_limit=1.0)).gate(reward, -reward, episodes)
        np.testing.assert_array_equal(gated, reward)


# Entropy -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "gate"), [("gail", "batch"), ("ccil", "batch"), ("cvag", "batch"), ("cvag", "episode")]
)
def test_the_entropy_bonus_counts_once_in_every_direction_of_the_step(name: str, gate: str) -> None:
    """Without advantages only the bonus beta sum(log_std) is left: gradient beta per log-std entry and nothing else.

    The Fisher matrix is 2 on the log-std's diagonal, so the direction there is beta / (2 + damping) and elsewhere 0.
    """
    problem = policy_problem(0, method=name, cg_damping=0.1, gate=gate)
    zero = jnp.zeros_like(problem.training.cost)
    flat, unravel = ravel_pytree(problem.params)

    @jax.jit
    def run(gap: jax.Array, coefficient: jax.Array) -> tuple[jax.Array, jax.Array]:
        config = problem.config.replace(policy_entropy_coefficient=coefficient)
        constraint = constraints.make(config)
        batch = problem.training.replace(reward_advantage=zero, cost_advantage=zero)
        multiplier = jnp.asarray(0.7)
        new, taken, _ = policy_step.improve(
            config, problem.policy.apply, constraint, problem.params, batch, multiplier, gap, problem.held_out
        )
        return ravel_pytree(new)[0], constraint.combine(multiplier, gap, taken.directions.gram) @ taken.directions.x

    expected = unravel(jnp.zeros_like(flat))
    expected["log_std"] = expected["log_std"] + 0.3 / 2.1
    for gap in (-1.0, 1.0):  # both branches of CVAG's gate
        new, direction = run(jnp.asarray(gap), jnp.asarray(0.3))
        np.testing.assert_allclose(direction, ravel_pytree(expected)[0], rtol=1e-4, atol=1e-6)
        gained = np.asarray(unravel(new)["log_std"] - problem.params["log_std"])
        # Half the squared length under the damped Fisher matrix, 2.1 (x^2 + x^2) / 2, is the radius.
        np.testing.assert_allclose(gained, np.full(2, math.sqrt(0.02 / 2.1)), rtol=1e-3)
        assert np.all(run(jnp.asarray(gap), jnp.asarray(0.0))[0] == flat)  # no coefficient, no bonus
