"""C MuJoCo as a function of a jitted program: what the foreign functions must know of a model, and their calls."""

import copy
import ctypes
import dataclasses
import functools
import hashlib
import sys
import threading
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics import foreign

# Arrays that MuJoCo fills only on demand, by `mj_rnePostConstraint`, which batches do not call themselves.
POST_CONSTRAINT = frozenset({"cacc", "cfrc_int", "cfrc_ext"})
STATE = -1  # as the source of a `Copy`: the state, not a derived array

_INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_DIVERGED = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)


@dataclasses.dataclass(frozen=True)
class Copy:
    """Numbers that a call copies: some columns of the state or a whole derived array, and where they are written."""

    source: int  # index of the derived array, or `STATE`
    start: int  # the first column that is copied, if the source is the state
    size: int  # how many numbers
    into_row: bool  # true: written into the engine's own row; false: into the outputs
    target: int  # the first column that is written there
    change: int = -1  # if not negative: the old row, from this column on, is subtracted from what is written


class Engine:
    """Steps any number of simulations of one model, inside a jitted program.

    On a CPU the program calls C directly. A program on an accelerator calls back to its host, which does the same.
    Between two calls a simulation is a *row* of float64 numbers: the state, then the derived arrays that are tracked.

    Args:
        model: the compiled model; it is copied.
        num_threads: threads of one call.
        num_substeps: engine steps per call of `step`.
        last_stage: after the substeps the forward pass is carried out up to this `mjtStage`; 0 for no forward pass.
        num_state: how many columns of a row are the state: the components of `mjtState` up to the warm start.
        row_size: columns of a row, the state and the tracked arrays together.
        output_size: columns of the outputs.
        derived: names of the `MjData` arrays that copies read.
        copies: what is written where; all other columns are undefined.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        num_threads: int,
        num_substeps: int,
        last_stage: int,
        num_state: int,
        row_size: int,
        output_size: int,
        derived: Sequence[str],
        copies: Sequence[Copy],
    ) -> None:
        self._sizes = row_size, output_size
        facts = (num_threads, num_substeps, last_stage, num_state, row_size, output_size, *derived, *copies)
        self._key = _digest(model, facts)
        with _lock_of_engines:
            if self._key in _known:
                return
            model = copy.copy(model)
            located, tables = _tables_of(model, derived, copies)
            fields = {
                foreign.THREADS: num_threads,
                foreign.NUM_STATE: num_state,
                foreign.ROW: row_size,
                foreign.OUTPUT: output_size,
                foreign.NUM_SUBSTEPS: num_substeps,
                foreign.LAST_STAGE: last_stage,
                **_numbers_of(model),
                **located,
            }
            engine = np.zeros(foreign.ENGINE_SIZE, np.int64)
            ctypes.CDLL(None).pthread_mutex_init(ctypes.c_void_p(engine.ctypes.data), None)
            for field, value in fields.items():
                engine[field] = value
            engine[foreign.DIVERGED :] = [int(reason) for reason in _DIVERGED]
            _enter(self._key, engine, (model, tables))

    def step(self, bits: jax.Array, ctrl: jax.Array, *poses: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Advances one control step; vmapped, all simulations together.

        Args:
            bits: [2 row_size] uint32, the bits of the row.
            ctrl: [nu].
            poses: of the mocap bodies: nothing where there are none; otherwise the quaternions [4 nmocap], and the
                positions [3 nmocap], or [num_substeps 3 nmocap] where they differ from substep to substep.

        Returns:
            The bits of the new row and the outputs [output_size]. Both are NaN where the simulation diverged or MuJoCo
            raised an error.
        """
        return self._call(foreign.STEP, bits, ctrl, *poses)

    def forward(self, bits: jax.Array, ctrl: jax.Array, *poses: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Carries out the forward pass alone. Arguments and results are those of `step`."""
        return self._call(foreign.FORWARD, bits, ctrl, *poses)

    def _call(self, name: str, bits: jax.Array, *inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        dtype = jnp.result_type(float)
        row_size, output_size = self._sizes
        shapes = jax.ShapeDtypeStruct((2 * row_size,), jnp.uint32), jax.ShapeDtypeStruct((output_size,), dtype)
        arguments = (bits, *(jnp.asarray(x, dtype) for x in inputs))
        if jax.default_backend() == "cpu":
            _register()
            call = jax.ffi.ffi_call(name, shapes, vmap_method="broadcast_all")
            new, values = call(*arguments, key=np.int64(self._key))
            return new, values
        host = functools.partial(self._on_host, name == foreign.FORWARD)
        return jax.pure_callback(host, shapes, *arguments, vmap_method="broadcast_all")

    def _on_host(self, forward: bool, *arguments: Any) -> tuple[np.ndarray, np.ndarray]:
        """Does what the foreign functions do, on NumPy arrays of the host."""
        old, ctrl, *poses = [np.ascontiguousarray(x) for x in arguments]
        lead, (row_size, output_size) = old.shape[:-1], self._sizes
        new = np.empty((*lead, 2 * row_size), np.uint32)
        values = np.empty((*lead, output_size), ctrl.dtype)
        num_sims = int(np.prod(lead, dtype=int))
        num_places = poses[1].size // (3 * poses[0].size // 4) if poses else 0
        quat, pos = [x.ctypes.data for x in poses] or [0, 0]
        engine = _known[self._key][0].ctypes.data
        wide = ctrl.dtype == np.float64
        foreign.run(
            engine,
            forward,
            num_sims,
            old.ctypes.data,
            ctrl.ctypes.data,
            quat,
            pos,
            num_places,
            new.ctypes.data,
            values.ctypes.data,
            wide,
        )
        return new, values


_lock_of_engines = threading.Lock()
_known: dict[int, tuple[np.ndarray, Any]] = {}  # every engine of this process with the objects that it points to


def _digest(model: mujoco.MjModel, facts: Sequence[Any]) -> int:
    """A number by which an engine is known: the same for the same model and facts, in every process."""
    serialized = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, serialized)
    digest = hashlib.sha256(repr(facts).encode() + serialized.tobytes()).digest()
    return int.from_bytes(digest[:7], "little")


def _numbers_of(model: mujoco.MjModel) -> dict[int, int]:
    """Fields of an engine that follow from the model and from MuJoCo."""
    return {
        foreign.MODEL: model._address,
        foreign.NUM_CTRL: model.nu,
        foreign.NUM_MOCAP: model.nmocap,
        foreign.CTRL: _column(model, mujoco.mjtState.mjSTATE_CTRL),
        foreign.QUAT: _column(model, mujoco.mjtState.mjSTATE_MOCAP_QUAT),
        foreign.POS: _column(model, mujoco.mjtState.mjSTATE_MOCAP_POS),
        foreign.ADVANCE: foreign.advance_one.address,
        foreign.ACC: int(mujoco.mjtStage.mjSTAGE_ACC),
        foreign.NUM_WARNINGS: int(mujoco.mjtWarning.mjNWARNING),
    }


def _tables_of(
    model: mujoco.MjModel, derived: Sequence[str], copies: Sequence[Copy]
) -> tuple[dict[int, int], Sequence[Any]]:
    """Fields of an engine that say how long its tables are and where they lie, and the tables, which must live on."""
    names = [ctypes.create_string_buffer(name.encode()) for name in derived]
    arrays = np.array(
        [
            (ctypes.addressof(names[i]), *where, derived[i] in POST_CONSTRAINT)
            for i, where in enumerate(_locate(model, derived))
        ],
        np.int64,
    )
    copy_table = np.array([dataclasses.astuple(one) for one in copies], np.int64)
    pool = np.zeros((foreign.POOL_SIZE, foreign.DERIVED + len(derived)), np.int64)
    fields = {
        foreign.POST: bool(POST_CONSTRAINT.intersection(derived)),
        foreign.NUM_DERIVED: len(derived),
        foreign.ARRAYS: arrays.ctypes.data,
        foreign.NUM_COPIES: len(copies),
        foreign.COPIES: copy_table.ctypes.data,
        foreign.POOL: pool.ctypes.data,
    }
    return fields, (names, arrays, copy_table, pool)


def _enter(key: int, engine: np.ndarray, kept: Any) -> None:
    """Enters an engine into the table, for good: a compiled program knows its key and may outlive the environment."""
    count = len(_known)
    if count == foreign.TABLE_SIZE:
        raise RuntimeError(
            f"more than {foreign.TABLE_SIZE} different physics in one process; make fewer, as all are kept"
        )
    _known[key] = engine, kept
    foreign.engines[1 + 2 * count : 3 + 2 * count] = key, engine.ctypes.data
    foreign.engines[0] = count + 1


@functools.cache
def _register() -> None:
    """Makes the foreign functions known to XLA."""
    for name, function in ((foreign.STEP, foreign.on_step), (foreign.FORWARD, foreign.on_forward)):
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(function.ctypes), platform="cpu")


def _column(model: mujoco.MjModel, component: mujoco.mjtState) -> int:
    """The first column of a component in a row of the integration state, whose order is that of the bits."""
    return mujoco.mj_stateSize(model, _INTEGRATION & (int(component) - 1))


def _locate(model: mujoco.MjModel, names: Sequence[str]) -> list[tuple[int, int]]:
    """For each array: where in C's mjData the pointer to it is, counted in words of 8 bytes, and the array's length.

    Python does not know the layout of that structure. So it is searched for the array's address.
    """
    data = mujoco.MjData(model)
    measure = getattr(ctypes.CDLL(None), "malloc_size" if sys.platform == "darwin" else "malloc_usable_size")
    measure.argtypes, measure.restype = [ctypes.c_void_p], ctypes.c_size_t
    words = np.ctypeslib.as_array((ctypes.c_int64 * (measure(data._address) // 8)).from_address(data._address))
    arrays = [getattr(data, name) for name in names]
    # Empty arrays that come before it have the same address, so the last place is the right one.
    return [(int(np.flatnonzero(words == array.ctypes.data)[-1]), array.size) for array in arrays]
