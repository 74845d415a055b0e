"""Acting in vectorised environments during training. Only here are episodes reset once they are finished."""

import dataclasses
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from ccil_jax.acting import distributions, running_statistics
from ccil_jax.acting.distributions import CensoredGaussian, Gaussian, TanhGaussian
from ccil_jax.acting.running_statistics import RunningStatistics
from ccil_jax.types import PyTree, Transition
from envs.base import Environment, State
from envs.jax_tools import compute_where, full_precision, scan


@struct.dataclass(kw_only=True)
class Actor:
    """Everything that is needed to act. It is [S]-leading where it holds the policies of S seeds."""

    policy_params: PyTree
    obs_statistics: RunningStatistics | None  # None where the network gets observations as they are


@struct.dataclass(kw_only=True)
class RolloutState:
    """N environments between two batches."""

    env_state: State  # [N]
    episode_length: jax.Array  # [N] int32: steps since the reset; in a shortened episode, step_count is larger
    whole: jax.Array  # [N] bool: false while a first episode lasts that was shortened, see `init`


PolicyApply = Callable[[PyTree, jax.Array], Gaussian | CensoredGaussian | TanhGaussian]


@full_precision
def act(policy_apply: PolicyApply, actor: Actor, obs: jax.Array, noise: jax.Array) -> jax.Array:
    """The actions that standard normal `noise` stands for; zero noise gives the mode of the distribution.

    Args:
        policy_apply: maps parameters and normalised observations to a distribution.
        actor: parameters and observation statistics.
        obs: [..., obs_dim] as the environment gives them.
        noise: [..., action_dim].

    Returns:
        Actions [..., action_dim]; not clipped unless the distribution is a `CensoredGaussian`.

    Raises:
        AssertionError: the means of the policy's distribution have another shape than the noise.
    """
    distribution = policy_apply(actor.policy_params, running_statistics.normalize(actor.obs_statistics, obs))
    mean = distributions.gaussian_of(distribution).mean
    chex.assert_equal_shape([mean, noise], custom_message="the policy's means must be [..., action_dim]")
    return distributions.sample(distribution, noise)


def init(env: Environment, num_envs: int, key: jax.Array) -> RolloutState:
    """N first episodes, all but the first shortened, each to another length.

    Environment i starts at step i / N of the time limit. Otherwise, the episodes of tasks that end only at their time
    limit would all end in the same batch, and other batches would finish none.
    """
    env_state = jax.vmap(env.reset)(jax.random.split(key, num_envs))
    # Computed by NumPy, because the product may be too large for the 32 bits of JAX's integers.
    offset = jnp.asarray(np.arange(num_envs, dtype=np.int64) * env.max_episode_steps // num_envs, jnp.int32)
    return RolloutState(
        env_state=dataclasses.replace(env_state, step_count=env_state.step_count + offset),
        episode_length=jnp.zeros(num_envs, jnp.int32),
        whole=offset == 0,
    )


def check_step(env: Environment, stepped: State, num_envs: int) -> None:
    """Raises `AssertionError` where a step of N environments returns arrays of other shapes than it should."""
    chex.assert_shape(stepped.obs, (num_envs, env.obs_dim))
    chex.assert_shape([stepped.reward, stepped.cost, stepped.terminated, stepped.truncated], (num_envs,))


def rollout(
    env: Environment,
    policy_apply: PolicyApply,
    actor: Actor,
    state: RolloutState,
    num_steps: int,
    key: jax.Array,
) -> tuple[RolloutState, Transition]:
    """Lets the policy act for `num_steps` steps in each of N environments. Finished episodes are reset.

    Args:
        env: the task, unbatched.
        policy_apply: maps parameters and normalised observations to a distribution.
        actor: parameters and observation statistics, which stay the same during all steps.
        state: where the previous batch ended, [N].
        num_steps: T.
        key: consumed.

    Returns:
        The state to go on from, and the transitions [T, N].

    Raises:
        AssertionError: what the policy or the environment returns has another shape than it should.
    """
    num_envs = state.whole.shape[0]
    noise_key, reset_key = jax.random.split(key)
    noise = jax.random.normal(noise_key, (num_steps, num_envs, env.action_dim))
    reset_keys = jax.random.split(reset_key, (num_steps, num_envs))

    def reset_if_done(state: State, key: jax.Array) -> State:
        return compute_where(state.done, env.reset, state, key)

    def step(state: RolloutState, inputs: tuple[jax.Array, jax.Array]) -> tuple[RolloutState, Transition]:
        noise, reset_keys = inputs
        action = act(policy_apply, actor, state.env_state.obs, noise)
        stepped = jax.vmap(env.step)(state.env_state, action)
        check_step(env, stepped, num_envs)
        transition = _transition(state, action, stepped)
        following = RolloutState(
            env_state=jax.vmap(reset_if_done)(stepped, reset_keys),
            episode_length=jnp.where(stepped.done, 0, transition.episode_length),
            whole=state.whole | stepped.done,
        )
        return following, transition

    return scan(step, state, (noise, reset_keys))


def _transition(state: RolloutState, action: jax.Array, stepped: State) -> Transition:
    """The step from `state` to `stepped`, which is not reset yet."""
    return Transition(
        obs=state.env_state.obs,
        next_obs=stepped.obs,
        action=action,
        reward=stepped.reward,
        cost=stepped.cost,
        terminated=stepped.terminated,
        done=stepped.done,
        whole=state.whole,
        episode_return=stepped.episode_return,
        episode_cost=stepped.episode_cost,
        episode_length=state.episode_length + 1,
    )
