"""One compiled program over all seeds: `jit(vmap(scan(iteration)))`, spread over the local devices."""

import dataclasses
import math
import os
import time
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from ccil_jax import on_policy
from ccil_jax.config import Config
from ccil_jax.on_policy import AgentState
from ccil_jax.types import ExpertData, Metrics
from envs.base import Environment

LONGEST_CHUNK = 10  # iterations between two looks from Python


@dataclasses.dataclass(frozen=True, kw_only=True)
class Program:
    """The compiled functions of one configuration."""

    init: Callable[[jax.Array], AgentState]  # keys [S] -> state
    state: AgentState  # shapes, dtypes and shardings
    chunk: Callable[[AgentState], tuple[AgentState, Metrics]]  # state (donated) -> state, metrics [S, chunk_length]
    chunk_length: int
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


def compile_program(
    config: Config, env: Environment, expert: ExpertData | None, num_seeds: int, num_done: int = 0
) -> Program:
    """`jit(vmap(scan(iteration)))` over seeds, compiled once and spread over `seed_mesh`.

    Args:
        config: resolved.
        env: one environment, unbatched.
        expert: None for task rewards.
        num_seeds: S.
        num_done: iterations behind a run that is continued: chunks lead from there to exactly `num_iterations`.
    """
    common = math.gcd(config.num_iterations, num_done)
    chunk_length = max(n for n in range(1, LONGEST_CHUNK + 1) if common % n == 0)
    mesh = seed_mesh(num_seeds)

    def init(config: Config, expert: ExpertData | None, keys: jax.Array) -> AgentState:
        return jax.vmap(on_policy.make(config, env, expert).init)(keys)

    def chunk(config: Config, expert: ExpertData | None, state: AgentState) -> tuple[AgentState, Metrics]:
        agent = on_policy.make(config, env, expert)

        def iterate(state: AgentState) -> tuple[AgentState, Metrics]:
            return jax.lax.scan(lambda state, _: agent.step(state), state, None, length=chunk_length)

        return jax.vmap(iterate)(state)

    def spread(function: Callable[..., Any]) -> Callable[..., Any]:
        # Seeds never communicate, so each device runs its share of them as a program of its own.
        return jax.shard_map(
            function, mesh=mesh, in_specs=(P(), P(), P("seeds")), out_specs=P("seeds"), check_vma=False
        )

    start = time.perf_counter()
    replicated, by_seed = NamedSharding(mesh, P()), NamedSharding(mesh, P("seeds"))
    config, expert = jax.device_put((config, expert), replicated)
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), num_seeds))
    shardings = (replicated, replicated, by_seed)
    jitted_init = jax.jit(spread(init), in_shardings=shardings, out_shardings=by_seed)
    compiled_init = jitted_init.lower(config, expert, keys).compile()
    state = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=by_seed),
        jax.eval_shape(init, config, expert, keys),
    )
    compiled_chunk = jax.jit(spread(chunk), donate_argnums=2).lower(config, expert, state).compile()
    return Program(
        init=lambda keys: compiled_init(config, expert, jax.device_put(keys, by_seed)),
        chunk=lambda state: compiled_chunk(config, expert, state),
        state=state,
        chunk_length=chunk_length,
        compile_seconds=time.perf_counter() - start,
    )
