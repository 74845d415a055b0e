"""One compiled program over all seeds: `jit(vmap(loop(iteration)))`, spread over the local devices."""

import dataclasses
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from ccil_jax import guard, on_policy
from ccil_jax.config import Config
from ccil_jax.guard import GuardedState
from ccil_jax.on_policy import Agent
from ccil_jax.types import ExpertData, Metrics
from envs.base import Environment

LONGEST_CHUNK = 10  # iterations between two looks from Python


@dataclasses.dataclass(frozen=True, kw_only=True)
class Program:
    """The compiled functions of one configuration."""

    init: Callable[[jax.Array], GuardedState]  # keys [S] -> state
    state: GuardedState  # shapes, dtypes and shardings
    # state (donated), how many iterations (default: chunk_length) -> state, metrics [S, chunk_length], 0 after these
    chunk: Callable[..., tuple[GuardedState, Metrics]]
    chunk_length: int  # the most
    compile_seconds: float


def seed_mesh(num_seeds: int) -> jax.sharding.Mesh:
    """The local devices that share the seeds evenly: as many as divide their number."""
    devices = jax.local_devices()
    if devices[0].platform == "cpu":
        # A LAPACK kernel (MJX factorises with them) waits, in a thread of XLA's pool, for helpers from that pool: one
        # thread must stay free, or all wait for ever. XLA reads the pool's size from this variable too.
        num_threads = int(os.environ.get("PJRT_NPROC") or os.cpu_count() or 1)
        devices = devices[: max(1, num_threads - 1)]
    size = max(n for n in range(1, len(devices) + 1) if num_seeds % n == 0)
    return jax.make_mesh((size,), ("seeds",), axis_types=(AxisType.Auto,), devices=devices[:size])


def make_agent(config: Config, env: Environment, expert: ExpertData | None) -> Agent:
    """The agent of `config.method`, guarded against numbers that are not finite."""
    return guard.protect(on_policy.make(config, env, expert), config.max_skipped_updates)


def compile_program(config: Config, env: Environment, expert: ExpertData | None, num_seeds: int) -> Program:
    """`jit(vmap(loop(iteration)))` over seeds, compiled once and spread over `seed_mesh`.

    Args:
        config: resolved.
        env: one environment, unbatched.
        expert: None for task rewards.
        num_seeds: S.
    """
    chunk_length = min(LONGEST_CHUNK, config.num_iterations)
    mesh = seed_mesh(num_seeds)

    def init(config: Config, expert: ExpertData | None, keys: jax.Array) -> GuardedState:
        return jax.vmap(make_agent(config, env, expert).init)(keys)

    @jax.jit
    def step(config: Config, expert: ExpertData | None, state: GuardedState) -> tuple[GuardedState, Metrics]:
        return make_agent(config, env, expert).step(state)

    def chunk(
        config: Config, expert: ExpertData | None, length: jax.Array, state: GuardedState
    ) -> tuple[GuardedState, Metrics]:
        def iterate(state: GuardedState) -> tuple[GuardedState, Metrics]:
            # How many is decided at the call: the host looks about once a second, however long an iteration takes.
            blank = jax.tree.map(
                lambda row: jnp.zeros((chunk_length, *row.shape), row.dtype),
                jax.eval_shape(step, config, expert, state)[1],
            )

            def turn(index: jax.Array, carry: tuple[GuardedState, Metrics]) -> tuple[GuardedState, Metrics]:
                state, row = step(config, expert, carry[0])
                return state, jax.tree.map(lambda rows, value: rows.at[index].set(value), carry[1], row)

            return jax.lax.fori_loop(0, length, turn, (state, blank))

        return jax.vmap(iterate)(state)

    def spread(function: Callable[..., Any], *replicated: P) -> Callable[..., Any]:
        # Seeds never communicate, so each device runs its share of them as a program of its own.
        return jax.shard_map(
            function, mesh=mesh, in_specs=(*replicated, P("seeds")), out_specs=P("seeds"), check_vma=False
        )

    start = time.perf_counter()
    replicated, by_seed = NamedSharding(mesh, P()), NamedSharding(mesh, P("seeds"))
    config, expert = jax.device_put((config, expert), replicated)
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), num_seeds))
    shardings = (replicated, replicated, by_seed)
    jitted_init = jax.jit(spread(init, P(), P()), in_shardings=shardings, out_shardings=by_seed)
    compiled_init = jitted_init.lower(config, expert, keys).compile()
    state = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=by_seed),
        jax.eval_shape(init, config, expert, keys),
    )
    jitted_chunk = jax.jit(spread(chunk, P(), P(), P()), donate_argnums=3)
    length = jax.device_put(np.int32(chunk_length), replicated)
    compiled_chunk = jitted_chunk.lower(config, expert, length, state).compile()

    def run(state: GuardedState, length: int = chunk_length) -> tuple[GuardedState, Metrics]:
        wanted = jax.device_put(np.int32(length), replicated)
        return compiled_chunk(config, expert, wanted, state)

    return Program(
        init=lambda keys: compiled_init(config, expert, jax.device_put(keys, by_seed)),
        chunk=run,
        state=state,
        chunk_length=chunk_length,
        compile_seconds=time.perf_counter() - start,
    )
