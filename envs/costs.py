"""Costs that a user gives: what they may be, and a task under another cost."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from envs.base import Environment, State, check_shape, executed, next_state

Cost = Callable[[State, jax.Array, State], jax.typing.ArrayLike]


def checked_cost(name: str, cost: jax.typing.ArrayLike) -> tuple[jax.Array, jax.Array]:
    """What a user's cost function returned, and whether it is a finite number.

    A negative cost is a mistake in the function, which nobody should train on. Outside of compiled programs it is
    refused. A compiled program cannot raise errors, so there the cost becomes NaN, which nothing that reads it can
    overlook: evaluations are NaN, and training takes its updates back and stops (`Config.max_skipped_updates`).

    Args:
        name: of the task, for messages.
        cost: [].

    Returns:
        The cost [], of the program's floating-point type, and a flag [] bool, which is true of a negative cost too.

    Raises:
        ValueError: the cost is not a scalar, or it is negative and not being traced.
    """
    check_shape(f"{name}: cost", cost, ())
    cost = jnp.asarray(cost, jnp.result_type(float))
    finite = jnp.isfinite(cost)
    negative = finite & (cost < 0)
    if not isinstance(negative, jax.core.Tracer) and negative:
        raise ValueError(f"{name}: the cost function returned {float(cost):g}; costs are 0 or more")
    return jnp.where(negative, jnp.nan, cost), finite


def with_cost(env: Environment, cost: Cost) -> "WithCost":
    """A task under another cost: the same starts, observations, rewards and ends, and costs of your own.

    For example, a task that costs the sum of squared actions:

        env = envs.with_cost(envs.make("Ant"), lambda before, action, after: jnp.square(action).sum())

    Args:
        env: the task.
        cost: a pure function of the state before a control step, the action [action_dim] as executed (clipped), and
            the state after it; returns a scalar >= 0. `after.cost` is the cost by the task's own rule.
            What the engine knows is in `State.physics`, whose form is the task's.

    Returns:
        An environment. `State.cost` is the new cost and `State.episode_cost` its sum since reset. Attributes that
        `Environment` does not have (`model`, `dt`, `reset_to`, ...) are those of `env`.

        Where the cost is NaN or infinite, the episode terminates, and that step earns and costs nothing. A negative
        cost is refused, or NaN in a compiled program: see `checked_cost`.
    """
    return WithCost(env, cost)


class WithCost:
    """See `with_cost`."""

    def __init__(self, env: Environment, cost: Cost):
        self._env, self._cost = env, cost

    @property
    def name(self) -> str:
        """The task's name, whatever its cost."""
        return self._env.name

    @property
    def obs_dim(self) -> int:
        """Length of `State.obs`."""
        return self._env.obs_dim

    @property
    def action_dim(self) -> int:
        """Length of an action."""
        return self._env.action_dim

    @property
    def action_low(self) -> jax.typing.ArrayLike:
        """[action_dim] lower bounds."""
        return self._env.action_low

    @property
    def action_high(self) -> jax.typing.ArrayLike:
        """[action_dim] upper bounds."""
        return self._env.action_high

    @property
    def max_episode_steps(self) -> int:
        """Control steps until truncation."""
        return self._env.max_episode_steps

    def reset(self, key: jax.Array) -> State:
        """Starts an episode; `key` is consumed."""
        return self._env.reset(key)

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step. See `Environment.step`."""
        after = self._env.step(state, action)
        cost, finite = checked_cost(self.name, self._cost(state, executed(self, action), after))
        new = next_state(
            state,
            physics=after.physics,
            obs=after.obs,
            reward=after.reward,
            cost=cost,
            terminated=after.terminated,
            terms=after.terms,
            max_episode_steps=self.max_episode_steps,
            finite=finite,
        )
        return dataclasses.replace(new, truncated=after.truncated)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # also while a copy is made, before there is an environment to ask
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self._env, name)
