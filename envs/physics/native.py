"""C MuJoCo on a thread pool, called from inside a jitted program: the fastest engine on a CPU.

JAX carries the engine's float64 state from step to step as bits (`bits.py`). So nothing is lost between steps, and the
engine remembers nothing: a step is a function of its arguments alone, and a recorded run can be repeated exactly.
"""

import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from envs.physics.base import Data, Mocap
from envs.physics.bits import float64_bits
from envs.physics.engine import STATE, Copy, Engine

_STATE_NAMES = frozenset({"qpos", "qvel"})


def usable_cpus() -> int:
    """CPUs this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class NativePhysics:
    """See `Physics`. Each control step of a whole vmapped batch is one call of C.

    A simulation that diverges gets the values NaN in qpos and qvel. (MuJoCo itself would silently put it back to the
    model's initial state.)

    Args:
        model: any model; the engine's own solver and integrator are used as the model says.
        num_substeps: engine steps per control step.
        fields: derived `MjData` arrays for `Data.fields`. If there are any, `init` runs the engine's forward pass.
        track: `MjData` arrays for `Data.change`. The change of a derived array counts from its value after the last
            control step, as in gymnasium, so this value is carried along in the bits.
        refresh: whether a control step ends with a forward pass.
        num_threads: threads of a call; None shares the usable CPUs among JAX's local devices.
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
        self._fields, self._track = tuple(fields), tuple(track)
        self._derived = tuple(dict.fromkeys(n for n in (*fields, *track) if n not in _STATE_NAMES))
        template = mujoco.MjData(model)
        self._shapes = {n: np.shape(getattr(template, n)) for n in ("qpos", "qvel", *self._derived)}
        # The components of the state up to the warm start. They, the controls and the mocap poses are all that the next
        # step reads, as no model here has applied forces.
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
        self._engine = Engine(
            model,
            # JAX's CPU devices run at the same time, each with its own simulations, so they share the CPUs.
            num_threads=num_threads or max(1, usable_cpus() // jax.local_device_count()),
            num_substeps=num_substeps,
            last_stage=int(mujoco.mjtStage.mjSTAGE_ACC if refresh else mujoco.mjtStage.mjSTAGE_NONE),
            num_state=self._num_state,
            row_size=self._row_size,
            output_size=self._output_size,
            derived=self._derived,
            copies=self._copies(),
        )

    def init(self, qpos: ArrayLike, qvel: ArrayLike, mocap: Mocap | None = None) -> Data:
        """See `Physics.init`. Without derived arrays the engine is not called."""
        dtype = jnp.result_type(float)
        qpos, qvel = jnp.asarray(qpos, dtype), jnp.asarray(qvel, dtype)
        rest = jnp.zeros(self._row_size - 1 - self._model.nq - self._model.nv, dtype)
        bits = float64_bits(jnp.concatenate([jnp.zeros(1, dtype), qpos, qvel, rest]))
        if self._derived:
            return self._call(self._engine.forward, bits, jnp.zeros(self._model.nu, dtype), mocap)
        change = {n: jnp.zeros(self._shapes[n], dtype) for n in self._track}
        return Data(qpos=qpos, qvel=qvel, fields={}, change=change, backend=bits)

    def step(self, data: Data, ctrl: ArrayLike, mocap: Mocap | None = None) -> Data:
        """See `Physics.step`."""
        return self._call(self._engine.step, data.backend, jnp.asarray(ctrl), mocap)

    def _call(
        self,
        call: Callable[..., tuple[jax.Array, jax.Array]],
        bits: jax.Array,
        ctrl: jax.Array,
        mocap: Mocap | None,
    ) -> Data:
        poses = () if mocap is None else (mocap.quat.ravel(), mocap.pos.ravel())
        bits, values = call(bits, ctrl, *poses)

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

    def _copies(self) -> list[Copy]:
        """What the engine writes: the tracked arrays into its row, behind the state, and then the outputs."""
        copies = []
        for name, columns in self._tracked_columns.items():
            source, size = self._derived.index(name), columns.stop - columns.start
            copies.append(Copy(source=source, start=0, size=size, into_row=True, target=columns.start))
        for name, columns in self._outputs.items():
            array = name.removeprefix("change/")
            within = (self._state_columns | self._tracked_columns).get(array)
            copies.append(
                Copy(
                    source=STATE if array in _STATE_NAMES else self._derived.index(array),
                    start=within.start if within and array in _STATE_NAMES else 0,
                    size=columns.stop - columns.start,
                    into_row=False,
                    target=columns.start,
                    change=within.start if within and name.startswith("change/") else -1,
                )
            )
        return copies


def _columns(names: Sequence[str], shapes: dict[str, Any], start: int = 0) -> tuple[dict[str, slice], int]:
    """Consecutive column ranges for arrays of the given shapes, and where they end."""
    columns = {}
    for name in names:
        size = int(np.prod(shapes[name], dtype=int))
        columns[name] = slice(start, start + size)
        start += size
    return columns, start
