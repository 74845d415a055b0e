"""One compiled program for all runs: `jit(vmap(loop(iteration)))`, spread over the local devices.

A run is one seed of one configuration. The runs of a program share all static hyperparameters, which decide the
program's shapes and branches. They may differ in traced hyperparameters, which are arrays to the program.

In the order of the functions below: an agent is guarded, the first states of R runs are made, one iteration is
repeated in a loop, the loop is vmapped over the runs, the runs are spread over a mesh of devices, and the result is
compiled before the first call.
"""

import dataclasses
import functools
import operator
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from ccil_jax.agents import build
from ccil_jax.agents.base import Agent
from ccil_jax.config import Config
from ccil_jax.errors import ConfigError
from ccil_jax.meshes import mesh_of, run_mesh
from ccil_jax.training import guard
from ccil_jax.training.guard import GuardedState
from ccil_jax.types import ExpertData, Metrics
from envs.base import Environment
from envs.jax_tools import as_key_like, as_numbers, full_precision

_COLUMNS = {"iteration", "seed", "env_steps"}  # of a run's metrics, beside those that the agent reports
LONGEST_CHUNK = 10  # the most iterations of one call, after which Python logs and may save
Varied = Mapping[str, jax.Array]  # [R] each: the traced fields that are not the same in all runs, by name
NONE_VARIED: Varied = MappingProxyType({})
Iteration = Callable[[Config, ExpertData | None, GuardedState], tuple[GuardedState, Metrics]]  # of one run


@dataclasses.dataclass(frozen=True, kw_only=True)
class Program:
    """The compiled functions of R runs that share their static hyperparameters."""

    init: Callable[[jax.Array], GuardedState]  # keys [R] -> state, [R]-leading
    state: GuardedState  # shapes, dtypes and shardings of a state, without values
    # state (its buffers are donated), number of iterations (at most `chunk_length`, which is the default)
    # -> state, metrics [R, chunk_length], whose entries after that number of iterations are 0
    chunk: Callable[..., tuple[GuardedState, Metrics]]
    chunk_length: int
    compile_seconds: float
    text: Callable[[], str]  # `chunk` as XLA has compiled it (optimised HLO)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Source:
    """What the functions of a program are compiled from."""

    config: Config  # of all runs; the fields in `varied` are replaced in each
    env: Environment
    expert: ExpertData | None
    varied: Varied
    iteration: Iteration
    chunk_length: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Compiled:
    """The compiled functions of the runs that share one mesh of devices."""

    init: Callable[[Varied, jax.Array], GuardedState]
    chunk: Callable[[Varied, GuardedState, int], tuple[GuardedState, Metrics]]
    state: GuardedState
    text: Callable[[], str]


def guarded_agent(config: Config, env: Environment, expert: ExpertData | None) -> Agent:
    """The agent of `config.method`, guarded against numbers that are not finite (`guard.protect`)."""
    agent = guard.protect(build.make(config, env, expert), config.max_skipped_updates)
    return Agent(init=full_precision(agent.init), step=full_precision(agent.step))


def _init_runs(
    env: Environment, config: Config, expert: ExpertData | None, varied: Varied, keys: jax.Array
) -> GuardedState:
    """The first states of R runs, from one key each."""

    def init_run(values: Varied, key: jax.Array) -> GuardedState:
        return guarded_agent(config.replace(**values), env, expert).init(key)

    return jax.vmap(init_run)(varied, keys)


def _iteration(env: Environment) -> Iteration:
    """One iteration of a run. It is jitted so that it is traced once, however often it is used while compiling."""

    @jax.jit
    def iteration(config: Config, expert: ExpertData | None, state: GuardedState) -> tuple[GuardedState, Metrics]:
        return guarded_agent(config, env, expert).step(state)

    return iteration


def _repeat(
    iteration: Callable[[GuardedState], tuple[GuardedState, Metrics]],
    state: GuardedState,
    length: jax.Array,
    chunk_length: int,
) -> tuple[GuardedState, Metrics]:
    """`length` iterations of one run, with their metrics as arrays [chunk_length] that end in zeros.

    `length` is an argument of the compiled program, not a constant in it, so that Python can look at the run about once
    a second however long an iteration takes.
    """
    _, shapes = jax.eval_shape(iteration, state)
    if taken := _COLUMNS & shapes.keys():
        raise ConfigError(f"metric {min(taken)!r}: is a column of every run's own; give it another name")
    no_metrics = jax.tree.map(lambda metric: jnp.zeros((chunk_length, *metric.shape), metric.dtype), shapes)

    def turn(index: jax.Array, carry: tuple[GuardedState, Metrics]) -> tuple[GuardedState, Metrics]:
        plain, rows = carry
        state_next, metrics = iteration(jax.tree.map(as_key_like, state, plain))
        rows = jax.tree.map(lambda row, metric: row.at[index].set(metric), rows, metrics)
        return jax.tree.map(as_numbers, state_next), rows

    # The loop carries random keys as plain numbers: JAX's check of key reuse cannot follow vmapped keys through a loop.
    plain, rows = jax.lax.fori_loop(0, length, turn, (jax.tree.map(as_numbers, state), no_metrics))
    return jax.tree.map(as_key_like, state, plain), rows


def _run_chunk(
    iteration: Iteration,
    chunk_length: int,
    config: Config,
    expert: ExpertData | None,
    length: jax.Array,
    varied: Varied,
    state: GuardedState,
) -> tuple[GuardedState, Metrics]:
    """`length` iterations of R runs, side by side."""

    def run(values: Varied, state: GuardedState) -> tuple[GuardedState, Metrics]:
        own = config.replace(**values)
        return _repeat(lambda state: iteration(own, expert, state), state, length, chunk_length)

    return jax.vmap(run)(varied, state)


def _spread(function: Callable[..., Any], mesh: Mesh, num_shared: int) -> Callable[..., Any]:
    """`function` of runs, with the runs divided among the devices of `mesh`.

    The first `num_shared` arguments are the same for all runs, the next two are [R]-leading, as is the result. Runs
    never communicate, so each device carries out its share of them as a program of its own (`shard_map`).
    """
    specs = (*[P()] * num_shared, P("runs"), P("runs"))
    return jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=P("runs"), check_vma=False)


def _compile(source: _Source, num_runs: int, mesh: Mesh) -> _Compiled:
    """Compiles the functions of `num_runs` runs that share the devices of `mesh`."""
    replicated, by_run = NamedSharding(mesh, P()), NamedSharding(mesh, P("runs"))
    own = jax.device_put((source.config, source.expert), replicated)
    one_key = jax.eval_shape(lambda: jax.random.key(0)[None])
    values, keys = _shapes((dict(source.varied), one_key), num_runs, by_run)

    init = functools.partial(_init_runs, source.env)
    jitted_init = jax.jit(_spread(init, mesh, num_shared=2), out_shardings=by_run)
    compiled_init = jitted_init.lower(*own, values, keys).compile()

    state = _shapes(jax.eval_shape(init, *own, values, keys), num_runs, by_run)
    length = jax.device_put(np.int32(source.chunk_length), replicated)
    chunk = functools.partial(_run_chunk, source.iteration, source.chunk_length)
    jitted_chunk = jax.jit(_spread(chunk, mesh, num_shared=3), donate_argnums=4)
    compiled_chunk = jitted_chunk.lower(*own, length, values, state).compile()

    def run_chunk(varied: Varied, state: GuardedState, length: int) -> tuple[GuardedState, Metrics]:
        wanted = jax.device_put(np.int32(length), replicated)
        with jax.transfer_guard("disallow"):  # everything else is on the devices, and stays there
            return compiled_chunk(*own, wanted, varied, state)

    return _Compiled(
        init=lambda varied, keys: compiled_init(*own, varied, keys),
        chunk=run_chunk,
        state=state,
        text=lambda: compiled_chunk.as_text() or "",
    )


def compile_program(
    config: Config,
    env: Environment,
    expert: ExpertData | None,
    num_runs: int,
    varied: Varied = NONE_VARIED,
    one_by_one: bool = False,
) -> Program:
    """`jit(vmap(loop(iteration)))` over runs, compiled and spread over the devices of `meshes.run_mesh`.

    Args:
        config: resolved (`runner.resolve`).
        env: one environment, unbatched.
        expert: None where the reward is the task's own.
        num_runs: R.
        varied: values [R] of the traced fields of `config` that are not the same in all runs, by name.
        one_by_one: each device carries out its runs one after the other, instead of side by side. XLA rounds a program
            for two runs differently from one for three, and on two devices differently from on one. With `one_by_one`
            it compiles, for each device, the program of a single run, so that the bits of a run are the same however
            many runs and devices there are.
    """
    start = time.perf_counter()
    mesh = run_mesh(num_runs)
    by_run = NamedSharding(mesh, P("runs"))
    values = jax.device_put(dict(varied), by_run)
    source = _Source(
        config=config,
        env=env,
        expert=expert,
        varied=varied,
        iteration=_iteration(env),
        chunk_length=min(LONGEST_CHUNK, config.num_iterations),
    )
    compiled = _compile_one_by_one(source, by_run) if one_by_one else _compile(source, num_runs, mesh)
    return Program(
        init=lambda keys: compiled.init(values, jax.device_put(keys, by_run)),
        chunk=lambda state, length=source.chunk_length: compiled.chunk(values, state, length),
        state=_shapes(compiled.state, num_runs, by_run),
        chunk_length=source.chunk_length,
        compile_seconds=time.perf_counter() - start,
        text=compiled.text,
    )


def _compile_one_by_one(source: _Source, by_run: NamedSharding) -> _Compiled:
    """Compiles, for every device of `by_run`, the program of a single run, and carries out all runs with these."""
    meshes = [mesh_of([device]) for device in by_run.mesh.devices.flat]
    with ThreadPoolExecutor(len(meshes)) as pool:
        singles = list(pool.map(lambda mesh: _compile(source, 1, mesh), meshes))

    def call(name: str, runs: Any, *arguments: Any) -> Any:
        """The function `name` of every run: first of each device's first run, then of each device's second, ..."""
        results = []
        for turn in _take_apart(runs, len(meshes)):
            started = [getattr(single, name)(*own, *arguments) for single, own in zip(singles, turn, strict=True)]
            results.append(jax.block_until_ready(started))
        return _put_together(results, by_run)

    return _Compiled(
        init=lambda varied, keys: call("init", (varied, keys)),
        chunk=lambda varied, state, length: call("chunk", (varied, state), length),
        state=singles[0].state,
        text=singles[0].text,
    )


def _take_apart(runs: Any, num_devices: int) -> list[tuple[Any, ...]]:
    """The single runs, each on the device that it is on: entry i holds every device's i-th run, [1]-leading."""

    def shard(device: int) -> Any:
        return jax.tree.map(lambda leaf: leaf.addressable_shards[device].data, runs)

    return list(zip(*(_split(shard(device)) for device in range(num_devices)), strict=True))


@jax.jit
def _split(runs: Any) -> list[Any]:
    num_runs = len(jax.tree.leaves(runs)[0])
    return [jax.tree.map(operator.itemgetter(slice(i, i + 1)), runs) for i in range(num_runs)]


def _put_together(turns: Sequence[Sequence[Any]], by_run: NamedSharding) -> Any:
    """The inverse of `_take_apart`: all runs as one tree, spread over the devices."""
    num_runs = sum(map(len, turns))
    shards = [_concatenate(runs) for runs in zip(*turns, strict=True)]
    return jax.tree.map(
        lambda *parts: jax.make_array_from_single_device_arrays((num_runs, *parts[0].shape[1:]), by_run, parts),
        *shards,
    )


@jax.jit
def _concatenate(runs: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *rows: jnp.concatenate(rows), *runs)


def _shapes(runs: Any, num_runs: int, sharding: NamedSharding) -> Any:
    """Shapes and dtypes of `num_runs` runs; `runs` may hold another number of them."""
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((num_runs, *leaf.shape[1:]), leaf.dtype, sharding=sharding), runs
    )
