"""One compiled program over all runs: `jit(vmap(scan(iteration)))`, spread over the local devices.

A run is a seed with its traced hyperparameters.
"""

import dataclasses
import math
import os
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from ccil_jax import agents
from ccil_jax.config import Config
from ccil_jax.types import ExpertData, Metrics, PyTree
from envs.base import Environment

LONGEST_CHUNK = 10  # iterations between two looks from Python
Varied = Mapping[str, jax.Array]  # traced fields that are not the same in all runs
NONE_VARIED: Varied = MappingProxyType({})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Program:
    """The compiled functions of R runs that share their static hyperparameters."""

    init: Callable[[jax.Array], PyTree]  # keys [R] -> state
    state: PyTree  # shapes, dtypes and shardings
    chunk: Callable[[PyTree], tuple[PyTree, Metrics]]  # state (donated) -> state, metrics [R, chunk_length]
    chunk_length: int
    compile_seconds: float
    text: Callable[[], str]  # of `chunk`, as XLA has compiled it


def run_mesh(num_runs: int) -> jax.sharding.Mesh:
    """The local devices that share the runs evenly: as many as divide their number."""
    devices = jax.local_devices()
    if devices[0].platform == "cpu":
        # A LAPACK kernel (MJX factorises with them) waits, in a thread of XLA's pool, for helpers from that pool: one
        # thread must stay free, or all wait for ever. XLA reads the pool's size from this variable too.
        num_threads = int(os.environ.get("PJRT_NPROC") or os.cpu_count() or 1)
        devices = devices[: max(1, num_threads - 1)]
    size = max(n for n in range(1, len(devices) + 1) if num_runs % n == 0)
    return jax.make_mesh((size,), ("runs",), axis_types=(AxisType.Auto,), devices=devices[:size])


def over_runs(function: Callable[..., Any], one_by_one: bool) -> Callable[..., Any]:
    """`function` of one run as a function of several, [R]-leading: side by side, or in turn."""
    if one_by_one:
        return lambda *arguments: jax.lax.map(lambda of_run: function(*of_run), arguments)
    return jax.vmap(function)


def compile_program(
    config: Config,
    env: Environment,
    expert: ExpertData | None,
    num_runs: int,
    num_done: int = 0,
    varied: Varied = NONE_VARIED,
    one_by_one: bool = False,
) -> Program:
    """`jit(vmap(scan(iteration)))` over runs, compiled once and spread over `run_mesh`.

    Args:
        config: resolved.
        env: one environment, unbatched.
        expert: None for task rewards.
        num_runs: R.
        num_done: iterations behind a run that is continued: chunks lead from there to exactly `num_iterations`.
        varied: values [R] of the traced fields of `config` that are not the same in all runs, by name.
        one_by_one: a device takes its runs in turn instead of side by side. Batched products are rounded otherwise
            than single ones, so only then are the bits of a run the same however many share its device. XLA treats a
            program for a single device differently, though: this holds among meshes of two devices or more.
    """
    common = math.gcd(config.num_iterations, num_done)
    chunk_length = max(n for n in range(1, LONGEST_CHUNK + 1) if common % n == 0)
    mesh = run_mesh(num_runs)

    def init(config: Config, expert: ExpertData | None, varied: Varied, keys: jax.Array) -> PyTree:
        def init_run(values: Varied, key: jax.Array) -> PyTree:
            return agents.make(config.replace(**values), env, expert).init(key)

        return over_runs(init_run, one_by_one)(varied, keys)

    def chunk(config: Config, expert: ExpertData | None, varied: Varied, state: PyTree) -> tuple[PyTree, Metrics]:
        def iterate(values: Varied, state: PyTree) -> tuple[PyTree, Metrics]:
            agent = agents.make(config.replace(**values), env, expert)
            return jax.lax.scan(lambda state, _: agent.step(state), state, None, length=chunk_length)

        return over_runs(iterate, one_by_one)(varied, state)

    def spread(function: Callable[..., Any]) -> Callable[..., Any]:
        # Runs never communicate, so each device carries out its share of them as a program of its own.
        return jax.shard_map(
            function, mesh=mesh, in_specs=(P(), P(), P("runs"), P("runs")), out_specs=P("runs"), check_vma=False
        )

    start = time.perf_counter()
    replicated, by_run = NamedSharding(mesh, P()), NamedSharding(mesh, P("runs"))
    config, expert = jax.device_put((config, expert), replicated)
    by_name = jax.device_put(dict(varied), by_run)
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), num_runs))
    shardings = (replicated, replicated, by_run, by_run)
    jitted_init = jax.jit(spread(init), in_shardings=shardings, out_shardings=by_run)
    compiled_init = jitted_init.lower(config, expert, by_name, keys).compile()
    state = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=by_run),
        jax.eval_shape(init, config, expert, by_name, keys),
    )
    compiled_chunk = jax.jit(spread(chunk), donate_argnums=3).lower(config, expert, by_name, state).compile()
    return Program(
        init=lambda keys: compiled_init(config, expert, by_name, jax.device_put(keys, by_run)),
        chunk=lambda state: compiled_chunk(config, expert, by_name, state),
        state=state,
        chunk_length=chunk_length,
        compile_seconds=time.perf_counter() - start,
        text=lambda: compiled_chunk.as_text() or "",
    )
