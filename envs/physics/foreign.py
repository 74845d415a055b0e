"""The functions that XLA calls to step batches of C MuJoCo simulations. Numba compiles them.

No Python runs between XLA and MuJoCo, for two reasons: a Python callback holds the interpreter's lock, so the programs
of several devices would wait for each other; and JAX does not store a program with a callback in its compilation cache.
The functions read XLA's C structures (`xla/ffi/api/c_api.h`, version 0.3) and call the functions of `mujoco/mjbatch.h`
by name, so that their code is the same in every process. The address of an engine is another one in every process. So
programs contain a key instead, the hash of what the engine does, and a table has the address for each key.

`engine.Engine` makes engines and calls these functions in a jitted program.
"""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import llvmlite.binding
import mujoco
import numba
import numpy as np
from numba import types
from numba.core.caching import FunctionCache
from numba.extending import intrinsic

STEP, FORWARD = "ccil_jax_mujoco_step", "ccil_jax_mujoco_forward"
TABLE_SIZE = 4096  # engines in one process
POOL_SIZE = 64  # batches that an engine keeps, of whatever sizes: more than the devices of a machine use at a time
NUM_REASONS = 3

# The layout of an engine: 64 bytes for the mutex, then one int64 for each of these fields.
MUTEX = 0
MODEL, THREADS, NUM_STATE, ROW, OUTPUT, NUM_CTRL, NUM_MOCAP, NUM_SUBSTEPS, LAST_STAGE = range(8, 17)
POST, CTRL, QUAT, POS, NUM_DERIVED, ARRAYS, NUM_COPIES, COPIES, POOL, ADVANCE = range(17, 27)
ACC, NUM_WARNINGS, DIVERGED = range(27, 30)
ENGINE_SIZE = DIVERGED + NUM_REASONS
# The fields of an entry of its pool. After them come the addresses of the derived arrays.
NUM_SIMS, BATCH, BUSY, CONFIG, NUM_STEPS, STAGE, OWNER, DERIVED = range(8)
# The fields of a derived array: the address of its name, where in an mjData the pointer to it is (in words of 8
# bytes), its length, and whether the forward pass leaves it out.
NAME, OFFSET, LENGTH, UNKNOWN, ARRAY_SIZE = range(5)

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

# The decorators below compile at once, so the names of the C functions have to be known by now.
llvmlite.binding.load_library_permanently(str(next(Path(mujoco.__file__).parent.glob("libmujoco.*"))))
engines = np.zeros(1 + 2 * TABLE_SIZE, np.int64)  # how many engines there are, then key and address of each
_address_of_engines = engines.ctypes.data


def _get_engines() -> Any:
    return _address_of_engines


_getter: Any = numba.cfunc(types.intp())(_get_engines)
llvmlite.binding.add_symbol("ccil_jax_engines", _getter.address)

_Function = TypeVar("_Function", bound=Callable[..., Any])


class _Cache(FunctionCache):
    """Numba's cache of compiled code in files. Where these cannot be read or written, the code is compiled anew."""

    def load_overload(self, *args: Any) -> Any:
        """The compiled code of a function, or None where no file has it."""
        with contextlib.suppress(OSError):
            return super().load_overload(*args)
        return None

    def save_overload(self, *args: Any) -> None:
        """Writes a function's code to a file, if there is room."""
        with contextlib.suppress(OSError):
            super().save_overload(*args)


def _compiled(function: _Function) -> _Function:
    compiled: Any = numba.njit(nogil=True, error_model="numpy")(function)
    with contextlib.suppress(RuntimeError):  # numba finds no folder that can be written
        compiled._cache = _Cache(function)
    return compiled


def _called_by_c(signature: Any) -> Callable[[Callable[..., Any]], Any]:
    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.cfunc(signature, cache=True)(function)
        except (RuntimeError, OSError):  # no folder that can be written, or no room in it
            return numba.cfunc(signature)(function)

    return decorate


def _cast(dtype: Any) -> Any:
    """A function that turns an address into a pointer to numbers of that type, which is indexed like an array."""

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
    """The address of the pool's entry for a batch of that size, reserved for the caller; 0 if none is free."""
    own = _int64s(engine)
    width = DERIVED + own[NUM_DERIVED]
    found, replaced = 0, 0
    _lock(engine)
    for i in range(POOL_SIZE):
        entry = own[POOL] + 8 * width * i
        fields = _int64s(entry)
        if fields[BUSY] == 0 and (fields[NUM_SIMS] == num_sims or fields[NUM_SIMS] == 0):
            found = entry
            break
        if fields[BUSY] == 0 and replaced == 0:
            replaced = entry
    if found == 0:
        found = replaced
    if found != 0:
        _int64s(found)[BUSY] = 1
    _unlock(engine)
    if found == 0:
        return found
    fields = _int64s(found)
    if fields[NUM_SIMS] != num_sims and fields[BATCH] != 0:
        _delete_batch(fields[BATCH])
        fields[BATCH] = 0
    fields[NUM_SIMS] = num_sims
    if fields[BATCH] == 0:
        fields[CONFIG] = min(own[THREADS], num_sims)  # an mjBatchConfig: the number of threads, then a zero
        fields[BATCH] = _make_batch(own[MODEL], num_sims, found + 8 * CONFIG, 0, 0)
        for i in range(own[NUM_DERIVED]):
            # This has to come before the first call: a call fills only the arrays that were asked for before it.
            name = _int64s(own[ARRAYS])[ARRAY_SIZE * i + NAME]
            fields[DERIVED + i] = _output(fields[BATCH], name, 0, 0)
    return found


@_compiled
def _release(engine: Any, entry: Any) -> None:
    _lock(engine)
    _int64s(entry)[BUSY] = 0
    _unlock(engine)


@_called_by_c(_nothing(_address, _address, _int, _address))
def advance_one(model: Any, data: Any, sim: Any, entry: Any) -> None:
    """Steps one simulation and copies its derived arrays, contact forces included. Runs on a thread of the batch.

    MuJoCo calls it: it is an `mjfBatchFunc`.
    """
    fields = _int64s(entry)
    for _ in range(fields[NUM_STEPS]):
        _mj_step(model, data)
    if fields[STAGE] != 0:
        _mj_forward(model, data)
    _mj_post_constraint(model, data)
    own = _int64s(fields[OWNER])
    for k in range(own[NUM_DERIVED]):
        array = _int64s(own[ARRAYS] + 8 * ARRAY_SIZE * k)
        source, length = _doubles(_int64s(data)[array[OFFSET]]), array[LENGTH]
        for j in range(length):
            _doubles(fields[DERIVED + k])[sim * length + j] = source[j]


@_compiled
def _place(engine: Any, entry: Any, column: Any, values: Any, first: Any, size: Any, stride: Any, wide: Any) -> None:
    """Copies `size` numbers of each simulation's row of `stride`, from number `first` on, into the state's columns."""
    batch, num_sims = _int64s(entry)[BATCH], _int64s(entry)[NUM_SIMS]
    state, columns = _doubles(_state(batch)), _num_columns(batch)
    for i in range(num_sims):
        for j in range(size):
            state[i * columns + column + j] = _get(values, i * stride + first + j, wide)


@_compiled
def _call(engine: Any, entry: Any, forward: Any, num_steps: Any, stage: Any) -> None:
    """Carries out engine steps while controls and poses stay the same, or, if `forward`, the forward pass alone."""
    own, fields = _int64s(engine), _int64s(entry)
    batch, num_sims = fields[BATCH], fields[NUM_SIMS]
    if forward:
        _forward(batch, 0, num_sims, own[ACC])
    elif own[POST]:
        fields[NUM_STEPS], fields[STAGE], fields[OWNER] = num_steps, stage, engine
        _apply(batch, 0, num_sims, own[ADVANCE], entry, 1)
    else:
        _step(batch, 0, num_sims, num_steps, stage)


@_compiled
def _note_failures(engine: Any, entry: Any, failed: Any) -> None:
    """Marks in `failed` [num_sims] the simulations that diverged, or raised an error, in the last call."""
    own, fields = _int64s(engine), _int64s(entry)
    status, num_warnings = _int32s(_status(fields[BATCH])), own[NUM_WARNINGS]
    for i in range(fields[NUM_SIMS]):
        warnings = _int32s(_warning(fields[BATCH]) + 8 * num_warnings * i)  # pairs of last info and count
        failed[i] |= status[i] != 0
        for j in range(NUM_REASONS):
            failed[i] |= warnings[2 * own[DIVERGED + j] + 1] != 0
        for j in range(num_warnings):
            warnings[2 * j], warnings[2 * j + 1] = 0, 0


@_compiled
def _collect(engine: Any, entry: Any, forward: Any, old: Any, new: Any, values: Any, wide: Any, failed: Any) -> None:
    """Writes the rows of the state's bits and of the outputs."""
    own, fields = _int64s(engine), _int64s(entry)
    state, columns = _doubles(_state(fields[BATCH])), _num_columns(fields[BATCH])
    before, after, row, width = _doubles(old), _doubles(new), own[ROW], own[OUTPUT]
    for i in range(fields[NUM_SIMS]):
        for j in range(own[NUM_STATE]):
            after[i * row + j] = state[i * columns + j]
    for k in range(own[NUM_COPIES]):
        one = _int64s(own[COPIES] + 8 * 6 * k)
        source, start, size, into_row, target, change = one[0], one[1], one[2], one[3], one[4], one[5]
        for i in range(fields[NUM_SIMS]):
            for j in range(size):
                if source < 0:
                    value = state[i * columns + start + j]
                else:
                    value = _doubles(fields[DERIVED + source])[i * size + j]
                if forward and source >= 0 and _int64s(own[ARRAYS])[ARRAY_SIZE * source + UNKNOWN]:
                    value = 0.0  # as after a reset in gymnasium: no contact force is known yet
                if into_row:
                    after[i * row + target + j] = value
                elif change < 0:
                    _put(values, i * width + target + j, value, wide)
                else:
                    _put(values, i * width + target + j, 0.0 if forward else value - before[i * row + change + j], wide)
    for i in range(fields[NUM_SIMS]):
        if failed[i]:
            for j in range(row):
                after[i * row + j] = np.nan
            for j in range(width):
                _put(values, i * width + j, np.nan, wide)


@_compiled
def run(
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
    """One control step, or one forward pass, of `num_sims` simulations. The arrays are given by their addresses.

    `num_places` is how many positions `pos` has for each mocap body: 0 without mocap bodies, 1 if they stand still
    during the control step, otherwise one for each engine step.
    """
    own = _int64s(engine)
    failed = np.zeros(num_sims, np.bool_)
    entry = _acquire(engine, num_sims)
    if entry == 0 or _int64s(entry)[BATCH] == 0:  # out of memory
        for i in range(num_sims * own[ROW]):
            _doubles(new)[i] = np.nan
        for i in range(num_sims * own[OUTPUT]):
            _put(values, i, np.nan, wide)
        if entry != 0:
            _release(engine, entry)
        return
    _place(engine, entry, 0, old, 0, own[NUM_STATE], own[ROW], True)
    _place(engine, entry, own[CTRL], ctrl, 0, own[NUM_CTRL], own[NUM_CTRL], wide)
    if num_places > 0:
        num_mocap = own[NUM_MOCAP]
        _place(engine, entry, own[QUAT], quat, 0, 4 * num_mocap, 4 * num_mocap, wide)
    for k in range(max(num_places, 1)):
        if num_places > 0:
            _place(engine, entry, own[POS], pos, 3 * num_mocap * k, 3 * num_mocap, 3 * num_mocap * num_places, wide)
        last = k == max(num_places, 1) - 1
        _call(
            engine,
            entry,
            forward,
            1 if num_places > 1 else own[NUM_SUBSTEPS],
            own[LAST_STAGE] if last else 0,
        )
        _note_failures(engine, entry, failed)
    _collect(engine, entry, forward, old, new, values, wide, failed)
    _release(engine, entry)


@_compiled
def _size(buffer: Any) -> Any:
    """The number of elements of an XLA_FFI_Buffer."""
    size = 1
    for i in range(_int64s(buffer)[4]):
        size *= _int64s(_int64s(buffer)[5])[i]
    return size


@_compiled
def _answer(frame: Any, forward: Any) -> Any:
    """Carries out an XLA_FFI_CallFrame, whose arguments are those of `Engine.step`. Returns 0: no error."""
    call = _int64s(frame)
    extension = call[1]
    if extension != 0 and _int32s(extension)[2] == 1:  # XLA asks for which version of its interface this is written
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
    num_sims = _size(old) // (2 * _int64s(engine)[ROW])
    quat, pos, num_places = 0, 0, 0
    if num_arguments == 4 and num_sims > 0:
        quat, pos = _int64s(arguments[2])[3], _int64s(arguments[3])[3]
        num_places = _size(arguments[3]) // (3 * _int64s(engine)[NUM_MOCAP] * num_sims)
    new, values = results[0], results[1]
    wide = _int32s(values)[4] == 12  # XLA_FFI_DataType_F64
    if num_sims > 0:
        run(
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
def on_step(frame: Any) -> Any:
    """The foreign function `STEP`, which XLA calls: one control step."""
    return _answer(frame, False)


@_called_by_c(_address(_address))
def on_forward(frame: Any) -> Any:
    """The foreign function `FORWARD`, which XLA calls: the forward pass alone."""
    return _answer(frame, True)
