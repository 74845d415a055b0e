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
from ccil_jax.acting.networks import Policy
from ccil_jax.acting.rollout import Actor, act, check_step
from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.errors import ConfigError
from ccil_jax.meshes import run_mesh, usable_devices
from ccil_jax.trees import difference
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
class Trajectories:
    """N episodes side by side, T the time limit. Steps after the end of an episode are there too, but not `valid`."""

    obs: jax.Array  # [T, N, obs_dim]
    next_obs: jax.Array  # [T, N, obs_dim] the observation after the step
    action: jax.Array  # [T, N, action_dim] as executed: clipped to the environment's range
    reward: jax.Array  # [T, N]
    cost: jax.Array  # [T, N]
    terminated: jax.Array  # [T, N] bool
    truncated: jax.Array  # [T, N] bool
    valid: jax.Array  # [T, N] bool


_PORTIONS = 10  # into which an evaluation is divided, about, to tell how far it is
Act = Callable[[jax.Array, jax.Array], jax.Array]  # obs [N, obs_dim], key -> action [N, action_dim]
Playing = tuple[State, jax.Array]  # N episodes between two steps, and which of them still go on, [N] bool
Charged = tuple[jax.Array, jax.Array, jax.Array]  # reward, cost and `valid` of `Trajectories`


@full_precision
def run_episodes(env: Environment, policy: Act, num_episodes: int, key: jax.Array) -> Trajectories:
    """Runs `num_episodes` episodes side by side, each from a reset to its end.

    Raises:
        ValueError: the policy returns actions of another shape than the environment takes.
        AssertionError: the environment returns arrays of other shapes than it should.
    """
    start, keys = _begin(env, num_episodes, key)
    return _play_on(env, policy, start, keys)[1]


def _begin(env: Environment, num_episodes: int, key: jax.Array) -> tuple[Playing, jax.Array]:
    """The start of `num_episodes` episodes, and the random key of each step, [max_episode_steps]."""
    reset_key, key = jax.random.split(key)
    start = jax.vmap(env.reset)(jax.random.split(reset_key, num_episodes))
    return (start, jnp.ones(num_episodes, bool)), jax.random.split(key, env.max_episode_steps)


@full_precision
def _play_on(env: Environment, policy: Act, playing: Playing, keys: jax.Array) -> tuple[Playing, Trajectories]:
    """As many further steps of all episodes as there are keys."""

    def step(carry: Playing, key: jax.Array) -> tuple[Playing, Trajectories]:
        state, running = carry
        action = jax.vmap(functools.partial(executed, env))(policy(state.obs, key))
        stepped = jax.vmap(env.step)(state, action)
        check_step(env, stepped, len(running))
        steps = Trajectories(
            obs=state.obs,
            next_obs=stepped.obs,
            action=action,
            reward=stepped.reward,
            cost=stepped.cost,
            terminated=stepped.terminated,
            truncated=stepped.truncated,
            valid=running,
        )
        return (stepped, running & ~stepped.done), steps

    return jax.lax.scan(step, playing, keys)


def _learnt(config: Config, env: Environment, actor: Actor, deterministic: bool, policy: Policy | None) -> Act:
    policy = networks.policy_of(config, env) if policy is None else policy
    if differs := difference(jax.eval_shape(policy.init, jax.random.key(0)), actor.policy_params):
        raise ConfigError(
            f"actor: its parameters are not those of the policy of {config.method} ({differs}); give the `policy` that "
            "it was trained with, to `evaluate` the actors of all seeds, and to `record` that of one seed"
        )

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


def _totals(steps: Charged) -> Evaluation:
    reward, cost, valid = steps
    return Evaluation(
        episode_return=jnp.sum(jnp.where(valid, reward, 0.0), axis=0),
        episode_cost=jnp.sum(jnp.where(valid, cost, 0.0), axis=0),
        episode_length=jnp.sum(valid, axis=0),
    )


def _charged(steps: Trajectories) -> Charged:
    return steps.reward, steps.cost, steps.valid


@jax.transfer_guard("allow")  # arrays travel between host and device before and after the compiled program on purpose
def evaluate(
    config: Config,
    actor: Actor,
    env: Environment,
    *,
    num_episodes: int = 50,
    seed: int = 0,
    deterministic: bool | None = None,
    draws: Sequence[int] | None = None,
    policy: Policy | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Return, cost and length of `num_episodes` new episodes of every policy in `actor`.

    The S policies, one for each seed of a training, are spread over the local devices.

    Args:
        config: of the training.
        actor: the policies, [S]-leading: `Result.actor`.
        env: the task, unbatched.
        num_episodes: for each policy.
        seed: of all random numbers.
        deterministic: act with the mode of the policy's distribution (true), or sample from it as in training (false);
            None does what the training's `evaluated_action` says.
        draws: one number for each policy. Policies with the same number play episodes with the same initial states,
            layouts and noise, which makes comparisons between them paired. None stands for 0 to S - 1: then the means
            of the policies are independent.
        policy: the network that was given to `make_agent`; None for the method's own.
        on_progress: is told now and then how many of how many steps are done.

    Returns:
        NumPy arrays [S, num_episodes].

    Raises:
        ValueError: `num_episodes` is below 1.
    """
    if num_episodes < 1:
        raise ValueError(f"num_episodes {num_episodes}: must be at least 1")
    by_mode = config.acts_by_mode(deterministic)
    keys = _keys(seed, range(_num_rows(actor)) if draws is None else draws)
    actor, keys = _placed((actor, keys))

    def play_on(runs: tuple[Actor, Playing, jax.Array]) -> tuple[Playing, Charged]:
        actor, playing, keys = runs
        playing, steps = _play_on(env, _learnt(config, env, actor, by_mode, policy), playing, keys)
        return playing, _charged(steps)

    playing, step_keys = _spread(lambda key: _begin(env, num_episodes, key), keys)
    advance, parts = _compiled(play_on, len(keys)), list[Charged]()
    total = env.max_episode_steps
    portion = next(n for n in range(-(-total // _PORTIONS), total + 1) if total % n == 0)  # one program fits them all
    for done in range(0, total, portion):
        playing, steps = advance((actor, playing, step_keys[:, done : done + portion]))
        parts.append(jax.device_get(steps))
        if on_progress is not None:
            on_progress(done + portion, total)
    steps = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *parts)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(_totals))(steps))


@jax.transfer_guard("allow")  # arrays travel between host and device before and after the compiled program on purpose
def random_policy(env: Environment, *, num_episodes: int = 50, seed: int = 0) -> Evaluation:
    """As `evaluate`, for the policy whose actions are uniformly random; the arrays are [1, num_episodes]."""
    num_devices = len(usable_devices())
    padded = -(-num_episodes // num_devices) * num_devices  # rounded up, so that each device has as many

    def run(key: jax.Array) -> Evaluation:
        return _totals(_charged(run_episodes(env, _uniform(env), 1, key)))

    return jax.tree.map(lambda rows: np.asarray(rows)[:num_episodes].T, _spread(run, _keys(seed, range(padded))))


def _keys(seed: int, numbers: Sequence[int]) -> jax.Array:
    """A random key for each number. It depends on the number and on `seed` alone, not on how many numbers there are."""
    fold_in = jax.vmap(jax.random.fold_in, in_axes=(None, 0))
    return fold_in(jax.random.key(seed), jnp.asarray(numbers, jnp.uint32))


def _num_rows(tree: PyTree) -> int:
    """The length of the leading axis, which all leaves share."""
    return len(jax.tree.leaves(tree)[0])


def _spread(run: Callable[[Any], Any], runs: PyTree) -> Any:
    """`run` of every row of `runs` ([R]-leading), vmapped; the rows are divided among the local devices."""
    return _compiled(run, _num_rows(runs))(_placed(runs))


def _compiled(run: Callable[[Any], Any], num_runs: int) -> Callable[[PyTree], Any]:
    by_run = PartitionSpec("runs")
    vmapped = jax.vmap(run)
    mesh = run_mesh(num_runs)
    return jax.jit(jax.shard_map(vmapped, mesh=mesh, in_specs=by_run, out_specs=by_run, check_vma=False))


def _placed(runs: PyTree) -> PyTree:
    return jax.device_put(runs, NamedSharding(run_mesh(_num_rows(runs)), PartitionSpec("runs")))


@jax.transfer_guard("allow")  # arrays travel between host and device before and after the compiled program on purpose
def record(
    config: Config,
    actor: Actor,
    env: Environment,
    *,
    num_episodes: int,
    seed: int = 0,
    metadata: dict[str, Any] | None = None,
    policy: Policy | None = None,
) -> Demonstrations:
    """Demonstrations of one policy, which acts as `config.evaluated_action` says.

    Args:
        config: of the training.
        actor: the policy, without an axis of seeds.
        env: the task, unbatched.
        num_episodes: how many episodes to record.
        seed: of all random numbers.
        metadata: of the demonstrations.
        policy: the network that was given to `make_agent`; None for the method's own.

    Returns:
        The episodes one after the other. Actions are recorded as executed: clipped to the environment's range.
    """

    @jax.jit
    def run(actor: Actor, key: jax.Array) -> Trajectories:
        return run_episodes(env, _learnt(config, env, actor, config.acts_by_mode(), policy), num_episodes, key)

    steps = jax.tree.map(np.asarray, run(actor, jax.random.key(seed)))
    keep = steps.valid.T  # [N, T]: one episode after the other
    lengths = keep.sum(axis=1)

    def flat(x: np.ndarray) -> np.ndarray:
        return np.swapaxes(x, 0, 1)[keep]

    return Demonstrations(
        obs=flat(steps.obs).astype(np.float32),
        actions=flat(steps.action).astype(np.float32),
        rewards=flat(steps.reward).astype(np.float32),
        costs=flat(steps.cost).astype(np.float32),
        terminated=flat(steps.terminated),
        truncated=flat(steps.truncated),
        episode_ends=np.cumsum(lengths),
        final_obs=steps.next_obs[lengths - 1, np.arange(num_episodes)].astype(np.float32),
        metadata=metadata or {},
    )
