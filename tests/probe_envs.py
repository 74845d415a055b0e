"""Toy environments with known answers, and the tiny training programs that several test modules share.

They implement the contract of `envs.base` in plain JAX, so a whole training program compiles in seconds.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ccil_jax import Config, Demonstrations, Result, train
from envs.base import State


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
        physics, zero, no = self.start(key), jnp.zeros(()), jnp.zeros((), bool)
        return State(
            physics=physics,
            obs=self.observe(physics),
            reward=zero,
            cost=zero,
            terminated=no,
            truncated=no,
            step_count=jnp.zeros((), jnp.int32),
            episode_return=zero,
            episode_cost=zero,
            terms={},
        )

    def step(self, state: State, action: jax.Array) -> State:
        action = jnp.clip(action, -self.action_bound, self.action_bound)
        physics, reward, cost, terminated = self.advance(state.physics, action)
        count = state.step_count + 1
        return State(
            physics=physics,
            obs=self.observe(physics),
            reward=reward,
            cost=cost,
            terminated=terminated,
            truncated=(count >= self.max_episode_steps) & ~terminated,
            step_count=count,
            episode_return=state.episode_return + reward,
            episode_cost=state.episode_cost + cost,
            terms={},
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
