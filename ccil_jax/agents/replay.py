"""The latest steps of a learner, for off-policy updates."""

import jax
import jax.numpy as jnp
from flax import struct

from ccil_jax.types import Transition


@struct.dataclass(kw_only=True)
class Replay:
    """A ring of C rows; the next row goes to `num_added` modulo C."""

    obs: jax.Array  # [C, obs_dim]
    action: jax.Array  # [C, action_dim]
    next_obs: jax.Array  # [C, obs_dim] the true successor
    terminated: jax.Array  # [C] float: 1 where the task ended
    num_added: jax.Array  # [] int32, since the beginning


def init(capacity: int, obs_dim: int, action_dim: int) -> Replay:
    """An empty ring."""
    return Replay(
        obs=jnp.zeros((capacity, obs_dim)),
        action=jnp.zeros((capacity, action_dim)),
        next_obs=jnp.zeros((capacity, obs_dim)),
        terminated=jnp.zeros(capacity),
        num_added=jnp.zeros((), jnp.int32),
    )


def add(replay: Replay, step: Transition) -> Replay:
    """Adds the steps [1, N] of N simulations. N must divide C: no step of several simulations wraps around."""
    num_envs, capacity = step.terminated.shape[1], replay.terminated.shape[0]
    assert capacity % num_envs == 0, f"{num_envs} does not divide {capacity}"
    start = replay.num_added % capacity

    def write(ring: jax.Array, rows: jax.Array) -> jax.Array:
        return jax.lax.dynamic_update_slice_in_dim(ring, rows[0].astype(ring.dtype), start, axis=0)

    return Replay(
        obs=write(replay.obs, step.obs),
        action=write(replay.action, step.action),
        next_obs=write(replay.next_obs, step.next_obs),
        terminated=write(replay.terminated, step.terminated),
        num_added=replay.num_added + num_envs,
    )


def choose(replay: Replay, num_samples: int, key: jax.Array) -> jax.Array:
    """Rows [num_samples], uniform over those filled, with repetition. The key is consumed."""
    filled = jnp.minimum(replay.num_added, replay.terminated.shape[0])
    return jax.random.randint(key, (num_samples,), 0, filled)
