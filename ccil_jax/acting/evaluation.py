"""Whole episodes of a fixed policy: evaluation, recording of demonstrations, and the random policy."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import NamedSharding, PartitionSpec

from ccil_jax.acting import networks
from ccil_jax.acting.rollout import Actor, act
from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.meshes import run_mesh, usable_devices
from ccil_jax.types import PyTree
from envs.base import Environment, State, executed
from envs.jax_tools import full_precision


@struct.dataclass(kw_only=True)
class Evaluation:
    """Undiscounted totals of whole episodes; NumPy arrays [num_seeds, num_episodes]."""

    episode_return: Any
    episode_cost: Any
    episode_length: Any  # steps


@struct.dataclass(kw_only=True)
class Episodes:
    """Steps [T, N] of N episodes side by side; `valid` is false after an episode's end."""

    obs: jax.Array
    action: jax.Array  # as executed: clipped to the environment's range
    reward: jax.Array
    cost: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    valid: jax.Array


Act = Callable[[jax.Array, jax.Array], jax.Array]  # obs [N, obs_dim], key -> action [N, action_dim]


@full_precision
def run_episodes(env: Environment, policy: Act, num_episodes: int, key: jax.Array) -> Episodes:
    """Runs `num_episodes` episodes side by side from fresh resets to their ends."""
    reset_key, key = jax.random.split(key)
    start = jax.vmap(env.reset)(jax.random.split(reset_key, num_episodes))

    def step(carry: tuple[State, jax.Array], key: jax.Array) -> tuple[tuple[State, jax.Array], Episodes]:
        state, running = carry
        action = jax.vmap(functools.partial(executed, env))(policy(state.obs, key))
        stepped = jax.vmap(env.step)(state, action)
        episodes = Episodes(
            obs=state.obs,
            action=action,
            reward=stepped.reward,
            cost=stepped.cost,
            terminated=stepped.terminated,
            truncated=stepped.truncated,
            valid=running,
        )
        return (stepped, running & ~stepped.done), episodes

    running = jnp.ones(num_episodes, bool)
    keys = jax.random.split(key, env.max_episode_steps)
    return jax.lax.scan(step, (start, running), keys)[1]


def _learnt(config: Config, env: Environment, actor: Actor, deterministic: bool) -> Act:
    policy = networks.policy_of(config, env)

    def policy_act(obs: jax.Array, key: jax.Array) -> jax.Array:
        shape = (*obs.shape[:-1], env.action_dim)
        noise = jnp.zeros(shape) if deterministic else jax.random.normal(key, shape)
        return act(policy.apply, actor, obs, noise)

    return policy_act


def _uniform(env: Environment) -> Act:
    low, high = jnp.asarray(env.action_low), jnp.asarray(env.action_high)

    def policy_act(obs: jax.Array, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (*obs.shape[:-1], env.action_dim), minval=low, maxval=high)

    return policy_act


def _totals(episodes: Episodes) -> Evaluation:
    return Evaluation(
        episode_return=jnp.sum(jnp.where(episodes.valid, episodes.reward, 0.0), axis=0),
        episode_cost=jnp.sum(jnp.where(episodes.valid, episodes.cost, 0.0), axis=0),
        episode_length=jnp.sum(episodes.valid, axis=0),
    )


@jax.transfer_guard("allow")  # what is set up and what comes back travels on purpose
def evaluate(
    config: Config,
    actor: Actor,
    env: Environment,
    *,
    num_episodes: int = 50,
    seed: int = 0,
    deterministic: bool = False,
    draws: Sequence[int] | None = None,
) -> Evaluation:
    """Return, cost and length of `num_episodes` fresh episodes for every seed of `actor` ([S]-leading).

    The policy acts stochastically, as it was trained, unless `deterministic`. The seeds are spread over the local
    devices.

    Args:
        config: of the policies.
        actor: the policies, [S]-leading.
        env: the task, unbatched.
        num_episodes: for each seed.
        seed: of all random numbers.
        deterministic: whether the policies act with their modes.
        draws: a number for each seed. Seeds with the same number play the same starts, layouts and noise, which makes
            comparisons between their policies paired. None: 0 to S - 1, so that the seeds' means are independent.
    """
    if num_episodes < 1:
        raise ValueError(f"num_episodes {num_episodes}: must be at least 1")
    keys = _keys(seed, range(len(jax.tree.leaves(actor)[0])) if draws is None else draws)

    def run(runs: tuple[Actor, jax.Array]) -> Evaluation:
        actor, key = runs
        return _totals(run_episodes(env, _learnt(config, env, actor, deterministic), num_episodes, key))

    return jax.tree.map(np.asarray, _spread(run, (actor, keys)))


@jax.transfer_guard("allow")  # what is set up and what comes back travels on purpose
def random_policy(env: Environment, *, num_episodes: int = 50, seed: int = 0) -> Evaluation:
    """The same for uniformly random actions; arrays are [1, num_episodes]."""
    num_devices = len(usable_devices())
    padded = -(-num_episodes // num_devices) * num_devices  # so that the devices share them evenly

    def run(key: jax.Array) -> Evaluation:
        return _totals(run_episodes(env, _uniform(env), 1, key))

    return jax.tree.map(lambda rows: np.asarray(rows)[:num_episodes].T, _spread(run, _keys(seed, range(padded))))


def _keys(seed: int, numbers: Sequence[int]) -> jax.Array:
    """A random key for each number; it follows from the number and `seed` alone."""
    fold_in = jax.vmap(jax.random.fold_in, in_axes=(None, 0))
    return fold_in(jax.random.key(seed), jnp.asarray(numbers, jnp.uint32))


def _spread(run: Callable[[Any], Any], runs: PyTree) -> Any:
    """`run` of every row of `runs` ([R]-leading), the rows shared by the local devices."""
    mesh = run_mesh(len(jax.tree.leaves(runs)[0]))
    by_run = PartitionSpec("runs")
    shared = jax.shard_map(jax.vmap(run), mesh=mesh, in_specs=by_run, out_specs=by_run, check_vma=False)
    return jax.jit(shared)(jax.device_put(runs, NamedSharding(mesh, by_run)))


@jax.transfer_guard("allow")  # what is set up and what comes back travels on purpose
def record(
    config: Config,
    actor: Actor,
    env: Environment,
    *,
    num_episodes: int,
    seed: int = 0,
    metadata: dict[str, Any] | None = None,
) -> Demonstrations:
    """Demonstrations of one policy (no seed axis), acting stochastically. Actions are recorded as executed."""

    @jax.jit
    def run(actor: Actor, key: jax.Array) -> Episodes:
        return run_episodes(env, _learnt(config, env, actor, False), num_episodes, key)

    episodes = jax.tree.map(np.asarray, run(actor, jax.random.key(seed)))
    keep = episodes.valid.T  # [N, T]: episode after episode

    def flat(x: np.ndarray) -> np.ndarray:
        return np.swapaxes(x, 0, 1)[keep]

    return Demonstrations(
        obs=flat(episodes.obs).astype(np.float32),
        actions=flat(episodes.action).astype(np.float32),
        rewards=flat(episodes.reward).astype(np.float32),
        costs=flat(episodes.cost).astype(np.float32),
        terminated=flat(episodes.terminated),
        truncated=flat(episodes.truncated),
        episode_ends=np.cumsum(keep.sum(axis=1)),
        metadata=metadata or {},
    )
