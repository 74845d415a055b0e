"""The contract between environments and learners.

An environment is a set of pure functions of one simulation; callers `vmap` them.
`step` does not start the next episode when one ends: it always returns the true successor of the state that it was
given. Starting anew is the task of the code that collects episodes (`ccil_jax.acting.rollout`).
"""

import dataclasses
from collections.abc import Iterable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

PyTree = Any


@struct.dataclass(kw_only=True)
class State:
    """One simulation between two control steps. All fields are scalars or per-simulation arrays."""

    physics: PyTree  # whatever the environment needs to continue exactly
    obs: jax.Array  # [obs_dim]
    reward: jax.Array  # [] of the last step; 0 after reset
    cost: jax.Array  # [] of the last step, >= 0; 0 after reset
    terminated: jax.Array  # [] bool: the task ended (no bootstrap)
    truncated: jax.Array  # [] bool: the time limit was reached (bootstrap from `obs`)
    step_count: jax.Array  # [] int32: counts towards the time limit
    episode_return: jax.Array  # [] undiscounted sum of reward since reset
    episode_cost: jax.Array  # [] undiscounted sum of cost since reset
    terms: dict[str, jax.Array]  # [] each: the named summands of reward, same keys at reset and step

    @property
    def done(self) -> jax.Array:
        """[] bool: the episode is over, for either reason."""
        return self.terminated | self.truncated


def first_state(physics: PyTree, obs: jax.Array, terms: Iterable[str]) -> State:
    """The state after a reset; `terms` are the names of `State.terms`."""
    zero, no = jnp.zeros((), obs.dtype), jnp.zeros((), bool)
    return State(
        physics=physics,
        obs=obs,
        reward=zero,
        cost=zero,
        terminated=no,
        truncated=no,
        step_count=jnp.zeros((), jnp.int32),
        episode_return=zero,
        episode_cost=zero,
        terms=dict.fromkeys(terms, zero),
    )


def next_state(
    state: State,
    *,
    physics: PyTree,
    obs: jax.Array,
    reward: jax.Array,
    cost: jax.Array,
    terminated: jax.Array,
    terms: dict[str, jax.Array],
    max_episode_steps: int,
    finite: jax.typing.ArrayLike = True,
) -> State:
    """The state a control step after `state`, with its totals.

    Where `finite` [] bool is false, the episode terminates, reward and cost of the step are 0, and every number that is
    NaN or infinite is shown as 0. The reason: one NaN would spoil a learner's whole batch.
    """
    finite = jnp.asarray(finite)

    def shown(x: jax.Array) -> jax.Array:
        return jnp.where(finite | jnp.isfinite(x), x, 0.0)

    reward, cost = jnp.where(finite, reward, 0.0), jnp.where(finite, cost, 0.0)
    step_count = state.step_count + 1
    return State(
        physics=physics,
        obs=shown(obs),
        reward=reward,
        cost=cost,
        terminated=terminated | ~finite,
        truncated=step_count >= max_episode_steps,
        step_count=step_count,
        episode_return=state.episode_return + reward,
        episode_cost=state.episode_cost + cost,
        terms={name: shown(term) for name, term in terms.items()},
    )


class Environment(Protocol):
    """What a learner may assume of a task.

    `step` clips actions to `[action_low, action_high]`, and refuses an action of another shape by a `ValueError`.
    """

    @property
    def name(self) -> str:
        """The task's name."""

    @property
    def obs_dim(self) -> int:
        """Length of `State.obs`."""

    @property
    def action_dim(self) -> int:
        """Length of an action."""

    @property
    def action_low(self) -> jax.typing.ArrayLike:
        """[action_dim] lower bounds."""

    @property
    def action_high(self) -> jax.typing.ArrayLike:
        """[action_dim] upper bounds."""

    @property
    def max_episode_steps(self) -> int:
        """Control steps until truncation."""

    def reset(self, key: jax.Array) -> State:
        """Starts an episode from the task's own random distribution. `key` is consumed."""

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one control step. `action` is `[action_dim]`; stepping a done state is undefined."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mirror:
    """A mirror symmetry of a task: a step seen in a mirror is a step of the same task.

    Entry i of a mirrored array is `sign[i]` times entry `index[i]` of the array itself. Doing it twice changes nothing,
    so `index` names every place once, and two places that change with each other have the same sign.

    Raises:
        ValueError: the places or the signs are not such.
    """

    obs_index: np.ndarray  # [obs_dim] int
    obs_sign: np.ndarray  # [obs_dim] 1 or -1
    action_index: np.ndarray  # [action_dim] int
    action_sign: np.ndarray  # [action_dim] 1 or -1

    def __post_init__(self) -> None:
        for name in ("obs", "action"):
            index, sign = np.asarray(getattr(self, f"{name}_index")), np.asarray(getattr(self, f"{name}_sign"))
            if not (index.ndim == 1 and np.array_equal(np.sort(index), np.arange(len(index)))):
                raise ValueError(f"mirror: {name}_index must name every place from 0 to its length less 1 once")
            check_shape(f"mirror: {name}_sign", sign, index.shape)
            if not np.all(np.abs(sign) == 1):
                raise ValueError(f"mirror: {name}_sign must consist of 1 and -1")
            if np.any(index[index] != np.arange(len(index))) or np.any(sign[index] != sign):
                raise ValueError(
                    f"mirror: the image of the image of {name} is not {name} itself; give places that change with each "
                    "other each other's index, and the same sign"
                )

    def obs(self, obs: Any) -> Any:
        """Mirrored observations, [..., obs_dim], NumPy's or JAX's as they are given."""
        return obs[..., self.obs_index] * self.obs_sign.astype(obs.dtype)

    def action(self, action: Any) -> Any:
        """Mirrored actions, [..., action_dim]."""
        return action[..., self.action_index] * self.action_sign.astype(action.dtype)


def mirror_of(env: Environment) -> Mirror | None:
    """The mirror symmetry that a task declares as its attribute `mirror`; None where it declares none.

    Raises:
        ValueError: it is no `Mirror`, or one of other lengths than the task's observations and actions.
    """
    mirror = getattr(env, "mirror", None)
    if mirror is None:
        return None
    if not isinstance(mirror, Mirror):
        raise ValueError(f"{env.name}: mirror is of type {type(mirror).__name__}; give an envs.base.Mirror or None")
    check_shape(f"{env.name}: mirror.obs_index", mirror.obs_index, (env.obs_dim,))
    check_shape(f"{env.name}: mirror.action_index", mirror.action_index, (env.action_dim,))
    return mirror


def check_shape(what: str, array: jax.typing.ArrayLike, expected: tuple[int, ...]) -> None:
    """Refuses an array of another shape.

    Without the check, broadcasting would silently repeat the array along the axes that it lacks. Shapes are known
    while JAX traces, so the check costs nothing in a compiled program.

    Args:
        what: the task and the argument, for the message.
        array: the argument.
        expected: its only right shape.

    Raises:
        ValueError: the shape is another.
    """
    found = np.shape(array)
    if found != expected:
        raise ValueError(f"{what} must have shape {expected}, but has shape {found}")


def executed(env: "Environment", action: jax.typing.ArrayLike) -> jax.Array:
    """[action_dim]: what the actuators get for an action, namely the action clipped to the task's range.

    Raises:
        ValueError: the action is not one number for each actuator.
    """
    check_shape(f"{env.name}: an action", action, (env.action_dim,))
    dtype = jnp.result_type(float)
    low, high = jnp.asarray(env.action_low, dtype), jnp.asarray(env.action_high, dtype)
    return jnp.clip(jnp.asarray(action, dtype), low, high)
