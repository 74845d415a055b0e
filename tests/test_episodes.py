"""Rollouts and what is known of their episodes: successors, staggered starts, J_k, and costs of unfinished episodes."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ccil_jax.acting import networks, rollout, running_statistics
from ccil_jax.acting.networks import Network
from ccil_jax.acting.rollout import Actor, RolloutState
from ccil_jax.agents import on_policy
from ccil_jax.agents.on_policy import AgentState, EpisodeEstimates
from ccil_jax.config import Config
from ccil_jax.learning import constraints, policy_step, regression, reward_models
from ccil_jax.learning.regression import Critic
from ccil_jax.types import Batch, PyTree, Transition
from tests.probe_envs import Counter, Probe, Walk, quick_compilation, walk_config

NUM_STEPS = 4  # of one batch
COUNTER_CONFIG = Config(
    method="expert",
    cost_limit=12.5,
    num_envs=2,
    hidden_sizes=(2,),
    gamma=0.9,
    gae_lambda=0.5,
    cost_gae_lambda=0.8,
)


def transition(**columns: Any) -> Transition:
    """Hand-made [T, N] steps; what is not given is zero."""
    shape = np.shape(next(iter(columns.values())))
    zeros: dict[str, Any] = {name: np.zeros(shape) for name in ("reward", "cost", "episode_return", "episode_cost")}
    zeros |= {name: np.zeros(shape, bool) for name in ("terminated", "done")}
    zeros |= {"whole": np.ones(shape, bool), "episode_length": np.ones(shape, np.int32)}
    zeros |= {name: np.zeros((*shape, 1)) for name in ("obs", "next_obs", "action")}
    return Transition(**{name: jnp.asarray(column) for name, column in (zeros | columns).items()})


def estimates(episode_return: float, episode_cost: float, episode_length: float) -> EpisodeEstimates:
    values = map(jnp.asarray, (episode_return, episode_cost, episode_length))
    return EpisodeEstimates(**dict(zip(("episode_return", "episode_cost", "episode_length"), values, strict=True)))


# J_k -----------------------------------------------------------------------------------------------------------------


def test_estimates_are_means_over_the_whole_episodes_that_end_in_the_batch() -> None:
    steps = transition(
        done=[[False, True, False], [True, False, False], [True, True, True]],
        whole=[[True, False, True], [True, True, True], [True, True, True]],
        episode_cost=[[1.0, 100.0, 1.0], [2.0, 5.0, 2.0], [4.0, 6.0, 8.0]],
        episode_return=[[9.0, 900.0, 9.0], [10.0, 9.0, 9.0], [30.0, 20.0, 40.0]],
        episode_length=np.array([[1, 50, 1], [2, 1, 2], [1, 2, 3]], np.int32),
    )
    # Whole and done: costs 2, 4, 6, 8; the 100 belongs to a first episode that was shortened.
    found, count = on_policy.estimate_episodes(estimates(-1.0, -1.0, -1.0), steps)
    assert count == 4
    np.testing.assert_allclose(found.episode_cost, 5.0)
    np.testing.assert_allclose(found.episode_return, 25.0)
    np.testing.assert_allclose(found.episode_length, 2.0)


def test_estimates_are_carried_when_no_episode_ends() -> None:
    nothing = transition(done=np.zeros((3, 2), bool), episode_cost=np.full((3, 2), 7.0))
    found, count = on_policy.estimate_episodes(estimates(3.0, 4.0, 5.0), nothing)
    assert count == 0
    assert jax.tree.leaves(found) == jax.tree.leaves(estimates(3.0, 4.0, 5.0))


def test_estimates_are_carried_when_only_a_shortened_episode_ends() -> None:
    short = transition(done=[[True]], whole=[[False]], episode_cost=[[7.0]])
    assert on_policy.estimate_episodes(estimates(3.0, 4.0, 5.0), short)[0].episode_cost == 4.0


def test_before_the_first_episode_ends_the_cost_is_taken_to_be_at_the_limit() -> None:
    assert fresh_state().estimates.episode_cost == 12.5


@functools.cache
def fresh_state() -> AgentState:
    return jax.jit(on_policy.make(COUNTER_CONFIG, Counter(), None).init)(jax.random.key(0))


@pytest.mark.parametrize(("bound", "std"), [(0.4, 0.4), (1.0, 1.0), (100.0, 1.0), (np.inf, 1.0)])
def test_the_first_actions_fit_the_action_range(bound: float, std: float) -> None:
    agent = on_policy.make(COUNTER_CONFIG, Counter(action_bound=bound), None)
    params = jax.jit(agent.init)(jax.random.key(0)).actor.policy_params
    assert params["log_std"].shape == (1,)
    np.testing.assert_allclose(np.exp(params["log_std"]), std, rtol=1e-6)


# Rollouts ------------------------------------------------------------------------------------------------------------


class Roller:
    """Rolls batches of `NUM_STEPS` in an environment with a random policy, compiled once."""

    def __init__(self, env: Probe, num_envs: int) -> None:
        policy = networks.make_policy(COUNTER_CONFIG, env.obs_dim, env.action_dim)
        shapes = jax.eval_shape(policy.init, jax.random.key(0))
        actor = Actor(
            policy_params=jax.tree.map(lambda x: jnp.zeros(x.shape), shapes),
            obs_statistics=running_statistics.init(env.obs_dim),
        )
        self.state: RolloutState = rollout.init(env, num_envs, jax.random.key(1))
        self._key = jax.random.key(2)
        self.rollout = lambda state, key: rollout.rollout(env, policy.apply, actor, state, NUM_STEPS, key)
        self._roll = jax.jit(self.rollout)

    def roll(self) -> Transition:
        """The next batch [T, N]."""
        self._key, key = jax.random.split(self._key)
        self.state, steps = self._roll(self.state, key)
        return jax.tree.map(np.asarray, steps)


@pytest.fixture
def counter_batches() -> list[Transition]:
    """Three batches of 4 steps in two simulations; episodes of 5 steps, the second's first one staggered to 3."""
    roller = Roller(Counter(), 2)
    return [roller.roll() for _ in range(3)]


def joined(batches: list[Transition]) -> Transition:
    return jax.tree.map(lambda *x: np.concatenate(x), *batches)


def test_simulations_are_staggered_and_the_shortened_episodes_marked(counter_batches: list[Transition]) -> None:
    steps = joined(counter_batches)
    np.testing.assert_array_equal(np.flatnonzero(steps.done[:, 0]), [4, 9])
    np.testing.assert_array_equal(np.flatnonzero(steps.done[:, 1]), [2, 7])  # offset 5 // 2 = 2
    assert steps.whole[:, 0].all()
    np.testing.assert_array_equal(steps.whole[:, 1], np.arange(12) >= 3)
    np.testing.assert_array_equal(steps.episode_length[:, 0], [1, 2, 3, 4, 5, 1, 2, 3, 4, 5, 1, 2])
    np.testing.assert_array_equal(steps.episode_length[:, 1], [1, 2, 3, 1, 2, 3, 4, 5, 1, 2, 3, 4])
    np.testing.assert_array_equal(steps.episode_cost, 2 * steps.episode_length)
    np.testing.assert_array_equal(steps.episode_return, steps.episode_length)
    assert not steps.terminated.any()


def test_partial_first_episodes_are_not_counted(counter_batches: list[Transition]) -> None:
    """Every whole episode costs 10; the staggered one, over after 3 steps, costs 6."""
    found, history = estimates(0.0, 99.0, 0.0), list[tuple[float, int]]()
    for batch in counter_batches:
        found, count = on_policy.estimate_episodes(found, jax.tree.map(jnp.asarray, batch))
        history.append((float(found.episode_cost), int(count)))
    assert history == [(99.0, 0), (10.0, 2), (10.0, 1)]


def test_next_obs_is_the_true_successor_and_the_next_obs_after_an_end_a_reset(
    counter_batches: list[Transition],
) -> None:
    steps = joined(counter_batches)
    np.testing.assert_array_equal(steps.next_obs, steps.obs + 1)  # also at an end: 5, never 0
    following = np.where(steps.done[:-1, :, None], 0, steps.next_obs[:-1])
    np.testing.assert_array_equal(steps.obs[1:], following)


def test_episodes_begin_anew_at_random() -> None:
    roller = Roller(Walk(), 4)
    steps = joined([roller.roll() for _ in range(10)])
    starts = steps.obs[1:][steps.done[:-1]]
    assert len(starts) >= 10
    assert len(np.unique(starts[:, 0])) == len(starts)
    assert (np.abs(starts) <= 1).all()
    assert steps.terminated.any()
    assert (steps.done & ~steps.terminated).any()


def test_environments_are_reset_only_where_an_episode_ends() -> None:
    """Resets may be dear. Seeds are vmapped, and a reset depends on nothing but its key: XLA must not hoist it."""
    calls: list[tuple[int, ...]] = []

    class Counted(Counter):
        def start(self, key: jax.Array) -> jax.Array:
            def host(data: np.ndarray) -> np.ndarray:
                calls.append(np.shape(data))
                return np.zeros(np.shape(data)[:-1], np.float32)

            shape = jax.ShapeDtypeStruct((), jnp.float32)
            return jax.pure_callback(host, shape, jax.random.key_data(key), vmap_method="broadcast_all")

    roller = Roller(Counted(), 2)
    roll = jax.jit(jax.vmap(roller.rollout))
    state = jax.tree.map(lambda x: jnp.stack([x, x, x]), roller.state)
    calls.clear()
    jax.block_until_ready(roll(state, jax.random.split(jax.random.key(0), 3)))
    assert calls == [(3, 2, 2)]  # 4 steps, of which one ends an episode, in all three seeds at once


def test_the_policy_step_sees_observations_normalised_as_when_the_actions_were_drawn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With a deviation of e^-20 an action is the mean, so the policy must find it again in the batch it is given.

    Statistics updated between acting and the policy step would shift the means, and so the old log-probabilities.
    """

    def improve(config: Config, apply: Any, constraint: Any, params: PyTree, batch: Batch, *_: Any) -> Any:
        return params, (), {"shift": jnp.max(jnp.abs(apply(params, batch.obs).mean - batch.action))}

    monkeypatch.setattr(policy_step, "improve", improve)
    agent = on_policy.make(walk_config(method="trpo", generator_steps=3), Walk(), None)
    with quick_compilation():
        state = jax.jit(agent.init)(jax.random.key(0))
        rng = np.random.default_rng(0)
        params = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), state.actor.policy_params)
        params["log_std"] = jnp.full(1, -20.0)
        start = state.replace(actor=state.actor.replace(policy_params=params))
        state, metrics = jax.jit(agent.step)(start)
    assert metrics["shift"] < 1e-5
    assert state.actor.obs_statistics.count == 3 * 32


# Values --------------------------------------------------------------------------------------------------------------


def assess(steps: Transition, **changes: Any) -> Batch:
    """Scores a batch of `Counter` with hand-made critics: 10 per step shown for the reward, 100 for the cost."""
    config = COUNTER_CONFIG.replace(**changes)
    state = fresh_state().replace(critics=Critic(params=jnp.array([10.0, 100.0]), optimizer=()))

    @jax.jit
    def run(state: AgentState, steps: Transition) -> Batch:
        critic = Network(init=lambda key: jnp.zeros(()), apply=lambda params, obs: params * obs[..., 0])
        parts = on_policy.make_parts(
            config,
            Counter(),
            None,
            critic=critic,
            constraint=constraints.unconstrained(config),
            reward_model=reward_models.task(),
        )
        samples, _ = on_policy.assess(parts, state, steps)
        return samples

    return run(state, jax.tree.map(jnp.asarray, steps))


@pytest.mark.parametrize("bootstrap", [True, False])
def test_a_time_limit_bootstraps_from_the_last_state_and_not_from_the_reset(
    counter_batches: list[Transition], bootstrap: bool
) -> None:
    """V(s_T) = 50 for the reward and V(s_0) = 0, which is what a bootstrap from the reset state would add."""
    steps = counter_batches[1]
    batch = assess(steps, bootstrap_at_truncation=bootstrap)
    for index, scale, signal, decay in ((0, 10.0, steps.reward, 0.5), (1, 100.0, steps.cost, 0.8)):
        expected = np.zeros((NUM_STEPS, 2))
        for n in range(2):
            following: Any = 0.0
            for t in reversed(range(NUM_STEPS)):
                shown, done = float(steps.obs[t, n, 0]), bool(steps.done[t, n])
                future = 0.0 if done and not bootstrap else 0.9 * scale * (shown + 1)
                residual = signal[t, n] + future - scale * shown
                following = residual + (0.0 if done else 0.9 * decay * following)
                expected[t, n] = following
        value = scale * steps.obs[..., 0]
        np.testing.assert_allclose(batch.returns[:, index], (expected + value).ravel(), rtol=1e-5)
        if index == 0:  # standardised for the reward,
            normal = (expected - expected.mean()) / expected.std()
            np.testing.assert_allclose(batch.reward_advantage, normal.ravel(), rtol=1e-4, atol=1e-5)
        else:  # and left alone for the cost
            np.testing.assert_allclose(batch.cost_advantage, expected.ravel(), rtol=1e-4)


def test_the_cost_advantage_is_standardised_only_on_request(counter_batches: list[Transition]) -> None:
    plain, standardised = (assess(counter_batches[1], standardize_cost_advantage=on) for on in (False, True))
    values = np.asarray(plain.cost_advantage, np.float64)
    np.testing.assert_allclose(
        standardised.cost_advantage, (values - values.mean()) / values.std(), rtol=1e-4, atol=1e-5
    )


# Costs of the episodes that steps belong to --------------------------------------------------------------------------


def test_every_step_knows_its_episodes_cost_or_its_extrapolation() -> None:
    """[T = 6, N = 3], full length 10. Ended episodes count as they are, the open ones at their rate so far."""
    done = np.zeros((6, 3), bool)
    done[2, 0] = done[5, 1] = done[0, 2] = done[3, 2] = True
    cost = np.array(
        [  # running sums of the episode's cost
            [1.0, 0.0, 9.0],
            [1.0, 0.0, 0.0],
            [3.0, 1.0, 0.0],
            [0.0, 2.0, 4.0],
            [2.0, 2.0, 1.0],
            [3.0, 5.0, 1.0],
        ]
    )
    length = np.array([[1, 1, 7], [2, 2, 1], [3, 3, 2], [1, 4, 3], [2, 5, 1], [3, 6, 2]], np.int32)
    steps = transition(done=done, episode_cost=cost, episode_length=length)
    episodes = on_policy.episodes_of_steps(steps, jnp.asarray(4.5), 10)
    # First: 3 for three steps, then open with 3 in 3 steps: 10. Second: ends with the batch at 5. Third: 9, 4, then
    # 1 in 2 steps: 5.
    expected = np.array([[3, 3, 3, 10, 10, 10], [5] * 6, [9, 4, 4, 4, 5, 5]], float).T
    np.testing.assert_allclose(episodes.cost, expected)
    assert episodes.limit == 4.5


def test_cvags_episode_gate_on_episodes_that_end_mid_batch() -> None:
    """The chain of both: masks from hand-made episodes choose between A_r and -A_c step by step."""
    done = np.array([[False, False], [True, False], [False, False], [False, True]])
    cost = np.array([[2.0, 1.0], [6.0, 1.0], [0.0, 1.0], [1.0, 3.0]])
    length = np.array([[1, 1], [2, 2], [1, 3], [2, 4]], np.int32)
    episodes = on_policy.episodes_of_steps(
        transition(done=done, episode_cost=cost, episode_length=length), jnp.asarray(5.0), 8
    )  # first: 6 (above), then 1 in 2 steps, extrapolated to 4 (within); second: 3 (within)
    reward, costs = np.arange(1.0, 9.0).reshape(4, 2), np.full((4, 2), 10.0)
    mixed = np.array([[-10, 2], [-10, 4], [5, 6], [7, 8]])
    gate = constraints.alternating(Config(method="cvag", gate="episode")).gate
    np.testing.assert_allclose(
        gate(jnp.asarray(reward), jnp.asarray(costs), episodes), (mixed - mixed.mean()) / mixed.std(), rtol=1e-5
    )


def test_both_critics_are_fitted_each_to_its_own_returns() -> None:
    config = COUNTER_CONFIG.replace(critic_epochs=30, critic_minibatch_size=16, critic_learning_rate=0.05)
    critics = jax.vmap(functools.partial(regression.init, learning_rate=0.05))(jnp.zeros((2, 2)))
    obs = jnp.linspace(-1, 1, 64)[:, None]
    flat = {name: jnp.zeros(64) for name in ("reward_advantage", "cost_advantage", "cost")}
    batch = Batch(obs=obs, action=obs, returns=jnp.concatenate([2 * obs, 1 - obs], axis=1), **flat)

    line = Network(init=lambda key: jnp.zeros(2), apply=lambda params, obs: params[0] * obs[..., 0] + params[1])
    parts = on_policy.make_parts(config, Counter(), None, critic=line)
    fit = jax.jit(lambda critics, key: on_policy.fit_critics(parts, critics, batch, key))
    fitted, losses = fit(critics, jax.random.key(1))
    assert losses.shape == (2,)
    np.testing.assert_allclose(fitted.params, [[2, 0], [-1, 1]], atol=0.02)
