"""Array containers shared by the learner's modules. Axes: T steps, N environments, M samples."""

from typing import Any

import jax
from flax import struct

from ccil_jax.config import Config, field_names

PyTree = Any
Metrics = dict[str, jax.Array]

jax.tree_util.register_dataclass(Config, field_names(traced=True), field_names(traced=False))


@struct.dataclass(kw_only=True)
class Transition:
    """Steps as they were taken, [T, N] leading. `next_obs` is the true successor, never a reset observation."""

    obs: jax.Array  # [T, N, obs_dim]
    next_obs: jax.Array  # [T, N, obs_dim]
    action: jax.Array  # [T, N, action_dim] as drawn from the policy, before the environment clips it
    reward: jax.Array  # [T, N] the task's own reward; imitation never reads it except for reporting
    cost: jax.Array  # [T, N]
    terminated: jax.Array  # [T, N] bool
    done: jax.Array  # [T, N] bool: terminated or truncated
    whole: jax.Array  # [T, N] bool: the episode this step belongs to began with a reset
    episode_return: jax.Array  # [T, N] running sums, this step included
    episode_cost: jax.Array  # [T, N]
    episode_length: jax.Array  # [T, N] int32


@struct.dataclass(kw_only=True)
class Batch:
    """Samples of one generator step, flattened and ready for the policy step, [M] leading."""

    obs: jax.Array  # [M, obs_dim] normalised
    action: jax.Array  # [M, action_dim]
    reward_advantage: jax.Array  # [M]
    cost_advantage: jax.Array  # [M]
    returns: jax.Array  # [M, 2] targets of the reward and the cost critic
    cost: jax.Array  # [M]


@struct.dataclass(kw_only=True)
class ExpertTransitions:
    """Steps of the demonstrations whose successor is known."""

    obs: jax.Array  # [m, obs_dim]
    action: jax.Array  # [m, action_dim]
    next_obs: jax.Array  # [m, obs_dim] arbitrary where terminated
    terminated: jax.Array  # [m] float: 1 where the task ended
    initial_obs: jax.Array  # [E, obs_dim] first observation of each episode


@struct.dataclass(kw_only=True)
class ExpertData:
    """Demonstrations on the device."""

    obs: jax.Array  # [n, obs_dim]
    action: jax.Array  # [n, action_dim]
    held_out_obs: jax.Array  # [h, obs_dim] never trained on: shows a discriminator that memorises
    held_out_action: jax.Array  # [h, action_dim]
    transitions: ExpertTransitions | None = None  # what iq_learn learns from
