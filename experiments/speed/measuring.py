"""One row of the benchmark: how fast physics, rollouts, training and the meta-gradient are on this machine."""

import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch as RawBatch

import envs
from ccil_jax import meshes
from ccil_jax.acting import networks, rollout, running_statistics
from ccil_jax.agents import build
from ccil_jax.agents.expert import expert_of
from ccil_jax.config import Config
from ccil_jax.learning import constraints, policy_step
from ccil_jax.training import program
from ccil_jax.types import Batch
from envs.jax_tools import full_precision
from envs.task_info import physics_name
from experiments.speed.locks import file_lock
from experiments.speed.setting import Setting, make_config, noise

_MOST_SIMS = 1024  # simulations of C MuJoCo that are stepped for comparison, at most

Work = Callable[[], int]  # does a fixed amount of work, waits until it is done, and returns the number of units


def measure_training(setting: Setting) -> dict[str, Any]:
    """Measures whole training only: seconds per iteration (the median), seconds to compile, and peak memory."""
    env: Any = envs.make(setting.task, physics=setting.physics)
    config = make_config(setting)
    training, compile_seconds = training_work(config, env, setting)
    training()
    rates = [rate_of(training, setting.seconds) for _ in range(setting.rounds)]
    rate = float(np.median(rates))
    return {
        "task": setting.task,
        "physics": physics_name(env),
        "training_steps_per_second": rate,
        "seconds_per_iteration": setting.num_seeds * config.steps_per_iteration / rate,
        "compile_seconds": compile_seconds,
        "peak_memory": _peak_memory(),
        "all_rates": rates,
    }


def measure(setting: Setting) -> dict[str, Any]:
    """Measures each kind of work once per round, and returns medians over the rounds.

    Rates are control steps of all seeds per second; a control step is `num_substeps` engine steps.
    `physics_steps_per_second` is the C engine alone, stepping as many simulations as training does (but see
    `physics_work`) under random controls: the ceiling of the native backend.
    """
    with file_lock(setting.turns, exclusive=False):
        env: Any = envs.make(setting.task, physics=setting.physics)
        config = make_config(setting)
        training, compile_seconds = training_work(config, env, setting)
        plain, meta = _policy_steps(config, env, setting)
        works = {
            "physics": physics_work(env, setting),
            "rollout": rollout_work(config, env, setting),
            "training": training,
            "plain": plain,
            "meta": meta,
        }
        for work in works.values():
            work()  # compiles, and warms caches
    rates: dict[str, list[float]] = {name: [] for name in works}
    with file_lock(setting.turns, exclusive=True):
        for _ in range(setting.rounds):
            for name, work in works.items():
                rates[name].append(rate_of(work, setting.seconds))
    median = {name: float(np.median(values)) for name, values in rates.items()}
    return {
        "task": setting.task,
        "physics": physics_name(env),
        "method": setting.method,
        "num_seeds": setting.num_seeds,
        "num_envs": setting.num_envs,
        "num_substeps": env.num_substeps,
        "changes": dict(setting.changes),
        "physics_steps_per_second": median["physics"],
        "rollout_steps_per_second": median["rollout"],
        "training_steps_per_second": median["training"],
        "rollout_to_physics": median["rollout"] / median["physics"],
        "training_to_physics": median["training"] / median["physics"],
        "training_to_rollout": median["training"] / median["rollout"],
        "meta_gradient_to_policy_step": median["plain"] / median["meta"],
        "policy_step_seconds": 1 / median["plain"],
        "meta_gradient_seconds": 1 / median["meta"],
        "compile_seconds": compile_seconds,
        "peak_memory": _peak_memory(),
        "all_rates": rates,
    }


def rate_of(work: Work, seconds: float) -> float:
    """Units per second of `work`, repeated for at least `seconds`."""
    units, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds or units == 0:
        units += work()
    return units / elapsed


def _peak_memory() -> float:
    """Peak memory in MiB: allocated on all accelerators, or without an accelerator the resident size of the process."""
    on_devices = [device.memory_stats() for device in jax.local_devices()]
    if all(on_devices):  # None on a CPU
        return sum(stats["peak_bytes_in_use"] for stats in on_devices if stats) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def physics_work(env: Any, setting: Setting) -> Work:
    """Steps the engine alone, from states after a reset: without JAX, observations, rewards and further resets.

    At most `_MOST_SIMS` simulations are stepped: more would not raise the rate, and each takes memory.
    """
    from envs.physics.native import usable_cpus

    num_sims, num_steps = min(setting.num_seeds * setting.num_envs, _MOST_SIMS), 100
    engine = RawBatch(env.model, num_sims, min(usable_cpus(), num_sims))
    before = mujoco.mjtState.mjSTATE_PHYSICS | mujoco.mjtState.mjSTATE_TIME | mujoco.mjtState.mjSTATE_WARMSTART
    start = mujoco.mj_stateSize(env.model, int(before))
    columns = slice(start, start + env.model.nu)
    keys = jax.random.split(jax.random.key(setting.seed), num_sims)
    for name, values in jax.vmap(lambda key: env.engine_arrays(env.reset(key)))(keys).items():
        engine.bind(name)[:] = values
    random = np.random.default_rng(setting.seed)
    controls = random.uniform(env.action_low, env.action_high, (num_steps, num_sims, env.model.nu))

    def work() -> int:
        for control in controls:
            engine.state[:, columns] = control
            engine.step(nstep=env.num_substeps)
        return num_steps * num_sims

    return work


def rollout_work(config: Config, env: Any, setting: Setting) -> Work:
    """Runs the policy in the environment, inside one compiled program, without learning."""
    policy = networks.make_policy(config, env.obs_dim, env.action_dim)

    def init(key: jax.Array) -> tuple[Any, Any]:
        policy_key, env_key = jax.random.split(key)
        statistics = running_statistics.init(env.obs_dim)
        actor = rollout.Actor(policy_params=policy.init(policy_key), obs_statistics=statistics)
        return actor, rollout.init(env, config.num_envs, env_key)

    def run(actor: Any, state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        state, transition = rollout.rollout(env, policy.apply, actor, state, config.num_steps, key)
        return state, jnp.mean(transition.reward)

    keys = jax.random.split(jax.random.key(setting.seed), setting.num_seeds)
    actor, state = spread(init, setting.num_seeds)(keys)
    compiled = spread(run, setting.num_seeds)

    def work() -> int:
        nonlocal state
        state, _ = wait(compiled(actor, state, keys))
        return setting.num_seeds * config.batch_size

    return work


def spread(function: Callable[..., Any], num_seeds: int) -> Callable[..., Any]:
    """Turns a function of one seed into one of all seeds, [S]-leading, on the same devices as training uses."""
    mesh, spec = meshes.run_mesh(num_seeds), jax.P("runs")
    return jax.jit(
        jax.shard_map(full_precision(jax.vmap(function)), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    )


def training_work(config: Config, env: Any, setting: Setting) -> tuple[Work, float]:
    """Runs whole iterations as `train` does. The second value is the seconds that it took to compile them."""
    expert = noise(env, setting)
    resolved = build.resolve(config, env, expert)
    compiled = program.compile_program(resolved, env, expert_of(resolved, env, expert), setting.num_seeds)
    state = compiled.init(jax.random.split(jax.random.key(setting.seed), setting.num_seeds))

    def work() -> int:
        nonlocal state
        state, _ = wait(compiled.chunk(state))
        return setting.num_seeds * compiled.chunk_length * config.steps_per_iteration

    return work, compiled.compile_seconds


def _policy_steps(config: Config, env: Any, setting: Setting) -> tuple[Work, Work]:
    """One plain policy step and one outer step (dual step and meta-gradient) of malm, all seeds side by side."""
    config = config.replace(method="malm", cost_limit=0.0)
    constraint = constraints.make(config)
    policy = networks.make_policy(config, env.obs_dim, env.action_dim)

    def samples(key: jax.Array) -> tuple[Any, Batch, Batch]:
        params_key, obs_key, action_key, advantage_key = jax.random.split(key, 4)
        advantages = jax.random.normal(advantage_key, (2, config.batch_size))
        batch = Batch(
            obs=jax.random.normal(obs_key, (config.batch_size, env.obs_dim)),
            action=jax.random.normal(action_key, (config.batch_size, env.action_dim)),
            reward_advantage=advantages[0],
            cost_advantage=advantages[1],
            returns=advantages.T,
            cost=(advantages[1] > 0).astype(advantages.dtype),
        )
        return policy.init(params_key), *policy_step.split(
            batch, config.num_held_out, policy_step.random_order(config, action_key)
        )

    @jax.jit
    @jax.vmap
    def plain(params: Any, held_out: Batch, training: Batch) -> Any:
        multiplier, gap = jnp.asarray(0.5), jnp.asarray(1.0)
        return policy_step.improve(config, policy.apply, constraint, params, training, multiplier, gap, held_out)

    @jax.jit
    @jax.vmap
    def meta(taken: Any) -> Any:
        outer = policy_step.outer_problem(config, policy.apply, constraint, taken)
        return constraint.update(constraint.init(), jnp.asarray(1.0), outer)

    inputs = jax.jit(jax.vmap(samples))(jax.random.split(jax.random.key(setting.seed), setting.num_seeds))
    taken = plain(*inputs)[1]
    return _once(lambda: plain(*inputs)), _once(lambda: meta(taken))


def wait(values: Any) -> Any:
    """Returns `values` once they are computed."""
    return jax.tree.map(lambda leaf: leaf.block_until_ready(), values)


def _once(call: Callable[[], Any]) -> Work:
    def work() -> int:
        wait(call())
        return 1

    return work
