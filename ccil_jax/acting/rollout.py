"""Acting in vectorised environments. The only place that resets finished episodes."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from ccil_jax.acting import distributions, running_statistics
from ccil_jax.acting.distributions import Gaussian, TanhGaussian
from ccil_jax.acting.running_statistics import RunningStatistics
from ccil_jax.types import PyTree, Transition
from envs.base import Environment, State
from envs.jax_tools import compute_where, full_precision, scan


@struct.dataclass(kw_only=True)
class Actor:
    """Everything needed to act: [S]-leading when seeds are vmapped."""

    policy_params: PyTree
    obs_statistics: RunningStatistics | None  # None: the network sees observations as they are


@struct.dataclass(kw_only=True)
class RolloutState:
    """N environments between two batches."""

    env_state: State  # [N]
    episode_length: jax.Array  # [N] int32: steps since the reset (differs from step_count while staggered)
    whole: jax.Array  # [N] bool: false for a first episode that was shortened to desynchronise the environments


PolicyApply = Callable[[PyTree, jax.Array], Gaussian] | Callable[[PyTree, jax.Array], TanhGaussian]


@full_precision
def act(policy_apply: PolicyApply, actor: Actor, obs: jax.Array, noise: jax.Array) -> jax.Array:
    """Actions [..., action_dim] for standard normal `noise`; zero noise gives the mode."""
    distribution = policy_apply(actor.policy_params, running_statistics.normalize(actor.obs_statistics, obs))
    return distributions.sample(distribution, noise)


def init(env: Environment, num_envs: int, key: jax.Array) -> RolloutState:
    """Fresh episodes whose time limits are staggered evenly, so that episodes do not all end in one batch."""
    env_state = jax.vmap(env.reset)(jax.random.split(key, num_envs))
    # Counted by the host: 32 bits are too few for the product.
    offset = jnp.asarray(np.arange(num_envs, dtype=np.int64) * env.max_episode_steps // num_envs, jnp.int32)
    return RolloutState(
        env_state=dataclasses.replace(env_state, step_count=env_state.step_count + offset),
        episode_length=jnp.zeros(num_envs, jnp.int32),
        whole=offset == 0,
    )


def rollout(
    env: Environment,
    policy_apply: PolicyApply,
    actor: Actor,
    state: RolloutState,
    num_steps: int,
    key: jax.Array,
) -> tuple[RolloutState, Transition]:
    """Runs the policy for `num_steps` steps in each of N environments.

    Args:
        env: the task, unbatched.
        policy_apply: maps parameters and normalised observations to a distribution.
        actor: parameters and statistics, held fixed.
        state: where the previous batch ended, [N].
        num_steps: T.
        key: consumed.

    Returns:
        The state to go on from, and the transitions [T, N].
    """
    num_envs = state.whole.shape[0]
    noise_key, reset_key = jax.random.split(key)
    noise = jax.random.normal(noise_key, (num_steps, num_envs, env.action_dim))
    reset_keys = jax.random.split(reset_key, (num_steps, num_envs))

    def refresh(state: State, key: jax.Array) -> State:
        return compute_where(state.done, env.reset, state, key)

    def step(state: RolloutState, inputs: tuple[jax.Array, jax.Array]) -> tuple[RolloutState, Transition]:
        noise, reset_keys = inputs
        obs = state.env_state.obs
        action = act(policy_apply, actor, obs, noise)
        stepped = jax.vmap(env.step)(state.env_state, action)
        length = state.episode_length + 1
        transition = Transition(
            obs=obs,
            next_obs=stepped.obs,
            action=action,
            reward=stepped.reward,
            cost=stepped.cost,
            terminated=stepped.terminated,
            done=stepped.done,
            whole=state.whole,
            episode_return=stepped.episode_return,
            episode_cost=stepped.episode_cost,
            episode_length=length,
        )
        return (
            RolloutState(
                env_state=jax.vmap(refresh)(stepped, reset_keys),
                episode_length=jnp.where(stepped.done, 0, length),
                whole=state.whole | stepped.done,
            ),
            transition,
        )

    return scan(step, state, (noise, reset_keys))
