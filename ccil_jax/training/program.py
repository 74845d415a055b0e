"""One compiled program over all runs: `jit(vmap(loop(iteration)))`, spread over the local devices.

A run is a seed with its traced hyperparameters.
"""

import dataclasses
import operator
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

from ccil_jax.agents import build
from ccil_jax.agents.base import Agent
from ccil_jax.config import Config
from ccil_jax.meshes import mesh_of, run_mesh
from ccil_jax.training import guard
from ccil_jax.training.guard import GuardedState
from ccil_jax.types import ExpertData, Metrics
from envs.base import Environment
from envs.jax_tools import as_before, full_precision, numbers

LONGEST_CHUNK = 10  # iterations between two looks from Python
Varied = Mapping[str, jax.Array]  # [R]: traced fields that are not the same in all runs
NONE_VARIED: Varied = MappingProxyType({})


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


def _shapes(runs: Any, num_runs: int, sharding: NamedSharding) -> Any:
    """Of as many runs, however many there are in `runs`."""
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((num_runs, *leaf.shape[1:]), leaf.dtype, sharding=sharding), runs
    )


def make_agent(config: Config, env: Environment, expert: ExpertData | None) -> Agent:
    """The agent of `config.method`, guarded against numbers that are not finite."""
    agent = guard.protect(build.make(config, env, expert), config.max_skipped_updates)
    return Agent(init=full_precision(agent.init), step=full_precision(agent.step))


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Compiled:
    """The functions of R runs, side by side, on the devices of one mesh."""

    init: Callable[[Varied, jax.Array], GuardedState]
    chunk: Callable[[Varied, GuardedState, int], tuple[GuardedState, Metrics]]
    state: GuardedState
    text: Callable[[], str]


def _compiler(
    config: Config, env: Environment, expert: ExpertData | None, varied: Varied, chunk_length: int
) -> Callable[[int, jax.sharding.Mesh], _Compiled]:
    """How many runs, and the devices that share them -> their functions."""

    def init(config: Config, expert: ExpertData | None, varied: Varied, keys: jax.Array) -> GuardedState:
        def init_run(values: Varied, key: jax.Array) -> GuardedState:
            return make_agent(config.replace(**values), env, expert).init(key)

        return jax.vmap(init_run)(varied, keys)

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
                state_now = jax.tree.map(as_before, state, carry[0])
                state_next, row = step(own, expert, state_now)
                return jax.tree.map(numbers, state_next), jax.tree.map(
                    lambda rows, value: rows.at[index].set(value), carry[1], row
                )

            # Keys pass as plain numbers: JAX's check of key reuse cannot follow vmapped keys around a loop.
            plain, rows = jax.lax.fori_loop(0, length, turn, (jax.tree.map(numbers, state), blank))
            return jax.tree.map(as_before, state, plain), rows

        return jax.vmap(iterate)(varied, state)

    def compile_on(num_runs: int, mesh: jax.sharding.Mesh) -> _Compiled:
        replicated, by_run = NamedSharding(mesh, P()), NamedSharding(mesh, P("runs"))

        def spread(function: Callable[..., Any], *replicated: P) -> Callable[..., Any]:
            # Runs never communicate, so each device carries out its share of them as a program of its own.
            specs = (*replicated, P("runs"), P("runs"))
            return jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=P("runs"), check_vma=False)

        own = jax.device_put((config, expert), replicated)
        values, keys = _shapes((dict(varied), jax.eval_shape(lambda: jax.random.key(0)[None])), num_runs, by_run)
        jitted_init = jax.jit(spread(init, P(), P()), out_shardings=by_run)
        compiled_init = jitted_init.lower(*own, values, keys).compile()
        state = _shapes(jax.eval_shape(init, *own, values, keys), num_runs, by_run)
        length = jax.device_put(np.int32(chunk_length), replicated)
        jitted_chunk = jax.jit(spread(chunk, P(), P(), P()), donate_argnums=4)
        compiled_chunk = jitted_chunk.lower(*own, length, values, state).compile()

        def run(varied: Varied, state: GuardedState, length: int) -> tuple[GuardedState, Metrics]:
            wanted = jax.device_put(np.int32(length), replicated)
            with jax.transfer_guard("disallow"):  # all else is on the devices, and stays there
                return compiled_chunk(*own, wanted, varied, state)

        return _Compiled(
            init=lambda varied, keys: compiled_init(*own, varied, keys),
            chunk=run,
            state=state,
            text=lambda: compiled_chunk.as_text() or "",
        )

    return compile_on


def compile_program(
    config: Config,
    env: Environment,
    expert: ExpertData | None,
    num_runs: int,
    varied: Varied = NONE_VARIED,
    one_by_one: bool = False,
) -> Program:
    """`jit(vmap(loop(iteration)))` over runs, compiled and spread over `run_mesh`.

    Args:
        config: resolved.
        env: one environment, unbatched.
        expert: None for task rewards.
        num_runs: R.
        varied: values [R] of the traced fields of `config` that are not the same in all runs, by name.
        one_by_one: a device takes its runs in turn instead of side by side. XLA rounds otherwise for two runs than for
            three, and on two devices than on one, so what it compiles then is, for each device, the program of a
            single run: the bits of a run are the same however many there are, on however many devices.
    """
    start = time.perf_counter()
    chunk_length = min(LONGEST_CHUNK, config.num_iterations)
    mesh = run_mesh(num_runs)
    by_run = NamedSharding(mesh, P("runs"))
    values = jax.device_put(dict(varied), by_run)
    compile_on = _compiler(config, env, expert, varied, chunk_length)
    compiled = _in_turn(compile_on, by_run, num_runs) if one_by_one else compile_on(num_runs, mesh)
    return Program(
        init=lambda keys: compiled.init(values, jax.device_put(keys, by_run)),
        chunk=lambda state, length=chunk_length: compiled.chunk(values, state, length),
        state=_shapes(compiled.state, num_runs, by_run),
        chunk_length=chunk_length,
        compile_seconds=time.perf_counter() - start,
        text=compiled.text,
    )


def _in_turn(
    compile_on: Callable[[int, jax.sharding.Mesh], _Compiled], by_run: NamedSharding, num_runs: int
) -> _Compiled:
    """R runs, each carried out by the program of a single one, of which every device has its own."""
    meshes = [mesh_of([device]) for device in by_run.mesh.devices.flat]
    with ThreadPoolExecutor(len(meshes)) as pool:
        single = list(pool.map(lambda mesh: compile_on(1, mesh), meshes))

    @jax.jit
    def split(runs: Any) -> list[Any]:
        return [jax.tree.map(operator.itemgetter(slice(i, i + 1)), runs) for i in range(num_runs // len(meshes))]

    @jax.jit
    def join(runs: Sequence[Any]) -> Any:
        return jax.tree.map(lambda *rows: jnp.concatenate(rows), *runs)

    def take_apart(runs: Any) -> list[tuple[Any, ...]]:
        """By turn, of each device its own."""
        shards = [jax.tree.map(lambda leaf: leaf.addressable_shards[i].data, runs) for i in range(len(meshes))]  # noqa: B023
        return list(zip(*(split(shard) for shard in shards), strict=True))

    def put_together(turns: Sequence[Sequence[Any]]) -> Any:
        shards = [join(runs) for runs in zip(*turns, strict=True)]
        return jax.tree.map(
            lambda *parts: jax.make_array_from_single_device_arrays((num_runs, *parts[0].shape[1:]), by_run, parts),
            *shards,
        )

    def call(function: Callable[[_Compiled], Callable[..., Any]], runs: Any, *arguments: Any) -> Any:
        """Every device one run at a time: the first of each, then the second."""
        done = []
        for turn in take_apart(runs):
            results = [function(compiled)(*own, *arguments) for compiled, own in zip(single, turn, strict=True)]
            done.append(jax.block_until_ready(results))
        return put_together(done)

    return _Compiled(
        init=lambda varied, keys: call(operator.attrgetter("init"), (varied, keys)),
        chunk=lambda varied, state, length: call(operator.attrgetter("chunk"), (varied, state), length),
        state=single[0].state,
        text=single[0].text,
    )
