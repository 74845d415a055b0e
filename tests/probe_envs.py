"""Toy environments with known answers, and the tiny problems that several test modules share.

They implement the contract of `envs.base` in plain JAX, so a whole training program compiles in seconds.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from ccil_jax.acting import networks
from ccil_jax.agents import on_policy
from ccil_jax.agents.base import Agent
from ccil_jax.agents.on_policy import Parts
from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.types import Batch, PyTree, Transition
from envs.base import State, first_state, next_state
from envs.jax_tools import as_numbers, full_precision


@dataclasses.dataclass(frozen=True, kw_only=True)
class Probe:
    """Bookkeeping of an environment; a probe adds `start`, `observe` and `advance`."""

    name: str = "Probe"
    obs_dim: int = 1
    action_dim: int = 1
    max_episode_steps: int = 1
    action_bound: float = 1.0

    @property
    def action_low(self) -> np.ndarray:
        return np.full(self.action_dim, -self.action_bound, np.float32)

    @property
    def action_high(self) -> np.ndarray:
        return np.full(self.action_dim, self.action_bound, np.float32)

    def start(self, key: jax.Array) -> jax.Array:
        """The physics state of a new episode."""
        raise NotImplementedError

    def observe(self, physics: jax.Array) -> jax.Array:
        """[obs_dim]."""
        raise NotImplementedError

    def advance(self, physics: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """(physics, reward, cost, terminated) of one step."""
        raise NotImplementedError

    def reset(self, key: jax.Array) -> State:
        physics = self.start(key)
        return first_state(physics, self.observe(physics), ())

    def step(self, state: State, action: jax.Array) -> State:
        action = jnp.clip(action, -self.action_bound, self.action_bound)
        physics, reward, cost, terminated = self.advance(state.physics, action)
        return next_state(
            state,
            physics=physics,
            obs=self.observe(physics),
            reward=reward,
            cost=cost,
            terminated=terminated,
            terms={},
            max_episode_steps=self.max_episode_steps,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Walk(Probe):
    """A point on a line, stopped by a wall on one side (termination) or by the clock (truncation).

    Reward x, cost max(x, 0): to the right both grow.
    """

    name: str = "Walk"
    obs_dim: int = 2
    max_episode_steps: int = 7

    def start(self, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)

    def observe(self, physics: jax.Array) -> jax.Array:
        return physics

    def advance(self, physics: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        x = physics[0] + 0.4 * action[0] + 0.2 * physics[1]
        return jnp.stack([x, -physics[1]]), x, jnp.maximum(x, 0.0), x < -1.2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Counter(Probe):
    """Shows the number of steps since reset; reward 1 and cost 2 every step; ends at its time limit alone."""

    name: str = "Counter"
    max_episode_steps: int = 5

    def start(self, key: jax.Array) -> jax.Array:
        return jnp.zeros(())

    def observe(self, physics: jax.Array) -> jax.Array:
        return physics[None]

    def advance(self, physics: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        return physics + 1.0, jnp.ones(()), 2.0 * jnp.ones(()), jnp.zeros((), bool)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sign(Probe):
    """Shows a random sign z for the whole episode: reward z, cost 0.5; one step, ended by termination or by the clock.

    Terminated, its values are z and 0.5. Truncated, the critic bootstraps from itself: z / (1 - gamma) and
    0.5 / (1 - gamma).
    """

    name: str = "Sign"
    terminates: bool = True

    def start(self, key: jax.Array) -> jax.Array:
        return jnp.where(jax.random.bernoulli(key), 1.0, -1.0)

    def observe(self, physics: jax.Array) -> jax.Array:
        return physics[None]

    def advance(self, physics: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        return physics, physics, jnp.full((), 0.5), jnp.asarray(self.terminates)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Conflict(Probe):
    """One step in which reward pulls the action to 2 and cost pulls it to 0: r = -(a - 2)^2 / 2, d = a^2 / 2."""

    name: str = "Conflict"
    action_bound: float = 100.0

    def start(self, key: jax.Array) -> jax.Array:
        return jnp.zeros(())

    def observe(self, physics: jax.Array) -> jax.Array:
        return physics[None]

    def advance(self, physics: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        a = action[0]
        return physics, -((a - 2.0) ** 2) / 2, a**2 / 2, jnp.ones((), bool)


def walk_demonstrations() -> Demonstrations:
    """40 made-up steps of `Walk` in episodes of unequal lengths and costs; J_E = (6 + 3 + 0.5 + 4) / 6."""
    rng = np.random.default_rng(0)
    ends = np.array([7, 13, 20, 27, 33, 40])  # none longer than an episode of `Walk`
    last = np.isin(np.arange(40), ends - 1)
    costs = np.zeros(40, np.float32)
    costs[[2, 5, 12, 30, 39]] = [4.0, 2.0, 3.0, 0.5, 4.0]
    return Demonstrations(
        obs=rng.normal(size=(40, 2)).astype(np.float32),
        actions=rng.uniform(-1, 1, (40, 1)).astype(np.float32),
        rewards=None,
        costs=costs,
        terminated=np.zeros(40, bool),
        truncated=last,
        episode_ends=ends,
    )


@contextlib.contextmanager
def quick_compilation() -> Iterator[None]:
    """Lets XLA emit plain code: a training program compiles in a third of the time. For what does not depend on it."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)


WALK_DEMONSTRATIONS_COST = 2.25  # J_E of the above


def walk_config(**changes: Any) -> Config:
    """A training program on `Walk` that is as small as it can be: 20 iterations, 10 a chunk."""
    base = {
        "env_steps": 20 * 2 * 32,
        "num_envs": 4,
        "batch_size": 32,
        "generator_steps": 2,
        "hidden_sizes": (4,),
        "discriminator_minibatch_size": 16,
        "critic_minibatch_size": 8,
        "critic_epochs": 2,
        "fisher_stride": 2,
        "max_kl": 0.02,
        "critic_learning_rate": 0.01,
        "discriminator_learning_rate": 0.01,
    }
    return Config.from_base(base, changes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyProblem:
    """A random Gaussian policy with a random batch: what one policy step sees."""

    config: Config
    policy: networks.Policy
    params: PyTree
    training: Batch  # [M]
    held_out: Batch  # [V]


def policy_problem(seed: int, dtype: Any = np.float32, **changes: Any) -> PolicyProblem:
    """Draws one with NumPy. Advantages depend on the actions, so that there is something to learn, and are noisy."""
    config = Config(method="malm", hidden_sizes=(4,), cg_iterations=4, fisher_stride=2, max_kl=0.02).replace(**changes)
    rng = np.random.default_rng(seed)
    obs_dim, action_dim, size, num_held_out = 3, 2, 80, 30
    policy = networks.make_policy(config, obs_dim, action_dim)
    shapes = jax.eval_shape(policy.init, jax.random.key(0))
    params = jax.tree.map(lambda x: jnp.asarray(rng.normal(0, 0.5, x.shape), dtype), shapes)
    obs = rng.normal(size=(size, obs_dim))
    mean, log_std = numpy_policy(params, obs)
    action = mean + np.exp(log_std) * rng.normal(size=mean.shape)
    reward_advantage = np.sin(action[:, 0] + obs[:, 0]) + 0.3 * rng.normal(size=size)
    reward_advantage = (reward_advantage - reward_advantage.mean()) / reward_advantage.std()
    cost_advantage = np.tanh(action[:, 1] - obs[:, 1]) + 0.5 * action[:, 0] + 0.3 * rng.normal(size=size)
    cost = rng.uniform(size=size) * (rng.uniform(size=size) < 0.7)
    columns = (obs, action, reward_advantage, cost_advantage, rng.normal(size=(size, 2)), cost)
    names = ("obs", "action", "reward_advantage", "cost_advantage", "returns", "cost")
    batch = {name: jnp.asarray(column, dtype) for name, column in zip(names, columns, strict=True)}
    return PolicyProblem(
        config=config,
        policy=policy,
        params=params,
        training=Batch(**{name: column[num_held_out:] for name, column in batch.items()}),
        held_out=Batch(**{name: column[:num_held_out] for name, column in batch.items()}),
    )


def numpy_policy(params: PyTree, obs: Any) -> tuple[np.ndarray, np.ndarray]:
    """(mean, log-std) of the tanh policy in NumPy, float64."""
    layers = params["mean"]["params"]
    x = np.asarray(obs, np.float64)
    for i in range(len(layers)):
        layer = layers[f"Dense_{i}"]
        x = (np.tanh(x) if i else x) @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)
    return x, np.asarray(params["log_std"], np.float64)


def numpy_log_prob(params: PyTree, batch: Batch) -> np.ndarray:
    """Log densities of the batch's actions under the tanh policy, [M], by SciPy."""
    mean, log_std = numpy_policy(params, batch.obs)
    return np.sum(scipy.stats.norm.logpdf(np.asarray(batch.action, np.float64), mean, np.exp(log_std)), axis=-1)


def gae_by_loop(
    signal: np.ndarray,
    value: np.ndarray,
    next_value: np.ndarray,
    terminated: np.ndarray,
    done: np.ndarray,
    gamma: float,
    gae_lambda: float,
) -> np.ndarray:
    """The definition: for every step, the decayed sum of residuals up to the end of its episode or of the batch."""
    num_steps, num_envs = signal.shape
    advantage = np.zeros((num_steps, num_envs))
    for n in range(num_envs):
        for t in range(num_steps):
            weight = 1.0
            for k in range(t, num_steps):
                future = 0.0 if terminated[k, n] else gamma * next_value[k, n]
                advantage[t, n] += weight * (signal[k, n] + future - value[k, n])
                if done[k, n]:
                    break
                weight *= gamma * gae_lambda
    return advantage


def same_bits(a: PyTree, b: PyTree) -> bool:
    """Whether two pytrees have the same structure and the same bits in every leaf."""
    try:
        assert_same_bits(a, b)
    except AssertionError:
        return False
    return True


def assert_same_bits(a: PyTree, b: PyTree) -> None:
    """Fails, and names the first leaf that differs, unless two pytrees have the same structure and the same bits.

    Stronger than `chex.assert_trees_all_equal`: 0 and -0 differ, and so do dtypes.
    """
    chex.assert_trees_all_equal_comparator(_same_leaf, lambda x, y: f"{x!r} and {y!r}", a, b)


def _same_leaf(one: Any, other: Any) -> bool:
    x, y = (np.asarray(as_numbers(leaf) if isinstance(leaf, jax.Array) else leaf) for leaf in (one, other))
    return x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes()


def steps_to_judge(obs: Any, action: Any, *, reward: float) -> Transition:
    """[T, N] steps of which a reward model reads observations and actions, and no successor."""
    obs, action = jnp.asarray(obs, jnp.float32), jnp.asarray(action, jnp.float32)
    zeros = jnp.zeros(obs.shape[:2])
    return Transition(
        obs=obs,
        next_obs=jnp.full_like(obs, jnp.nan),
        action=action,
        reward=jnp.full_like(zeros, reward),
        cost=zeros,
        terminated=zeros > 0,
        done=zeros > 0,
        whole=zeros == 0,
        episode_return=zeros,
        episode_cost=zeros,
        episode_length=zeros.astype(jnp.int32),
    )


def agent_of(parts: Parts) -> Agent:
    """The on-policy agent of these parts, each of its two functions compiled, with a training's precision."""
    return Agent(
        init=jax.jit(full_precision(functools.partial(on_policy.init, parts))),
        step=jax.jit(full_precision(functools.partial(on_policy.step, parts))),
    )
