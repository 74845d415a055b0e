"""Batches of C MuJoCo simulations, called by XLA itself through functions that Numba compiles.

No Python runs between the two: a callback would hold the interpreter's lock, for which the programs of several devices
queue, and JAX keeps no program with a callback in its compilation cache. The functions read XLA's C structures
(`xla/ffi/api/c_api.h`, version 0.3) and call those of `mujoco/mjbatch.h` by name, so that their code is the same in
every process. What is not, the address of an engine, stands in a table under the hash of what the engine does.
"""

import copy
import ctypes
import dataclasses
import functools
import hashlib
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import llvmlite.binding
import mujoco
import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

# Arrays that MuJoCo fills only on demand, by `mj_rnePostConstraint`, which batches do not call themselves.
POST_CONSTRAINT = frozenset({"cacc", "cfrc_int", "cfrc_ext"})
STATE = -1  # as the source of a `Copy`: the state, not a derived array

_STEP, _FORWARD = "ccil_jax_mujoco_step", "ccil_jax_mujoco_forward"
_INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_TABLE_SIZE = 4096  # engines in one process
_POOL_SIZE = 64  # batches that an engine keeps, of all sizes together: more than any machine's devices need at once
_NUM_REASONS = 3

# Where an engine keeps what: 64 bytes for the mutex, then an int64 each.
_MUTEX = 0
_MODEL, _THREADS, _NUM_STATE, _ROW, _OUTPUT, _NUM_CTRL, _NUM_MOCAP, _NUM_SUBSTEPS, _LAST_STAGE = range(8, 17)
_POST, _CTRL, _QUAT, _POS, _NUM_DERIVED, _ARRAYS, _NUM_COPIES, _COPIES, _POOL, _ADVANCE = range(17, 27)
_ACC, _NUM_WARNINGS, _DIVERGED = range(27, 30)
_ENGINE_SIZE = _DIVERGED + _NUM_REASONS
# An entry of its pool; the addresses of the derived arrays follow.
_NUM_SIMS, _BATCH, _BUSY, _CONFIG, _NUM_STEPS, _STAGE, _OWNER, _DERIVED = range(8)
# A derived array: the address of its name, where an mjData has the pointer to it (in 8 bytes), how long it is, and
# whether the forward pass leaves it out.
_NAME, _OFFSET, _LENGTH, _UNKNOWN, _ARRAY_SIZE = range(5)

_address, _int, _nothing = types.intp, types.int32, types.void


def _foreign(name: str, result: Any, *arguments: Any) -> Any:
    """A function of C, found by its name."""
    return types.ExternalFunction(name, result(*arguments))


_make_batch = _foreign("mjb_makeBatch", _address, _address, _int, _address, _address, _int)
_delete_batch = _foreign("mjb_deleteBatch", _nothing, _address)
_output = _foreign("mjb_output", _address, _address, _address, _address, _address)
_state = _foreign("mjb_state", _address, _address)
_num_columns = _foreign("mjb_nstate", _int, _address)
_status = _foreign("mjb_status", _address, _address)
_warning = _foreign("mjb_warning", _address, _address)
_step = _foreign("mjb_step", _int, _address, _address, _int, _int, _int)
_forward = _foreign("mjb_forward", _int, _address, _address, _int, _int)
_apply = _foreign("mjb_apply", _int, _address, _address, _int, _address, _address, _int)
_mj_step = _foreign("mj_step", _nothing, _address, _address)
_mj_forward = _foreign("mj_forward", _nothing, _address, _address)
_mj_post_constraint = _foreign("mj_rnePostConstraint", _nothing, _address, _address)
_lock = _foreign("pthread_mutex_lock", _int, _address)
_unlock = _foreign("pthread_mutex_unlock", _int, _address)
_table = _foreign("ccil_jax_engines", _address)

# Decorating compiles, and then the names have to be known.
llvmlite.binding.load_library_permanently(str(next(Path(mujoco.__file__).parent.glob("libmujoco.*"))))
_engines = np.zeros(1 + 2 * _TABLE_SIZE, np.int64)  # how many, then key and address of each
_address_of_engines = _engines.ctypes.data


def _get_engines() -> Any:
    return _address_of_engines


_getter: Any = numba.cfunc(types.intp())(_get_engines)
llvmlite.binding.add_symbol("ccil_jax_engines", _getter.address)

_Function = TypeVar("_Function", bound=Callable[..., Any])


def _compiled(function: _Function) -> _Function:
    compiled: Any = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return compiled


def _called_by_c(signature: Any) -> Callable[[Callable[..., Any]], Any]:
    decorate: Any = numba.cfunc(signature, cache=True)
    return decorate


def _cast(dtype: Any) -> Any:
    """From an address to a pointer, which is indexed like an array."""

    @intrinsic
    def cast(context: Any, address: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return types.CPointer(dtype)(types.intp), codegen

    return cast


_int64s, _int32s = _cast(types.int64), _cast(types.int32)
_doubles, _floats = _cast(types.float64), _cast(types.float32)


@_compiled
def _get(address: Any, index: Any, wide: Any) -> Any:
    return _doubles(address)[index] if wide else float(_floats(address)[index])


@_compiled
def _put(address: Any, index: Any, value: Any, wide: Any) -> None:
    if wide:
        _doubles(address)[index] = value
    else:
        _floats(address)[index] = value


@_compiled
def _acquire(engine: Any, num_sims: Any) -> Any:
    """A batch of that size that no other program is using, as the address of its entry; 0 if there can be none."""
    own = _int64s(engine)
    width = _DERIVED + own[_NUM_DERIVED]
    found, replaced = 0, 0
    _lock(engine)
    for i in range(_POOL_SIZE):
        entry = own[_POOL] + 8 * width * i
        fields = _int64s(entry)
        if fields[_BUSY] == 0 and (fields[_NUM_SIMS] == num_sims or fields[_NUM_SIMS] == 0):
            found = entry
            break
        if fields[_BUSY] == 0 and replaced == 0:
            replaced = entry
    if found == 0:
        found = replaced
    if found != 0:
        _int64s(found)[_BUSY] = 1
    _unlock(engine)
    if found == 0:
        return found
    fields = _int64s(found)
    if fields[_NUM_SIMS] != num_sims and fields[_BATCH] != 0:
        _delete_batch(fields[_BATCH])
        fields[_BATCH] = 0
    fields[_NUM_SIMS] = num_sims
    if fields[_BATCH] == 0:
        fields[_CONFIG] = min(own[_THREADS], num_sims)  # an mjBatchConfig: the number of threads, then a zero
        fields[_BATCH] = _make_batch(own[_MODEL], num_sims, found + 8 * _CONFIG, 0, 0)
        for i in range(own[_NUM_DERIVED]):
            # Asked for before the first call: an array is filled by later calls alone.
            name = _int64s(own[_ARRAYS])[_ARRAY_SIZE * i + _NAME]
            fields[_DERIVED + i] = _output(fields[_BATCH], name, 0, 0)
    return found


@_compiled
def _release(engine: Any, entry: Any) -> None:
    _lock(engine)
    _int64s(entry)[_BUSY] = 0
    _unlock(engine)


@_called_by_c(_nothing(_address, _address, _int, _address))
def _advance_one(model: Any, data: Any, sim: Any, entry: Any) -> None:
    """One simulation's steps and derived arrays with contact forces, on a thread of the batch: an `mjfBatchFunc`."""
    fields = _int64s(entry)
    for _ in range(fields[_NUM_STEPS]):
        _mj_step(model, data)
    if fields[_STAGE] != 0:
        _mj_forward(model, data)
    _mj_post_constraint(model, data)
    own = _int64s(fields[_OWNER])
    for k in range(own[_NUM_DERIVED]):
        array = _int64s(own[_ARRAYS] + 8 * _ARRAY_SIZE * k)
        source, length = _doubles(_int64s(data)[array[_OFFSET]]), array[_LENGTH]
        for j in range(length):
            _doubles(fields[_DERIVED + k])[sim * length + j] = source[j]


@_compiled
def _place(engine: Any, entry: Any, column: Any, values: Any, first: Any, size: Any, stride: Any, wide: Any) -> None:
    """Copies `size` numbers of each simulation's row of `stride`, from number `first` on, into the state's columns."""
    batch, num_sims = _int64s(entry)[_BATCH], _int64s(entry)[_NUM_SIMS]
    state, columns = _doubles(_state(batch)), _num_columns(batch)
    for i in range(num_sims):
        for j in range(size):
            state[i * columns + column + j] = _get(values, i * stride + first + j, wide)


@_compiled
def _call(engine: Any, entry: Any, forward: Any, num_steps: Any, stage: Any) -> None:
    """Some engine steps under constant controls and poses, or none and the forward pass."""
    own, fields = _int64s(engine), _int64s(entry)
    batch, num_sims = fields[_BATCH], fields[_NUM_SIMS]
    if forward:
        _forward(batch, 0, num_sims, own[_ACC])
    elif own[_POST]:
        fields[_NUM_STEPS], fields[_STAGE], fields[_OWNER] = num_steps, stage, engine
        _apply(batch, 0, num_sims, own[_ADVANCE], entry, 1)
    else:
        _step(batch, 0, num_sims, num_steps, stage)


@_compiled
def _note_failures(engine: Any, entry: Any, failed: Any) -> None:
    """Marks in `failed` [num_sims] what diverged or raised in the last call."""
    own, fields = _int64s(engine), _int64s(entry)
    status, num_warnings = _int32s(_status(fields[_BATCH])), own[_NUM_WARNINGS]
    for i in range(fields[_NUM_SIMS]):
        warnings = _int32s(_warning(fields[_BATCH]) + 8 * num_warnings * i)  # pairs: last info, count
        failed[i] |= status[i] != 0
        for j in range(_NUM_REASONS):
            failed[i] |= warnings[2 * own[_DIVERGED + j] + 1] != 0
        for j in range(num_warnings):
            warnings[2 * j], warnings[2 * j + 1] = 0, 0


@_compiled
def _collect(engine: Any, entry: Any, forward: Any, old: Any, new: Any, values: Any, wide: Any, failed: Any) -> None:
    """Writes the rows of the state's bits and of the outputs."""
    own, fields = _int64s(engine), _int64s(entry)
    state, columns = _doubles(_state(fields[_BATCH])), _num_columns(fields[_BATCH])
    before, after, row, width = _doubles(old), _doubles(new), own[_ROW], own[_OUTPUT]
    for i in range(fields[_NUM_SIMS]):
        for j in range(own[_NUM_STATE]):
            after[i * row + j] = state[i * columns + j]
    for k in range(own[_NUM_COPIES]):
        one = _int64s(own[_COPIES] + 8 * 6 * k)
        source, start, size, into_row, target, change = one[0], one[1], one[2], one[3], one[4], one[5]
        for i in range(fields[_NUM_SIMS]):
            for j in range(size):
                if source < 0:
                    value = state[i * columns + start + j]
                else:
                    value = _doubles(fields[_DERIVED + source])[i * size + j]
                if forward and source >= 0 and _int64s(own[_ARRAYS])[_ARRAY_SIZE * source + _UNKNOWN]:
                    value = 0.0  # as after a reset in gymnasium: no contact force is known yet
                if into_row:
                    after[i * row + target + j] = value
                elif change < 0:
                    _put(values, i * width + target + j, value, wide)
                else:
                    _put(values, i * width + target + j, 0.0 if forward else value - before[i * row + change + j], wide)
    for i in range(fields[_NUM_SIMS]):
        if failed[i]:
            for j in range(row):
                after[i * row + j] = np.nan
            for j in range(width):
                _put(values, i * width + j, np.nan, wide)


@_compiled
def _run(
    engine: Any,
    forward: Any,
    num_sims: Any,
    old: Any,
    ctrl: Any,
    quat: Any,
    pos: Any,
    num_places: Any,
    new: Any,
    values: Any,
    wide: Any,
) -> None:
    """One control step, or a forward pass, of `num_sims` simulations; arguments are addresses of their rows.

    `num_places` says for how many engine steps `pos` has a place each: 0 without mocap bodies, 1 if they stand still.
    """
    own = _int64s(engine)
    failed = np.zeros(num_sims, np.bool_)
    entry = _acquire(engine, num_sims)
    if entry == 0 or _int64s(entry)[_BATCH] == 0:  # out of memory
        for i in range(num_sims * own[_ROW]):
            _doubles(new)[i] = np.nan
        for i in range(num_sims * own[_OUTPUT]):
            _put(values, i, np.nan, wide)
        if entry != 0:
            _release(engine, entry)
        return
    _place(engine, entry, 0, old, 0, own[_NUM_STATE], own[_ROW], True)
    _place(engine, entry, own[_CTRL], ctrl, 0, own[_NUM_CTRL], own[_NUM_CTRL], wide)
    if num_places > 0:
        num_mocap = own[_NUM_MOCAP]
        _place(engine, entry, own[_QUAT], quat, 0, 4 * num_mocap, 4 * num_mocap, wide)
    for k in range(max(num_places, 1)):
        if num_places > 0:
            _place(engine, entry, own[_POS], pos, 3 * num_mocap * k, 3 * num_mocap, 3 * num_mocap * num_places, wide)
        last = k == max(num_places, 1) - 1
        _call(
            engine,
            entry,
            forward,
            1 if num_places > 1 else own[_NUM_SUBSTEPS],
            own[_LAST_STAGE] if last else 0,
        )
        _note_failures(engine, entry, failed)
    _collect(engine, entry, forward, old, new, values, wide, failed)
    _release(engine, entry)


@_compiled
def _size(buffer: Any) -> Any:
    """Of an XLA_FFI_Buffer: the number of elements."""
    size = 1
    for i in range(_int64s(buffer)[4]):
        size *= _int64s(_int64s(buffer)[5])[i]
    return size


@_compiled
def _answer(frame: Any, forward: Any) -> Any:
    """Carries out an XLA_FFI_CallFrame; the arguments are those of `Engine.__call__`. Returns 0: no error."""
    call = _int64s(frame)
    extension = call[1]
    if extension != 0 and _int32s(extension)[2] == 1:  # asked for the version that this is written for
        metadata = _int32s(_int64s(extension)[3])
        metadata[6], metadata[7], metadata[8] = 0, 3, 0  # major, minor, traits
        return 0
    num_arguments, arguments, results = call[7], _int64s(call[9]), _int64s(call[14])
    key = _int64s(_int64s(_int64s(call[20])[0])[1])[0]  # the value of the only attribute
    table, engine = _int64s(_table()), 0
    for i in range(table[0]):
        if table[1 + 2 * i] == key:
            engine = table[2 + 2 * i]
    old, ctrl = arguments[0], arguments[1]
    num_sims = _size(old) // (2 * _int64s(engine)[_ROW])
    quat, pos, num_places = 0, 0, 0
    if num_arguments == 4 and num_sims > 0:
        quat, pos = _int64s(arguments[2])[3], _int64s(arguments[3])[3]
        num_places = _size(arguments[3]) // (3 * _int64s(engine)[_NUM_MOCAP] * num_sims)
    new, values = results[0], results[1]
    wide = _int32s(values)[4] == 12  # XLA_FFI_DataType_F64
    if num_sims > 0:
        _run(
            engine,
            forward,
            num_sims,
            _int64s(old)[3],
            _int64s(ctrl)[3],
            quat,
            pos,
            num_places,
            _int64s(new)[3],
            _int64s(values)[3],
            wide,
        )
    return 0


@_called_by_c(_address(_address))
def _on_step(frame: Any) -> Any:
    return _answer(frame, False)


@_called_by_c(_address(_address))
def _on_forward(frame: Any) -> Any:
    return _answer(frame, True)


@dataclasses.dataclass(frozen=True)
class Copy:
    """One output of a call: columns of the state, or a derived array, and where they go."""

    source: int  # number of the derived array, or `STATE`
    start: int  # first column, where it is the state
    size: int
    into_row: bool  # of the engine's own row, or of the outputs
    target: int  # first column there
    change: int = -1  # if not negative, what is written is the difference to the old row from this column on


class Engine:
    """Steps any number of simulations of one model; in a jitted program or, on an accelerator's host, called by it.

    Args:
        model: copied.
        num_threads: of one call.
        num_substeps: engine steps per call of `step`.
        last_stage: the `mjtStage` up to which the forward pass is carried out after them; 0 for none.
        num_state: float64 columns of a row that are the state: `mjtState` components up to the warm start.
        row_size: float64 columns of a row, derived arrays behind the state included.
        output_size: columns of the outputs.
        derived: names of `MjData` arrays.
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
        serialized = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, serialized)
        digest = hashlib.sha256(repr(facts).encode() + serialized.tobytes()).digest()
        self._key = int.from_bytes(digest[:7], "little")
        with _lock_of_engines:
            if self._key in _known:
                return
            model = copy.copy(model)
            names = [ctypes.create_string_buffer(name.encode()) for name in derived]
            arrays = np.array(
                [
                    (ctypes.addressof(names[i]), *where, derived[i] in POST_CONSTRAINT)
                    for i, where in enumerate(_locate(model, derived))
                ],
                np.int64,
            )
            copy_table = np.array([dataclasses.astuple(one) for one in copies], np.int64)
            pool = np.zeros((_POOL_SIZE, _DERIVED + len(derived)), np.int64)
            engine = np.zeros(_ENGINE_SIZE, np.int64)
            ctypes.CDLL(None).pthread_mutex_init(ctypes.c_void_p(engine.ctypes.data), None)
            for field, value in {
                _MODEL: model._address,
                _THREADS: num_threads,
                _NUM_STATE: num_state,
                _ROW: row_size,
                _OUTPUT: output_size,
                _NUM_CTRL: model.nu,
                _NUM_MOCAP: model.nmocap,
                _NUM_SUBSTEPS: num_substeps,
                _LAST_STAGE: last_stage,
                _POST: bool(POST_CONSTRAINT.intersection(derived)),
                _CTRL: _column(model, mujoco.mjtState.mjSTATE_CTRL),
                _QUAT: _column(model, mujoco.mjtState.mjSTATE_MOCAP_QUAT),
                _POS: _column(model, mujoco.mjtState.mjSTATE_MOCAP_POS),
                _NUM_DERIVED: len(derived),
                _ARRAYS: arrays.ctypes.data,
                _NUM_COPIES: len(copies),
                _COPIES: copy_table.ctypes.data,
                _POOL: pool.ctypes.data,
                _ADVANCE: _advance_one.address,
                _ACC: int(mujoco.mjtStage.mjSTAGE_ACC),
                _NUM_WARNINGS: int(mujoco.mjtWarning.mjNWARNING),
            }.items():
                engine[field] = value
            reasons = (
                mujoco.mjtWarning.mjWARN_BADQPOS,
                mujoco.mjtWarning.mjWARN_BADQVEL,
                mujoco.mjtWarning.mjWARN_BADQACC,
            )
            engine[_DIVERGED:] = [int(reason) for reason in reasons]
            _enter(self._key, engine, (model, names, arrays, copy_table, pool))

    def step(self, bits: jax.Array, ctrl: jax.Array, *poses: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Advances one control step; vmapped, all simulations together.

        Args:
            bits: [2 row_size] uint32, the row.
            ctrl: [nu].
            poses: none, or quaternions [4 nmocap] and positions [3 nmocap] or [num_substeps 3 nmocap].

        Returns:
            The new row's bits, and [output_size] outputs; NaN where the simulation diverged or MuJoCo raised an error.
        """
        return self._call(_STEP, bits, ctrl, *poses)

    def forward(self, bits: jax.Array, ctrl: jax.Array, *poses: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The forward pass alone, as `step` else."""
        return self._call(_FORWARD, bits, ctrl, *poses)

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
        host = functools.partial(self._on_host, name == _FORWARD)
        return jax.pure_callback(host, shapes, *arguments, vmap_method="broadcast_all")

    def _on_host(self, forward: bool, *arguments: Any) -> tuple[np.ndarray, np.ndarray]:
        """What the foreign functions do, on arrays of the host."""
        old, ctrl, *poses = [np.ascontiguousarray(x) for x in arguments]
        lead, (row_size, output_size) = old.shape[:-1], self._sizes
        new = np.empty((*lead, 2 * row_size), np.uint32)
        values = np.empty((*lead, output_size), ctrl.dtype)
        num_sims = int(np.prod(lead, dtype=int))
        num_places = poses[1].size // (3 * poses[0].size // 4) if poses else 0
        quat, pos = [x.ctypes.data for x in poses] or [0, 0]
        engine = _known[self._key][0].ctypes.data
        wide = ctrl.dtype == np.float64
        _run(
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
_known: dict[int, tuple[np.ndarray, Any]] = {}  # every engine of this process, and what it points to


def _enter(key: int, engine: np.ndarray, kept: Any) -> None:
    """Enters an engine into the table. It stays: a compiled program may outlive its environment, and has the key."""
    count = len(_known)
    if count == _TABLE_SIZE:
        raise RuntimeError(f"{_TABLE_SIZE} different physics in one process; make fewer, they are kept")
    _known[key] = engine, kept
    _engines[1 + 2 * count : 3 + 2 * count] = key, engine.ctypes.data
    _engines[0] = count + 1


@functools.cache
def _register() -> None:
    """Tells XLA of the foreign functions."""
    for name, function in ((_STEP, _on_step), (_FORWARD, _on_forward)):
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(function.ctypes), platform="cpu")


def _column(model: mujoco.MjModel, component: mujoco.mjtState) -> int:
    """The first column of a component in a row of the integration state, whose order is that of the bits."""
    return mujoco.mj_stateSize(model, _INTEGRATION & (int(component) - 1))


def _locate(model: mujoco.MjModel, names: Sequence[str]) -> list[tuple[int, int]]:
    """Where in C's mjData, in words of 8 bytes, the pointers to these arrays stand, and how long the arrays are.

    Found by value: the layout is not to be had from Python.
    """
    data = mujoco.MjData(model)
    measure = getattr(ctypes.CDLL(None), "malloc_size" if sys.platform == "darwin" else "malloc_usable_size")
    measure.argtypes, measure.restype = [ctypes.c_void_p], ctypes.c_size_t
    words = np.ctypeslib.as_array((ctypes.c_int64 * (measure(data._address) // 8)).from_address(data._address))
    arrays = [getattr(data, name) for name in names]
    # Empty arrays before it have the same address.
    return [(int(np.flatnonzero(words == array.ctypes.data)[-1]), array.size) for array in arrays]
