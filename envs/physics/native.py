"""C MuJoCo on a thread pool, called from inside a jitted program: the fastest backend on a CPU.

The engine's float64 state travels through JAX as its bits (`bits.py`), so nothing is lost between steps and nothing
hides in the engine: a step is a function of its arguments alone, and replays of a recorded run are exact.
"""

import contextlib
import dataclasses
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike
from mujoco.batch import SimulationError

from envs.physics.base import Data, Mocap
from envs.physics.bits import float64_bits
from envs.physics.engines import Engine, make_engine

_STATE_NAMES = frozenset({"qpos", "qvel"})
_DIVERGED = [
    int(warning)
    for warning in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
]


def usable_cpus() -> int:
    """CPUs this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class NativePhysics:
    """See `Physics`. Each control step of a whole vmapped batch is one host call.

    A simulation that diverges (MuJoCo would silently put it back to the model's initial state) gets NaN qpos and qvel.

    Args:
        model: any model; the engine's own solver and integrator are used as the model says.
        num_substeps: engine steps per control step.
        fields: derived `MjData` arrays for `Data.fields`. If there are any, `init` runs the engine's forward pass.
        track: `MjData` arrays for `Data.change`. Derived ones are compared with their value after the last control
            step, as gymnasium does, so they are carried along in the bits.
        refresh: whether a control step ends with a forward pass.
        num_threads: of one engine; None shares the usable CPUs among the local devices.
    """

    name = "native"

    def __init__(
        self,
        model: mujoco.MjModel,
        num_substeps: int,
        *,
        fields: Sequence[str] = (),
        track: Sequence[str] = (),
        refresh: bool = False,
        num_threads: int | None = None,
    ):
        self._model = model
        self._num_substeps = num_substeps
        self._last_stage = int(mujoco.mjtStage.mjSTAGE_ACC if refresh else mujoco.mjtStage.mjSTAGE_NONE)
        # Each of JAX's CPU devices runs its own simulations, side by side with the others.
        self._num_threads = num_threads or max(1, usable_cpus() // jax.local_device_count())
        self._lock = threading.Lock()
        self._idle_engines: dict[int, list[Engine]] = {}  # by number of simulations; a call holds one for itself
        self._fields, self._track = tuple(fields), tuple(track)
        self._derived = tuple(dict.fromkeys(n for n in (*fields, *track) if n not in _STATE_NAMES))
        template = mujoco.MjData(model)
        self._shapes = {n: np.shape(getattr(template, n)) for n in ("qpos", "qvel", *self._derived)}
        # The state's components up to the warm start, and the controls right behind them: all that the next step
        # reads beside mocap poses (no model here has applied forces).
        self._num_state = mujoco.mj_stateSize(
            model,
            int(mujoco.mjtState.mjSTATE_PHYSICS | mujoco.mjtState.mjSTATE_TIME | mujoco.mjtState.mjSTATE_WARMSTART),
        )
        self._state_columns = {"qpos": slice(1, 1 + model.nq), "qvel": slice(1 + model.nq, 1 + model.nq + model.nv)}
        tracked = [n for n in self._track if n not in _STATE_NAMES]
        self._tracked_columns, self._row_size = _columns(tracked, self._shapes, self._num_state)
        self._outputs, self._output_size = _columns(
            ["qpos", "qvel", *self._fields, *(f"change/{n}" for n in self._track)],
            self._shapes | {f"change/{n}": self._shapes[n] for n in self._track},
        )

    def init(self, qpos: ArrayLike, qvel: ArrayLike, mocap: Mocap | None = None) -> Data:
        """See `Physics.init`. Without derived arrays the engine is not called."""
        dtype = jnp.result_type(float)
        qpos, qvel = jnp.asarray(qpos, dtype), jnp.asarray(qvel, dtype)
        rest = jnp.zeros(self._row_size - 1 - self._model.nq - self._model.nv, dtype)
        bits = float64_bits(jnp.concatenate([jnp.zeros(1, dtype), qpos, qvel, rest]))
        if self._derived:
            return self._call(self._forward, bits, jnp.zeros(self._model.nu, dtype), mocap)
        change = {n: jnp.zeros(self._shapes[n], dtype) for n in self._track}
        return Data(qpos=qpos, qvel=qvel, fields={}, change=change, backend=bits)

    def step(self, data: Data, ctrl: ArrayLike, mocap: Mocap | None = None) -> Data:
        """See `Physics.step`."""
        return self._call(self._advance, data.backend, jnp.asarray(ctrl), mocap)

    def _call(self, function: Callable[..., None], bits: jax.Array, ctrl: jax.Array, mocap: Mocap | None) -> Data:
        shapes = (
            jax.ShapeDtypeStruct((2 * self._row_size,), jnp.uint32),
            jax.ShapeDtypeStruct((self._output_size,), jnp.result_type(float)),
        )
        poses = () if mocap is None else (mocap.quat.ravel(), mocap.pos.ravel())
        bits, values = host_call(function, shapes, bits, ctrl, *poses)

        def output(name: str, like: str) -> jax.Array:
            flat: jax.Array = values[self._outputs[name]]
            return flat.reshape(self._shapes[like])

        return Data(
            qpos=output("qpos", "qpos"),
            qvel=output("qvel", "qvel"),
            fields={n: output(n, n) for n in self._fields},
            change={n: output(f"change/{n}", n) for n in self._track},
            backend=bits,
        )

    @contextlib.contextmanager
    def _engine(self, num_sims: int) -> Iterator[Engine]:
        """An engine of that size that no other device's program is using."""
        with self._lock:
            idle = self._idle_engines.setdefault(num_sims, [])
            engine = idle.pop() if idle else None
        if engine is None:
            engine = make_engine(self._model, num_sims, min(self._num_threads, num_sims), self._derived)
        try:
            yield engine
        finally:
            with self._lock:
                idle.append(engine)

    # What follows runs on the host, inside a running JAX program: NumPy only, a JAX call could deadlock.

    def _advance(self, bits: np.ndarray, ctrl: np.ndarray, *poses_and_outputs: np.ndarray) -> None:
        *poses, bits_out, values_out = poses_and_outputs
        if not poses or poses[1].shape[1] == 3 * self._model.nmocap:
            calls = [_Call(poses, self._num_substeps, self._last_stage)]
        else:
            quat, path = poses
            stages = [0] * (self._num_substeps - 1) + [self._last_stage]
            places = np.split(path, self._num_substeps, axis=1)
            calls = [_Call([quat, pos], 1, stage) for pos, stage in zip(places, stages, strict=True)]
        self._run(calls, bits, ctrl, bits_out, values_out)

    def _forward(self, bits: np.ndarray, ctrl: np.ndarray, *poses_and_outputs: np.ndarray) -> None:
        *poses, bits_out, values_out = poses_and_outputs
        self._run([_Call(poses, 0)], bits, ctrl, bits_out, values_out)

    def _run(
        self,
        calls: Sequence["_Call"],
        bits: np.ndarray,
        ctrl: np.ndarray,
        bits_out: np.ndarray,
        values_out: np.ndarray,
    ) -> None:
        old, new = bits.view(np.float64), bits_out.view(np.float64)
        end = self._num_state
        failed = np.zeros(len(bits), bool)
        with self._engine(len(bits)) as engine:
            engine.state[:, :end] = old[:, :end]
            engine.state[:, end : end + ctrl.shape[1]] = ctrl
            for call in calls:
                failed |= call(engine)
            self._write(engine, old if calls[0].num_steps else None, new, values_out)
        if failed.any():
            new[failed], values_out[failed] = np.nan, np.nan

    def _write(self, engine: Engine, old: np.ndarray | None, new: np.ndarray, values: np.ndarray) -> None:
        """Copies the engine's state and outputs to the result rows. `old` None means that nothing has changed."""
        num_sims = len(new)
        new[:, : self._num_state] = engine.state[:, : self._num_state]
        for name, columns in self._tracked_columns.items():
            new[:, columns] = engine.bind(name).reshape(num_sims, -1)
        for name, columns in self._state_columns.items():
            values[:, self._outputs[name]] = new[:, columns]
        for name in self._fields:
            values[:, self._outputs[name]] = engine.bind(name).reshape(num_sims, -1)
        for name in self._track:
            columns = (self._state_columns | self._tracked_columns)[name]
            values[:, self._outputs[f"change/{name}"]] = 0 if old is None else new[:, columns] - old[:, columns]


def host_call(function: Callable[..., None], shapes: Any, *args: jax.Array) -> Any:
    """Calls `function(*args, *outputs)` on 2-D NumPy arrays `[num_sims, size]`, all vmapped axes flattened to one.

    On the CPU the outputs are written in place into JAX's own buffers; this reaches about 85 % of the raw engine's
    rate at 16 simulations, where `jax.pure_callback`, used elsewhere, reaches 45 %.
    """

    def rows(array: Any) -> np.ndarray:
        flat: np.ndarray = np.asarray(array)
        return flat.reshape(-1, flat.shape[-1])

    def in_place(_: Any, outputs: Any, *inputs: Any) -> None:
        function(*map(rows, inputs), *map(rows, outputs))

    def by_value(*inputs: Any) -> Any:
        lead = np.shape(inputs[0])[:-1]
        outputs = tuple(np.empty((*lead, *s.shape), s.dtype) for s in shapes)
        function(*map(rows, inputs), *map(rows, outputs))
        return outputs

    if jax.default_backend() == "cpu":
        from jax.experimental.buffer_callback import buffer_callback

        return buffer_callback(in_place, shapes, vmap_method="broadcast_all")(*args)
    return jax.pure_callback(by_value, shapes, *args, vmap_method="broadcast_all")


@dataclasses.dataclass(frozen=True)
class _Call:
    """Some engine steps with the mocap bodies standing still, or none and the forward pass."""

    poses: Sequence[np.ndarray]  # quat [num_sims, 4 num_mocap] and pos [num_sims, 3 num_mocap], or nothing
    num_steps: int
    stage: int = 0

    def __call__(self, engine: Engine) -> np.ndarray | bool:
        """Which simulations diverged or raised, `[num_sims]`; False if none did."""
        for name, values in zip(("mocap_quat", "mocap_pos"), self.poses, strict=False):
            target = engine.bind(name)
            target[...] = values.reshape(target.shape)
        failed: np.ndarray | bool = False
        try:
            if self.num_steps:
                engine.step(nstep=self.num_steps, stage=self.stage)
            else:
                engine.forward()
        except SimulationError:
            failed = engine.status != 0
        if engine.warning.any():  # rare, and cheaper to ask than to select the kinds each time
            failed |= np.asarray(engine.warning[:, _DIVERGED, 1].any(axis=1))
            engine.warning[...] = 0
        return failed


def _columns(names: Sequence[str], shapes: dict[str, Any], start: int = 0) -> tuple[dict[str, slice], int]:
    """Consecutive column ranges for arrays of the given shapes, and where they end."""
    columns = {}
    for name in names:
        size = int(np.prod(shapes[name], dtype=int))
        columns[name] = slice(start, start + size)
        start += size
    return columns, start
