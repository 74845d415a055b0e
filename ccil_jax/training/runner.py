"""Trainings: from a configuration, an environment and demonstrations to trained policies, in memory or on disk."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ccil_jax.acting.rollout import Actor
from ccil_jax.agents.build import resolve
from ccil_jax.agents.expert import expert_of
from ccil_jax.config import Config, field_names
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.earlier_versions import GONE
from ccil_jax.errors import CheckpointError, ConfigError
from ccil_jax.training import filesystem, loop
from ccil_jax.training.checkpointing import Checkpointer
from ccil_jax.training.combining import columns, join
from ccil_jax.training.guard import GuardedState
from ccil_jax.training.loop import History, Progress, Snapshot
from ccil_jax.training.manifests import Identity, identity_of
from ccil_jax.training.program import Program, compile_program, guarded_agent
from ccil_jax.training.progress import Display
from ccil_jax.training.settings import Settings
from ccil_jax.types import ExpertData, ExpertTransitions
from envs.base import Environment


@dataclasses.dataclass(frozen=True, kw_only=True)
class Result:
    """A run that is finished or was stopped: `num_seeds` seeds of one configuration."""

    config: Config  # as resolved: the cost limit is set, from the demonstrations where the method says so
    identity: Identity  # which training this is
    metrics: History  # [iterations, num_seeds] each; {} before the first iteration
    state: GuardedState  # [num_seeds]-leading
    env_steps: int  # per seed
    compile_seconds: float
    wall_seconds: float  # of this call, compilation included
    stopped: np.ndarray  # [num_seeds] bool: seeds that were given up, see `guard.protect`

    @property
    def actor(self) -> Actor:
        """The policies and their observation statistics, [num_seeds]-leading, on one device."""
        return jax.device_put(self.state.actor, jax.local_devices()[0])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Loaded:
    """Trained policies from disk."""

    config: Config
    actor: Actor  # [num_seeds]-leading
    env_steps: int  # of each seed so far


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
    verbose: bool = False,
    on_start: Callable[[History], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    stop_after: int | None = None,
) -> Result:
    """Trains `config.method` with `num_seeds` seeds in one vmapped program.

    Args:
        config: hyperparameters; the cost limit is taken from the demonstrations where the method says so.
        env: one environment, unbatched.
        demonstrations: needed by the methods that imitate.
        num_seeds: S.
        seed: of the S random keys; the same seed and S give the same bits on the same machine.
        one_by_one: each device carries out its seeds one after the other. Then the bits of a seed depend neither on how
            many seeds there are nor on how many devices.
        checkpoint_dir: where checkpoints of the whole state are saved, about once a minute and at the end.
        resume: go on from the newest intact checkpoint in `checkpoint_dir`, which must be of the same training; begin
            anew where there is none. Without it, a folder that holds checkpoints is refused.
        moved: names of traced fields that may differ from those of the training that is resumed.
        verbose: show the progress on standard error: a live bar on a terminal, else a line about every ten seconds.
        on_start: is called once, before the first iteration, with the metrics of iterations that were done earlier.
        on_progress: is called after every chunk of iterations.
        should_stop: is asked after every chunk. Once it returns true, the state is saved and the result returned.
        stop_after: stop once this many iterations are done in all, to be resumed later; 0 takes no step at all.

    Raises:
        ConfigError: options, environment and demonstrations do not fit together.
        CheckpointError: the checkpoints are damaged, are of another training, or cannot be written.
        LockedError: another process uses `checkpoint_dir`.
        DemonstrationsError: an episode of the demonstrations is longer than the environment's.
    """
    (result,) = train_runs(
        [config],
        env,
        demonstrations,
        num_seeds=num_seeds,
        seed=seed,
        one_by_one=one_by_one,
        checkpoint_dir=checkpoint_dir,
        resume=resume,
        moved=moved,
        verbose=verbose,
        on_start=on_start,
        on_progress=on_progress,
        should_stop=should_stop,
        stop_after=stop_after,
    )
    return result


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
    verbose: bool = False,
    on_start: Callable[[History], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    stop_after: int | None = None,
) -> list[Result]:
    """Trains several configurations that differ in traced fields alone, each with the same seeds, in one program.

    The program has [len(configs) * num_seeds] runs, configuration by configuration. This is the order of the columns
    that `on_progress` sees and of the states in a checkpoint. Everything else is as in `train`.

    Returns:
        One result for each configuration.

    Raises:
        ConfigError: also where the configurations differ in a static field.
    """
    settings = Settings(
        num_seeds=num_seeds,
        seed=seed,
        one_by_one=one_by_one,
        checkpoint_dir=checkpoint_dir,
        resume=resume,
        moved=moved,
        verbose=verbose,
        on_start=on_start,
        on_progress=on_progress,
        should_stop=should_stop,
        stop_after=stop_after,
    )
    return _train(configs, env, demonstrations, settings)


@jax.transfer_guard("allow")  # arrays travel between host and device before and after the compiled program on purpose
def _train(
    configs: Sequence[Config], env: Environment, demonstrations: Demonstrations | None, settings: Settings
) -> list[Result]:
    """Checks everything, opens what is written to, compiles, begins or restores, goes on to the end."""
    start = time.perf_counter()
    if not configs:
        raise ConfigError("configs: give at least one configuration")
    configs = [resolve(config, env, demonstrations) for config in configs]
    shared, varied = join(configs, settings.num_seeds)
    identity = identity_of(configs, env, demonstrations, settings.num_seeds, settings.seed)
    with contextlib.ExitStack() as stack:
        checkpoints = stack.enter_context(_opened_checkpoints(settings, identity))
        found = None if checkpoints is None else _step_to_resume(checkpoints, shared, settings)
        observers = [] if settings.on_progress is None else [settings.on_progress]
        if settings.verbose:
            observers.append(stack.enter_context(_display(configs, env)).update)
        program = compile_program(
            shared,
            env,
            expert_of(shared, env, demonstrations),
            len(configs) * settings.num_seeds,
            varied=varied,
            one_by_one=settings.one_by_one,
        )
        if checkpoints is None or found is None:
            snapshot = _first(program, shared, settings, len(configs))
        else:
            snapshot = _restored(checkpoints, found, program, shared)
        if settings.on_start:
            settings.on_start(snapshot.history)
        last = shared.num_iterations
        snapshot = loop.go_on(
            program,
            shared,
            snapshot,
            last if settings.stop_after is None else min(settings.stop_after, last),
            checkpoints=checkpoints,
            observers=observers,
            should_stop=settings.should_stop,
        )
    return _results(configs, identity, snapshot, program.compile_seconds, time.perf_counter() - start)


@contextlib.contextmanager
def _opened_checkpoints(settings: Settings, identity: Identity) -> Iterator[Checkpointer | None]:
    """The checkpoints in `checkpoint_dir`, locked against other processes; None where there is no such folder."""
    if settings.checkpoint_dir is None:
        yield None
        return
    folder = Path(settings.checkpoint_dir)
    with (
        filesystem.hold(folder / ".writer.lock"),
        Checkpointer(folder, identity, free=frozenset(settings.moved)) as checkpoints,
    ):
        yield checkpoints


def _step_to_resume(checkpoints: Checkpointer, config: Config, settings: Settings) -> int | None:
    """The newest intact step, or None to begin anew. It is checked here, because compiling takes long."""
    if not settings.resume:
        checkpoints.check_empty()
        return None
    step = checkpoints.latest_step()
    if step is None:
        return None
    checkpoints.check_identity(step)
    if step > config.num_iterations:
        raise ConfigError(
            f"env_steps {config.env_steps}: the training in {settings.checkpoint_dir} has done "
            f"{step * config.steps_per_iteration}; give at least as many"
        )
    return step


def _display(configs: Sequence[Config], env: Environment) -> Display:
    """Shows the means over all runs, and the cost limit where all configurations have the same."""
    first = configs[0]
    same_limit = all(config.cost_limit == first.cost_limit for config in configs)
    return Display(
        f"{first.method} {env.name}",
        first.num_iterations,
        first.cost_limit if same_limit else None,
        has_multiplier=first.has_multiplier,
    )


def _first(program: Program, config: Config, settings: Settings, num_configs: int) -> Snapshot:
    """The runs before their first iteration. Every configuration has the same keys, one for each seed."""
    keys = jnp.tile(jax.random.split(jax.random.key(settings.seed), settings.num_seeds), num_configs)
    return loop.snapshot_of(config, 0, program.init(keys), {})


def _restored(checkpoints: Checkpointer, step: int, program: Program, config: Config) -> Snapshot:
    """The runs as they were saved."""
    state, history = _restore(checkpoints, step, program)
    if not config.has_multiplier:
        history.pop("multiplier", None)  # an earlier version logged 0 for methods that have none
    return loop.snapshot_of(config, step, state, history)


def _restore(checkpoints: Checkpointer, step: int, program: Program) -> tuple[GuardedState, History]:
    like = {"state": program.state, "history": checkpoints.structure(step)["history"]}
    saved = checkpoints.restore(step, like)
    return saved["state"], saved["history"]


def _results(
    configs: Sequence[Config], identity: Identity, snapshot: Snapshot, compile_seconds: float, wall_seconds: float
) -> list[Result]:
    """The last snapshot, cut into the results of the configurations."""
    num_seeds = len(snapshot.stopped) // len(configs)
    return [
        Result(
            config=config,
            identity=dataclasses.replace(identity, configs=(config,)),
            metrics={name: rows[:, own] for name, rows in snapshot.history.items()},
            state=jax.tree.map(lambda leaf, own=own: leaf[own], snapshot.state) if len(configs) > 1 else snapshot.state,
            env_steps=snapshot.iteration * config.steps_per_iteration,
            compile_seconds=compile_seconds,
            wall_seconds=wall_seconds,
            stopped=snapshot.stopped[own],
        )
        for config, own in zip(configs, columns(len(configs), num_seeds), strict=True)
    ]


@jax.transfer_guard("allow")
def save(result: Result, directory: Path) -> None:
    """Writes a run of `train_runs` as a checkpoint of its own; the program's checkpoint holds all runs together.

    What another training has left in `directory` is set aside.

    Raises:
        ConfigError: the run has taken no step.
        CheckpointError: the checkpoint cannot be written.
    """
    if not result.metrics:
        raise ConfigError(f"{directory}: nothing to save, as no iteration was carried out")
    with Checkpointer(directory, result.identity) as checkpoints:
        checkpoints.replace(len(result.metrics["env_steps"]), {"state": result.state, "history": result.metrics})


@jax.transfer_guard("allow")
def load(config: Config, env: Environment, checkpoint_dir: Path, num_seeds: int) -> Loaded:
    """The policies of the newest checkpoint in `checkpoint_dir`. Demonstrations are not needed.

    Raises:
        CheckpointError: there is no intact checkpoint, or it is another training's.
    """
    # Traced fields do not matter for acting, and those that are resolved from the demonstrations may not be known
    # without them. Nor does it matter how an earlier version counted the length of a training.
    config = config.replace(**{name: 0.0 for name in field_names(traced=True) if getattr(config, name) is None})
    identity, free = Identity(configs=(config,), num_seeds=num_seeds), frozenset({*field_names(traced=True), *GONE})
    with Checkpointer(checkpoint_dir, identity, free=free, readonly=True) as checkpoints:
        step = checkpoints.latest_step()
        if step is None:
            raise CheckpointError(f"{checkpoint_dir}: holds no finished checkpoint; train first, or continue the run")
        like = {
            "state": _structure_of_state(config, env, num_seeds),
            "history": checkpoints.structure(step)["history"],
        }
        saved = checkpoints.restore(step, like)
    return Loaded(config=config, actor=saved["state"].actor, env_steps=step * config.steps_per_iteration)


def _structure_of_state(config: Config, env: Environment, num_seeds: int) -> GuardedState:
    """Shapes and dtypes of a run's state, on one device. Nothing is computed."""
    obs, action = jnp.zeros((1, env.obs_dim)), jnp.zeros((1, env.action_dim))
    transitions = ExpertTransitions(obs=obs, action=action, next_obs=obs, terminated=jnp.zeros(1), initial_obs=obs)
    expert = ExpertData(  # in place of demonstrations: a state depends only on their number of columns
        obs=obs, action=action, held_out_obs=obs, held_out_action=action, transitions=transitions
    )

    def init(key: jax.Array) -> GuardedState:
        return jax.vmap(guarded_agent(config, env, expert).init)(jax.random.split(key, num_seeds))

    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=device),
        jax.eval_shape(init, jax.random.key(0)),
    )
