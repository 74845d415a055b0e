"""Training: the loop that logs and checkpoints between chunks of the compiled program."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ccil_jax.acting.rollout import Actor
from ccil_jax.agents.build import resolve
from ccil_jax.agents.expert import expert_data
from ccil_jax.config import Config, field_names, is_integer
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.errors import CheckpointError, ConfigError
from ccil_jax.training import filesystem, guard
from ccil_jax.training.checkpointing import Checkpointer
from ccil_jax.training.guard import GuardedState
from ccil_jax.training.history import without_unknown
from ccil_jax.training.manifests import Identity, identity_of
from ccil_jax.training.program import Program, compile_program, make_agent
from ccil_jax.types import ExpertData, ExpertTransitions
from envs.base import Environment

CHECKPOINT_SECONDS = 60.0  # about this much work is lost with a killed process
SAVING_SHARE = 0.02  # of the time: large states are saved less often
CHUNK_SECONDS = 1.0  # between two looks from Python, unless one iteration takes longer

History = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Progress:
    """What `on_progress` sees after every chunk."""

    iteration: int  # finished so far
    num_iterations: int
    metrics: History  # the new rows, [chunk, num_runs] each; NaN for what is not known yet
    env_steps_per_second: float  # of this chunk, all runs together
    compile_seconds: float
    stopped: np.ndarray  # [num_seeds] bool: seeds given up, after too many iterations in a row that were not finite


@dataclasses.dataclass(frozen=True, kw_only=True)
class Result:
    """A finished (or stopped) run."""

    config: Config  # as resolved: the demonstrations' cost limit is set
    identity: Identity  # of this configuration's runs
    metrics: History  # [iterations, num_seeds] each; {} before the first
    state: GuardedState  # [num_seeds]-leading
    env_steps: int  # per seed
    compile_seconds: float
    wall_seconds: float  # of this call, compilation included
    stopped: np.ndarray  # [num_seeds] bool, as in `Progress`

    @property
    def agent(self) -> Actor:
        """Policies and observation statistics, [num_seeds]-leading, on one device."""
        return jax.device_put(self.state.actor, jax.local_devices()[0])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Loaded:
    """A trained agent from disk."""

    config: Config
    agent: Actor  # [num_seeds]-leading


def train(
    config: Config,
    env: Environment,
    demonstrations: Demonstrations | None = None,
    *,
    num_seeds: int = 1,
    seed: int = 0,
    one_by_one: bool = False,
    checkpoint_dir: str | Path | None = None,
    resume: bool = False,
    moved: Collection[str] = (),
    on_start: Callable[[History], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    stop_after: int | None = None,
) -> Result:
    """Trains `config.method` with `num_seeds` seeds in one vmapped program.

    Args:
        config: hyperparameters; its cost limit is taken from the demonstrations where the method says so.
        env: one environment, unbatched.
        demonstrations: needed by the imitation methods.
        num_seeds: S.
        seed: of the S keys; the same seed and S give the same bits.
        one_by_one: each device takes its seeds in turn. Then a seed's bits depend neither on how many seeds there are
            nor on how many devices.
        checkpoint_dir: where whole-state checkpoints go, about once a minute and at the end.
        resume: continue from the newest intact checkpoint in `checkpoint_dir`, of the same training; begin where there
            is none. Without it, a folder with checkpoints is refused.
        moved: names of traced fields that may differ from those of the training that is resumed.
        on_start: called once, before the first iteration, with the metrics of those that are done ({} if none is).
        on_progress: called after every chunk of iterations.
        should_stop: asked after every chunk; once true, the state is saved and the result so far is returned.
        stop_after: stop once this many iterations are done, to be resumed later; 0 takes no step at all.

    Raises:
        ConfigError: options, environment and demonstrations do not fit together; or the checkpoints are damaged, those
            of another training, in use by another process, or cannot be written.
        DemonstrationsError: an episode of the demonstrations is longer than the environment's.
    """
    return train_runs(
        [config],
        env,
        demonstrations,
        num_seeds=num_seeds,
        seed=seed,
        one_by_one=one_by_one,
        checkpoint_dir=checkpoint_dir,
        resume=resume,
        moved=moved,
        on_start=on_start,
        on_progress=on_progress,
        should_stop=should_stop,
        stop_after=stop_after,
    )[0]


@jax.transfer_guard("allow")  # what is set up and what comes back travels on purpose
def train_runs(
    configs: Sequence[Config],
    env: Environment,
    demonstrations: Demonstrations | None = None,
    *,
    num_seeds: int = 1,
    seed: int = 0,
    one_by_one: bool = False,
    checkpoint_dir: str | Path | None = None,
    resume: bool = False,
    moved: Collection[str] = (),
    on_start: Callable[[History], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    stop_after: int | None = None,
) -> list[Result]:
    """Trains several configurations that differ in traced fields alone, each with the same seeds, in one program.

    Its runs are [len(configs) * num_seeds], configuration after configuration: that is the order of the columns that
    `on_progress` sees and of the states in a checkpoint. All else is as in `train`. Returns one result for each.

    Raises:
        ConfigError: also where the configurations differ in a static field.
    """
    start = time.perf_counter()
    if not configs:
        raise ConfigError("configs: give at least one configuration")
    _check_integer("num_seeds", num_seeds, 1)
    _check_integer("seed", seed, 0, 2**32 - 1)
    _check_integer("stop_after", 0 if stop_after is None else stop_after, 0)
    for name, value in (("one_by_one", one_by_one), ("resume", resume)):
        if not isinstance(value, bool):
            raise ConfigError(f"{name} {value!r}: give True or False")
    if resume and checkpoint_dir is None:
        raise ConfigError("resume True: there is nothing to go on from; give checkpoint_dir")
    if moved and not resume:
        raise ConfigError(f"moved {', '.join(moved)}: for a training that is resumed; leave it out, or add resume=True")
    if static := set(moved) - set(field_names(traced=True)):
        raise ConfigError(f"moved {min(static)}: only a traced field may differ from the training that is resumed")
    checkpoint_dir = None if checkpoint_dir is None else Path(checkpoint_dir)
    configs = [resolve(config, env, demonstrations) for config in configs]
    config, varied = join(configs, num_seeds)
    num_runs = len(configs) * num_seeds
    last = config.num_iterations if stop_after is None else min(stop_after, config.num_iterations)
    identity = identity_of(configs, env, demonstrations, num_seeds, seed)

    with contextlib.ExitStack() as stack:
        checkpoints = None
        if checkpoint_dir:
            stack.enter_context(filesystem.hold(checkpoint_dir / ".writer.lock"))
            checkpoints = stack.enter_context(Checkpointer(checkpoint_dir, identity, free=frozenset(moved)))
            if not resume:
                checkpoints.check_empty()
        found = checkpoints.latest_step() if checkpoints else None
        if checkpoints and found:
            checkpoints.check_identity(found)  # compiling takes longer
            if found > config.num_iterations:
                raise ConfigError(
                    f"env_steps {config.env_steps}: the training in {checkpoint_dir} has done "
                    f"{found * config.steps_per_iteration}; give at least as many"
                )
        program = compile_program(
            config, env, expert_data(demonstrations), num_runs, varied=varied, one_by_one=one_by_one
        )
        if checkpoints and found:
            done, (state, history) = found, _restore(checkpoints, found, program)
            history = without_unknown(history)
            if not config.has_multiplier:
                history.pop("multiplier", None)  # an earlier version logged 0 for methods that have none
        else:
            keys = jnp.tile(jax.random.split(jax.random.key(seed), num_seeds), len(configs))
            done, state, history = 0, program.init(keys), {}
        if on_start:
            on_start(history)
        stopped = np.asarray(guard.stopped(state, config.max_skipped_updates))
        saved_at, saving, length = time.perf_counter(), 0.0, 1
        while done < last and not stopped.all():
            chunk_start = time.perf_counter()
            length = min(length, last - done)
            state, metrics = program.chunk(state, length)
            # Cut on the host: a slice on the device would be compiled for every length.
            rows = _rows({name: np.asarray(value)[:, :length] for name, value in metrics.items()}, done, config)
            stopped = np.asarray(guard.stopped(state, config.max_skipped_updates))
            elapsed = time.perf_counter() - chunk_start
            history = {name: np.concatenate([history[name], row]) if history else row for name, row in rows.items()}
            history = without_unknown(history)
            rows = {name: values[-length:] for name, values in history.items()}
            done += length
            stop = done >= last or bool(stopped.all()) or (should_stop is not None and should_stop())
            due = time.perf_counter() - saved_at > max(CHECKPOINT_SECONDS, saving / SAVING_SHARE)
            if checkpoints and (stop or due):
                saving_start = time.perf_counter()
                checkpoints.save(done, {"state": state, "history": history})
                saved_at = time.perf_counter()
                saving = saved_at - saving_start
            if on_progress:
                on_progress(
                    Progress(
                        iteration=done,
                        num_iterations=config.num_iterations,
                        metrics=rows,
                        env_steps_per_second=length * config.steps_per_iteration * num_runs / elapsed,
                        compile_seconds=program.compile_seconds,
                        stopped=stopped,
                    )
                )
            if stop:
                break
            length = max(1, min(program.chunk_length, int(CHUNK_SECONDS * length / elapsed)))
    return [
        Result(
            config=config,
            identity=dataclasses.replace(identity, configs=(config,)),
            metrics={name: rows[:, own] for name, rows in history.items()},
            state=jax.tree.map(lambda leaf, own=own: leaf[own], state) if len(configs) > 1 else state,
            env_steps=done * config.steps_per_iteration,
            compile_seconds=program.compile_seconds,
            wall_seconds=time.perf_counter() - start,
            stopped=stopped[own],
        )
        for config, own in zip(configs, columns(len(configs), num_seeds), strict=True)
    ]


def _check_integer(name: str, value: Any, least: int, most: int = 2**31 - 1) -> None:
    if not (is_integer(value) and least <= int(value) <= most):
        raise ConfigError(f"{name} {value!r}: give an integer from {least} to {most}")


def columns(num_configs: int, num_seeds: int) -> list[slice]:
    """Where each configuration's runs are among those of `train_runs`."""
    return [slice(i * num_seeds, (i + 1) * num_seeds) for i in range(num_configs)]


def join(configs: Sequence[Config], num_seeds: int) -> tuple[Config, dict[str, jax.Array]]:
    """What the configurations share, and the traced fields in which they differ as arrays [num_runs].

    Raises:
        ConfigError: a static field differs: these cannot share a program.
    """
    first = configs[0]
    for name in field_names(traced=False):
        values = sorted({str(getattr(config, name)) for config in configs})
        if len(values) > 1:
            raise ConfigError(f"{name} {' and '.join(values)}: only traced fields may differ within one program")
    varied = {}
    for name in field_names(traced=True):
        of_config = [getattr(config, name) for config in configs]
        if any(value != of_config[0] for value in of_config):
            varied[name] = jnp.repeat(jnp.asarray(of_config, jnp.result_type(float)), num_seeds)
    return first, varied


@jax.transfer_guard("allow")  # what is set up and what comes back travels on purpose
def save(result: Result, directory: Path) -> None:
    """Writes a finished run as a checkpoint of its own; the one of its program holds all the program's runs.

    What another training has left in `directory` is set aside.
    """
    if not result.metrics:
        raise ConfigError(f"{directory}: nothing to save, as no iteration was carried out")
    with Checkpointer(directory, result.identity) as checkpoints:
        checkpoints.replace(len(result.metrics["env_steps"]), {"state": result.state, "history": result.metrics})


def _restore(checkpoints: Checkpointer, step: int, program: Program) -> tuple[GuardedState, History]:
    like = {"state": program.state, "history": checkpoints.structure(step)["history"]}
    saved = checkpoints.restore(step, like)
    return saved["state"], saved["history"]


@jax.transfer_guard("allow")  # what is set up and what comes back travels on purpose
def load(config: Config, env: Environment, checkpoint_dir: Path, num_seeds: int) -> Loaded:
    """The policies of the newest checkpoint in `checkpoint_dir`. Demonstrations are not needed.

    Raises:
        CheckpointError: there is no intact checkpoint, or it is another training's.
    """
    config = config.replace(cost_limit=config.cost_limit or 0.0, temperature=config.temperature or 0.0)
    obs, action = jnp.zeros((1, env.obs_dim)), jnp.zeros((1, env.action_dim))
    transitions = ExpertTransitions(obs=obs, action=action, next_obs=obs, terminated=jnp.zeros(1), initial_obs=obs)
    steps = ExpertData(  # only their widths matter
        obs=obs, action=action, held_out_obs=obs, held_out_action=action, transitions=transitions
    )

    def init(key: jax.Array) -> GuardedState:
        return jax.vmap(make_agent(config, env, steps).init)(jax.random.split(key, num_seeds))

    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    like = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=device),
        jax.eval_shape(init, jax.random.key(0)),
    )
    # Numbers inside the program do not matter for acting, and the limit may not be known without the demonstrations.
    identity = Identity(configs=(config,), num_seeds=num_seeds)
    with Checkpointer(checkpoint_dir, identity, free=frozenset(field_names(traced=True)), readonly=True) as checkpoints:
        step = checkpoints.latest_step()
        if step is None:
            raise CheckpointError(f"{checkpoint_dir}: holds no finished checkpoint; train first, or continue the run")
        saved = checkpoints.restore(step, {"state": like, "history": checkpoints.structure(step)["history"]})
    return Loaded(config=config, agent=saved["state"].actor)


def _rows(metrics: History, done: int, config: Config) -> History:
    """Metrics of a chunk [R, chunk] as rows [chunk, R], with the step counter."""
    rows = {name: value.T for name, value in metrics.items()}
    length, num_runs = next(iter(rows.values())).shape
    # Counted on the host: a 32-bit counter would overflow.
    env_steps = np.arange(done + 1, done + length + 1, dtype=np.int64) * config.steps_per_iteration
    return {"env_steps": np.tile(env_steps[:, None], (1, num_runs)), **rows}
