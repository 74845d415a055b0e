"""One compiled program over all runs: `jit(vmap(loop(iteration)))`, spread over the local devices.

A run is a seed with its traced hyperparameters.
"""

import dataclasses
import os
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from ccil_jax import agents, guard
from ccil_jax.config import Config
from ccil_jax.guard import GuardedState
from ccil_jax.on_policy import Agent
from ccil_jax.types import ExpertData, Metrics
from envs.base import Environment

LONGEST_CHUNK = 10  # iterations between two looks from Python
Varied = Mapping[str, jax.Array]  # traced fields that are not the same in all runs
NONE_VARIED: Varied = MappingProxyType({})
# XLA removes common subexpressions earlier from a program for several devices than from one for a single device, after
# which it fuses, and so rounds, differently.
_ALIKE_ON_ANY_DEVICES: dict[str, str | bool] = {"xla_disable_hlo_passes": "cse"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Program:
    """The compiled functions of R runs that share their static hyperparameters."""

    init: Callable[[jax.Array], GuardedState]  # keys [R] -> state
    state: GuardedState  # shapes, dtypes and shardings
    # state (donated), how many iterations (default: chunk_length) -> state, metrics [R, chunk_length], 0 after these
    chunk: Callable[..., tuple[GuardedState, Metrics]]
    chunk_length: int  # the most
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


def make_agent(config: Config, env: Environment, expert: ExpertData | None) -> Agent:
    """The agent of `config.method`, guarded against numbers that are not finite."""
    return guard.protect(agents.make(config, env, expert), config.max_skipped_updates)


def compile_program(
    config: Config,
    env: Environment,
    expert: ExpertData | None,
    num_runs: int,
    varied: Varied = NONE_VARIED,
    one_by_one: bool = False,
) -> Program:
    """`jit(vmap(loop(iteration)))` over runs, compiled once and spread over `run_mesh`.

    Args:
        config: resolved.
        env: one environment, unbatched.
        expert: None for task rewards.
        num_runs: R.
        varied: values [R] of the traced fields of `config` that are not the same in all runs, by name.
        one_by_one: a device takes its runs in turn instead of side by side. Batched products are rounded otherwise
            than single ones, so only then are the bits of a run the same however many there are, on however many
            devices.
    """
    chunk_length = min(LONGEST_CHUNK, config.num_iterations)
    mesh = run_mesh(num_runs)
    compiler_options = _ALIKE_ON_ANY_DEVICES if one_by_one else None

    def init(config: Config, expert: ExpertData | None, varied: Varied, keys: jax.Array) -> GuardedState:
        def init_run(values: Varied, key: jax.Array) -> GuardedState:
            return make_agent(config.replace(**values), env, expert).init(key)

        return over_runs(init_run, one_by_one)(varied, keys)

    @jax.jit
    def step(config: Config, expert: ExpertData | None, state: GuardedState) -> tuple[GuardedState, Metrics]:
        return make_agent(config, env, expert).step(state)

    def chunk(
        config: Config, expert: ExpertData | None, length: jax.Array, varied: Varied, state: GuardedState
    ) -> tuple[GuardedState, Metrics]:
        def iterate(values: Varied, state: GuardedState) -> tuple[GuardedState, Metrics]:
            own = config.replace(**values)
            # How many is decided at the call: the host looks about once a second, however long an iteration takes.
            blank = jax.tree.map(
                lambda row: jnp.zeros((chunk_length, *row.shape), row.dtype),
                jax.eval_shape(step, own, expert, state)[1],
            )

            def turn(index: jax.Array, carry: tuple[GuardedState, Metrics]) -> tuple[GuardedState, Metrics]:
                state, row = step(own, expert, carry[0])
                return state, jax.tree.map(lambda rows, value: rows.at[index].set(value), carry[1], row)

            return jax.lax.fori_loop(0, length, turn, (state, blank))

        return over_runs(iterate, one_by_one)(varied, state)

    def spread(function: Callable[..., Any], *replicated: P) -> Callable[..., Any]:
        # Runs never communicate, so each device carries out its share of them as a program of its own.
        return jax.shard_map(
            function, mesh=mesh, in_specs=(*replicated, P("runs"), P("runs")), out_specs=P("runs"), check_vma=False
        )

    start = time.perf_counter()
    replicated, by_run = NamedSharding(mesh, P()), NamedSharding(mesh, P("runs"))
    config, expert = jax.device_put((config, expert), replicated)
    by_name = jax.device_put(dict(varied), by_run)
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), num_runs))
    shardings = (replicated, replicated, by_run, by_run)
    jitted_init = jax.jit(spread(init, P(), P()), in_shardings=shardings, out_shardings=by_run)
    compiled_init = jitted_init.lower(config, expert, by_name, keys).compile(compiler_options)
    state = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=by_run),
        jax.eval_shape(init, config, expert, by_name, keys),
    )
    jitted_chunk = jax.jit(spread(chunk, P(), P(), P()), donate_argnums=4)
    length = jax.device_put(np.int32(chunk_length), replicated)
    compiled_chunk = jitted_chunk.lower(config, expert, length, by_name, state).compile(compiler_options)

    def run(state: GuardedState, length: int = chunk_length) -> tuple[GuardedState, Metrics]:
        wanted = jax.device_put(np.int32(length), replicated)
        with jax.transfer_guard("disallow"):  # all else is on the devices, and stays there
            return compiled_chunk(config, expert, wanted, by_name, state)

    return Program(
        init=lambda keys: compiled_init(config, expert, by_name, jax.device_put(keys, by_run)),
        chunk=run,
        state=state,
        chunk_length=chunk_length,
        compile_seconds=time.perf_counter() - start,
        text=lambda: compiled_chunk.as_text() or "",
    )
