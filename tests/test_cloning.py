"""Methods that begin with a clone: where it comes from, how long it is held, the demonstrations in the policy step."""

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from ccil_jax.acting import running_statistics
from ccil_jax.agents import behavior_cloning, build, on_policy
from ccil_jax.agents.base import Agent
from ccil_jax.agents.expert import expert_data
from ccil_jax.agents.on_policy import AgentState, Parts
from ccil_jax.config import CLONING_UPDATES_PER_ITERATION, Config, validate
from ccil_jax.errors import ConfigError
from ccil_jax.learning import constraints, policy_step
from ccil_jax.learning.policy_step import ExpertSteps, PolicyStep
from ccil_jax.types import ExpertData, Metrics, PyTree
from envs.jax_tools import full_precision
from tests.probe_envs import (
    PolicyProblem,
    Walk,
    agent_of,
    assert_same_bits,
    numpy_log_prob,
    policy_problem,
    quick_compilation,
    same_bits,
    walk_config,
    walk_demonstrations,
)

pytestmark = pytest.mark.once


def walk_expert() -> ExpertData:
    expert = expert_data(walk_demonstrations())
    assert expert is not None
    return expert


def parts_of(method: str, **changes: Any) -> Parts:
    demonstrations = walk_demonstrations()
    config = build.resolve(walk_config(method=method, **changes), Walk(), demonstrations)
    return on_policy.make_parts(config, Walk(), expert_data(demonstrations))


# The clone -----------------------------------------------------------------------------------------------------------


def learnt_by(agent: Agent, key: jax.Array, length: int) -> Any:
    """The actor of an agent after some iterations."""
    state, step = jax.jit(full_precision(agent.init))(key), jax.jit(full_precision(agent.step))
    for _ in range(length):
        state, _ = step(state)
    return state.actor


@pytest.mark.parametrize("likelihood", ["gaussian", "censored"])
@pytest.mark.parametrize("method", ["malm", "gail"])
def test_the_first_policy_is_what_behaviour_cloning_learns(method: str, likelihood: str) -> None:
    """With the same number of updates, learning rate and key, to the last bit; another number is another policy."""
    fields: dict[str, Any] = {
        "action_likelihood": likelihood,
        "actor_learning_rate": 0.01,
        "cloning_updates": 2 * CLONING_UPDATES_PER_ITERATION + 1,
    }
    key, expert = jax.random.key(4), walk_expert()
    with quick_compilation():
        parts = parts_of(method, **fields)
        state = agent_of(parts).init(key)
        cloning = walk_config(method="bc", **fields)
        assert cloning.num_iterations == 3
        policy_key = jax.random.split(key, 5)[1]
        actors = [learnt_by(behavior_cloning.make(cloning, Walk(), expert), policy_key, n) for n in (3, 2, 0)]
    assert_same_bits(state.actor, actors[0])
    assert not same_bits(state.actor.policy_params, actors[1].policy_params)
    assert not same_bits(state.actor.policy_params, actors[2].policy_params)


def test_a_clone_is_likelier_than_what_it_began_with() -> None:
    expert = walk_expert()
    likelihoods = []
    for updates in ({}, {"cloning_updates": 500}):
        parts = parts_of("ccil", **updates)
        actor = on_policy.first_actor(parts, jax.random.key(0))
        statistics = running_statistics.update(running_statistics.init(Walk().obs_dim), expert.obs)
        obs = running_statistics.normalize(statistics, expert.held_out_obs)
        loss = behavior_cloning.negative_log_likelihood(
            parts.policy.apply, actor.policy_params, obs, expert.held_out_action
        )
        likelihoods.append(-float(loss))
    assert likelihoods[1] > likelihoods[0] + 0.1


# Warming up ----------------------------------------------------------------------------------------------------------


def iterate(parts: Parts, length: int) -> list[tuple[AgentState, Metrics]]:
    """The state before the first iteration, with no metrics, and after each."""
    with quick_compilation():
        agent = agent_of(parts)
        state = agent.init(jax.random.key(2))
        found: list[tuple[AgentState, Metrics]] = [(state, {})]
        for _ in range(length):
            state, metrics = agent.step(state)
            found.append((state, metrics))
    return found


def test_the_policy_is_held_while_critics_and_discriminator_warm_up() -> None:
    """Two iterations of two batches each; then it moves."""
    parts = parts_of("malm", cloning_updates=100, warmup_iterations=2, multiplier_update="sgd", outer_loss="lagrangian")
    states = iterate(parts, 3)
    for (before, _), (after, metrics) in itertools.pairwise(states[:3]):
        assert_same_bits(after.actor.policy_params, before.actor.policy_params)
        for name in ("kl", "surrogate", "step_fraction", "meta_gradient"):
            assert metrics[name] == 0, name
        for name in ("critics", "reward_model"):
            old, new = (ravel_pytree(getattr(state, name).params)[0] for state in (before, after))
            assert np.mean(np.asarray(old) != np.asarray(new)) > 0.9, name
    (before, _), (after, metrics) = states[2:]
    assert not same_bits(after.actor.policy_params, before.actor.policy_params)
    for name in ("kl", "surrogate", "step_fraction", "meta_gradient"):
        assert metrics[name] != 0, name


def test_without_a_warm_up_the_policy_moves_at_once() -> None:
    before, after = (state.actor.policy_params for state, _ in iterate(parts_of("ccil", cloning_updates=100), 1))
    assert not same_bits(after, before)


def test_the_observation_statistics_stay_those_of_the_demonstrations() -> None:
    """And those of a method that begins with no clone follow its own batches."""
    expected = running_statistics.update(running_statistics.init(Walk().obs_dim), walk_expert().obs)
    for state, _ in iterate(parts_of("ccil", cloning_updates=100, warmup_iterations=1), 2):
        assert_same_bits(state.actor.obs_statistics, expected)
    own = [state.actor.obs_statistics for state, _ in iterate(parts_of("ccil"), 1)]
    assert not same_bits(own[0], own[1])


# The demonstrations in the policy step --------------------------------------------------------------------------------


def test_steps_of_the_demonstrations_are_drawn_anew_and_normalised_as_the_policy_sees_them() -> None:
    parts = parts_of("malm", cloning_updates=100, held_out_fraction=0.25)
    assert parts.expert is not None
    state = agent_of(parts).init(jax.random.key(0))
    drawn = [on_policy.expert_steps(parts, state, jax.random.key(seed)) for seed in (0, 1)]
    all_obs = np.asarray(running_statistics.normalize(state.actor.obs_statistics, parts.expert.obs))
    chosen = []
    for steps in drawn:
        assert steps is not None
        assert steps.obs.shape == (24, 2)
        same = np.all(np.isclose(np.asarray(steps.obs)[:, None], all_obs[None], rtol=1e-6), axis=-1)
        chosen.append(np.argmax(same, axis=1))
        assert same.any(axis=1).all()
        np.testing.assert_array_equal(steps.action, np.asarray(parts.expert.action)[chosen[-1]])
    assert not np.array_equal(*chosen)
    assert len(set(chosen[0])) > 10
    assert on_policy.expert_steps(parts_of("malm"), state, jax.random.key(0)) is None


def expert_of(problem: PolicyProblem) -> ExpertSteps:
    """Demonstrations of another policy than that of the problem."""
    rng = np.random.default_rng(5)
    obs = rng.normal(size=(50, 3))
    return ExpertSteps(obs=jnp.asarray(obs), action=jnp.asarray(np.sin(obs[:, :2]) + 0.3 * rng.normal(size=(50, 2))))


def improve(
    problem: PolicyProblem, expert: ExpertSteps | None, multiplier: float, weight: float, gap: float = 0.0, **own: Any
) -> tuple[PyTree, PolicyStep, Metrics]:
    """The policy step with demonstrations of the given weight. Use within float64."""
    config = problem.config.replace(cloning_weight=weight)
    constraint = constraints.make(config)
    batch = dataclasses.replace(problem.training, **own)

    @jax.jit
    def run(multiplier: jax.Array, gap: jax.Array) -> tuple[PyTree, PolicyStep, Metrics]:
        arguments = (config, problem.policy.apply, constraint, problem.params, batch, multiplier, gap, problem.held_out)
        return policy_step.improve(*arguments, expert)

    return run(jnp.asarray(multiplier), jnp.asarray(gap))


def likelihood(params: PyTree, expert: ExpertSteps) -> float:
    """The mean log likelihood of the demonstrations, by SciPy."""
    return float(np.mean(numpy_log_prob(params, expert)))  # type: ignore[arg-type]  # has obs and action, as a batch


@pytest.mark.parametrize("method", ["malm", "gail", "cvag", "cpo_il"])
@pytest.mark.parametrize("gap", [-1.0, 1.0])
def test_where_nothing_else_matters_a_step_makes_the_demonstrations_likelier(method: str, gap: float) -> None:
    with jax.enable_x64(True):
        problem = policy_problem(0, np.float64, method=method)
        expert, zero = expert_of(problem), jnp.zeros(50)
        without = {"reward_advantage": zero, "cost_advantage": zero}
        new, taken, metrics = improve(problem, expert, 0.7, 0.3, gap, **without)
        idle, _, _ = improve(problem, expert, 0.7, 0.0, gap, **without)
        gained = likelihood(new, expert) - likelihood(problem.params, expert)
        assert float(taken.fraction) > 0
        surrogate = float(metrics["surrogate"])
    assert gained > 0.01
    np.testing.assert_allclose(surrogate, 0.3 * gained, rtol=1e-8)
    assert_same_bits(idle, problem.params)


@pytest.mark.parametrize("method", ["malm", "gail", "cvag", "cpo_il"])
def test_demonstrations_of_weight_0_leave_the_step_as_it_is(method: str) -> None:
    with jax.enable_x64(True):
        problem = policy_problem(1, np.float64, method=method)
        expert = expert_of(problem)
        for gap in (-1.0, 1.0):
            found, expected, weighed = (
                np.asarray(ravel_pytree(improve(problem, steps, 0.7, weight, gap)[0])[0])
                for steps, weight in ((expert, 0.0), (None, 0.0), (expert, 0.5))
            )
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
            assert np.abs(weighed - expected).max() > 1e-3


@pytest.mark.parametrize("multiplier", [0.0, 1.5, 40.0])
def test_the_step_is_along_the_sum_of_all_three_directions(multiplier: float) -> None:
    """x_r - lambda x_c + w x_E: the demonstrations' weight is what was asked for, whatever the multiplier."""
    with jax.enable_x64(True):
        problem = policy_problem(2, np.float64)
        expert = expert_of(problem)
        new, taken, metrics = improve(problem, expert, multiplier, 0.3)
        moved = np.asarray(ravel_pytree(new)[0] - ravel_pytree(problem.params)[0])
        x = np.asarray(taken.directions.x)
        cloned = likelihood(new, expert) - likelihood(problem.params, expert)
        ratio = np.exp(numpy_log_prob(new, problem.training) - numpy_log_prob(problem.params, problem.training)) - 1
        reward, cost = (
            np.mean(ratio * np.asarray(signal))
            for signal in (problem.training.reward_advantage, problem.training.cost_advantage)
        )
    assert x.shape == (3, len(moved))
    wanted = x[0] - multiplier * x[1] + 0.3 * x[2]
    np.testing.assert_allclose(moved / np.linalg.norm(moved), wanted / np.linalg.norm(wanted), atol=1e-9)
    np.testing.assert_allclose(metrics["surrogate"], reward - multiplier * cost + 0.3 * cloned, rtol=1e-8)
    np.testing.assert_allclose(metrics["cost_weight"], multiplier)


def test_the_replay_of_a_step_with_demonstrations_is_the_step() -> None:
    """What the outer step differentiates: at the step's own multiplier its weights are those of the step taken."""
    with jax.enable_x64(True):
        problem = policy_problem(3, np.float64)
        new, taken, _ = improve(problem, expert_of(problem), 0.9, 0.4)
        config = problem.config.replace(cloning_weight=0.4)
        outer = policy_step.outer_problem(config, problem.policy.apply, constraints.make(config), taken)
        weights = outer.importance_weights(jnp.asarray(0.9))
        ratio = np.exp(numpy_log_prob(new, problem.held_out) - numpy_log_prob(problem.params, problem.held_out))
    assert np.ptp(ratio) > 0.05
    np.testing.assert_allclose(weights, ratio, rtol=1e-10)


# What is refused -----------------------------------------------------------------------------------------------------

CLONES = "used by methods that can begin with a clone"


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"method": "trpo", "cloning_updates": 100}, f"cloning_updates 100: makes no difference .*{CLONES}"),
        (
            {"method": "expert", "cost_limit": 1.0, "cloning_updates": 100},
            f"cloning_updates 100: makes no difference to this run of method expert; leave it out .{CLONES}",
        ),
        (
            {"method": "iq_learn", "cloning_updates": 100, "warmup_iterations": 3},
            "warmup_iterations 3: makes no difference to this run of method iq_learn",
        ),
        (
            {"method": "iq_learn", "cloning_updates": 100, "cloning_weight": 0.1},
            "cloning_weight 0.1: makes no difference to this run of method iq_learn",
        ),
        ({"method": "malm", "warmup_iterations": 3}, "warmup_iterations 3: makes no .*whose cloning_updates are above"),
        ({"method": "gail", "cloning_weight": 0.1}, "cloning_weight 0.1: makes no .*whose cloning_updates are above 0"),
        ({"method": "ccil", "actor_learning_rate": 0.1}, "actor_learning_rate 0.1: makes no difference"),
        (
            {"method": "bc", "cloning_updates": 100, "warmup_iterations": 3},
            "warmup_iterations 3: makes no difference to this run of method bc",
        ),
        ({"method": "bc", "cloning_updates": 100, "cloning_weight": 0.1}, "cloning_weight 0.1: makes no difference"),
        ({"method": "iq_learn", "action_likelihood": "censored"}, "action_likelihood censored: makes no difference"),
        ({"method": "malm", "cloning_updates": -1}, "cloning_updates -1: must be at least 0"),
        ({"method": "bc"}, "cloning_updates 0: method bc would learn nothing; give a number such as 20000"),
    ],
)
def test_what_a_clone_would_be_needed_for_is_refused_without_one(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        validate(Config(**fields))


def test_without_a_weight_a_demonstrated_step_counts_as_much_as_one_of_the_batch() -> None:
    demonstrations = walk_demonstrations()
    config = walk_config(method="malm", cloning_updates=100, cloning_weight=None)
    found = build.resolve(config, Walk(), demonstrations)
    assert found.cloning_weight == demonstrations.num_steps / config.batch_size
    assert build.resolve(found, Walk(), demonstrations) == found
    one = demonstrations.take_episodes(1)
    assert build.resolve(config, Walk(), one).cloning_weight == one.num_steps / config.batch_size < found.cloning_weight
    assert build.resolve(config.replace(cloning_weight=0.2), Walk(), demonstrations).cloning_weight == 0.2


@pytest.mark.parametrize("method", ["trpo", "expert"])
def test_a_preset_with_a_clone_suits_methods_without_demonstrations(method: str) -> None:
    limit = {"cost_limit": 1.0} if method == "expert" else {}
    config = Config.from_preset("default", method=method, **limit)
    assert (config.cloning_updates, config.warmup_iterations, config.cloning_weight) == (0, 0, 0.0)
    validate(config)


def test_cloning_is_rounded_up_to_whole_iterations() -> None:
    for updates, length in ((0, 0), (1, 1), (100, 1), (101, 2), (20_000, 200)):
        assert Config(method="malm", cloning_updates=updates).num_cloning_iterations == length
        assert Config(method="bc", cloning_updates=updates).num_iterations == length
