"""Builders of malformed demonstrations, by family and name, each with a part of the message that it must get."""

import os
import pickle
import struct
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

Case = tuple[Callable[[Path], Any], str]
LIMIT = 64 * 1024**2  # bytes that may be unpacked while these are read: bombs can then be small and quick
CANARY = "canary"  # a directory of this name in the working directory: code ran
CODE = f"import os; os.mkdir('{CANARY}')"
N = 6  # steps, in two trajectories


def own_arrays() -> dict[str, Any]:
    """A sound file of our own format, on Swimmer."""
    flags = np.arange(N) % 3 == 2
    return {
        "obs": np.ones((N, 8), np.float32),
        "actions": np.ones((N, 2), np.float32),
        "rewards": np.ones(N, np.float32),
        "costs": np.ones(N, np.float32),
        "terminated": np.zeros(N, bool),
        "truncated": flags,
        "episode_ends": np.array([3, N]),
        "metadata": np.array('{"task": "Swimmer"}'),
    }


def objects(parts: list[Any]) -> np.ndarray:
    """One Python object an entry."""
    array = np.empty(len(parts), object)
    array[:] = parts
    return array


def legacy_arrays() -> dict[str, Any]:
    """A sound file of CCIL's format: trajectories of 2 and 4 steps."""
    return {
        "obs": objects([np.ones((2, 8)), np.ones((4, 8), np.float32)]),
        "acs": objects([np.ones((2, 2)), np.ones((4, 2))]),
        "rews": objects([[1.0, 2.0], list(np.ones(4))]),
        "ep_rets": np.array([3.0, 4.0]),
        "costs": np.array([1.0, 2.0]),
        "accucost": objects([np.array([0.0, 1.0]), np.array([0.0, 1.0, 1.0, 2.0])]),
    }


def dsrl_arrays() -> dict[str, Any]:
    """A sound DSRL file."""
    own = own_arrays()
    names = {"observations": "obs", "terminals": "terminated", "timeouts": "truncated"}
    return {new: own[names.get(new, new)] for new in (*names, "actions", "rewards", "costs")}


def episode_arrays() -> dict[str, Any]:
    """A sound Minari episode of 3 steps."""
    return {
        "observations": np.ones((4, 8), np.float32),
        "actions": np.ones((3, 2), np.float32),
        "rewards": np.ones(3),
        "terminations": np.zeros(3, bool),
        "truncations": np.arange(3) == 2,
        "infos/cost": np.ones(4),
    }


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    with path.open("wb") as file:  # NumPy would put .npz behind the name
        np.savez(file, allow_pickle=True, **{key: value for key, value in arrays.items() if value is not None})


def write_hdf5(path: Path, arrays: Mapping[str, Any]) -> None:
    """A group or dataset an entry; None leaves it out, a function gets the file and the name."""
    with h5py.File(path, "w") as file:
        for name, value in arrays.items():
            if callable(value):
                value(file, name)
            elif value is not None:
                file[name] = value


def write_minari(folder: Path, first: Mapping[str, Any], metadata: bytes | None = b'{"dataset_id": "x-v0"}') -> None:
    """Two episodes, the first with changes."""
    (folder / "data").mkdir(parents=True)
    arrays = {f"episode_0/{key}": value for key, value in {**episode_arrays(), **first}.items()}
    arrays |= {f"episode_1/{key}": value for key, value in episode_arrays().items()}
    write_hdf5(folder / "data" / "main_data.hdf5", arrays)
    if metadata is not None:
        (folder / "data" / "metadata.json").write_bytes(metadata)


def write_members(path: Path, members: Mapping[str, bytes], method: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def npy(descr: str, shape: str, content: bytes, version: bytes = b"\x01\x00") -> bytes:
    """A member with any header."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    length = struct.pack("<H" if version == b"\x01\x00" else "<I", len(header))
    return b"\x93NUMPY" + version + length + header + content


def _own(**changes: Any) -> Callable[[Path], None]:
    return lambda path: write_npz(path, {**own_arrays(), **changes})


def _member(content: bytes, method: int = zipfile.ZIP_STORED) -> Callable[[Path], None]:
    return lambda path: write_members(path, {"obs.npy": content}, method)


def _understated(path: Path) -> None:
    """Both headers declare a few bytes; the stream unpacks to more than the limit."""
    content = npy("'<f4'", "(1, 8)", bytes(32))
    write_members(path, {"obs.npy": content + bytes(2 * LIMIT)}, zipfile.ZIP_DEFLATED)
    size, declared = (struct.pack("<I", n) for n in (len(content) + 2 * LIMIT, len(content)))
    path.write_bytes(path.read_bytes().replace(size, declared))


def _encrypted(path: Path) -> None:
    write_npz(path, own_arrays())
    content = bytearray(path.read_bytes())
    content[6] |= 1
    content[content.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(content)


def _wide_metadata(path: Path) -> None:
    """A trillion texts of no characters: they agree with a member of no bytes."""
    write_npz(path, {**own_arrays(), "metadata": None})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("metadata.npy", npy("'<U0'", "(1099511627776,)", b""))


def _loop(path: Path) -> None:
    path.symlink_to(path.name)


NPZ: dict[str, Case] = {  # beside those of tests/test_npz.py and tests/test_demonstrations.py
    "lzma": (_member(npy("'<f4'", "(1, 8)", bytes(32)), zipfile.ZIP_LZMA), "'obs' is truncated or damaged"),
    "bzip2": (_member(npy("'<f4'", "(1, 8)", bytes(32)), zipfile.ZIP_BZIP2), "'obs' is truncated or damaged"),
    "encrypted": (_encrypted, "'obs' is truncated or damaged"),
    "size understated": (_understated, "'obs' is truncated or damaged"),
    "path as name": (lambda path: write_members(path, {"../obs.npy": b"", "/obs.npy": b""}), "key 'obs' is missing"),
    "metadata of numbers": (_own(metadata=np.zeros(500_000)), "'metadata' is not a JSON object"),
    "metadata long": (_own(metadata=np.array('{"x": "' + "x" * 600_000 + '"}')), "'metadata' is not a JSON object"),
    "metadata of many digits": (_own(metadata=np.array('{"x": ' + "9" * 10_000 + "}")), "'metadata' is not a JSON"),
    "task that steers the terminal": (
        _own(metadata=np.array('{"task": "\\u001b[2J\\n' + "x" * 9000 + '"}')),
        "recorded on task",
    ),
    "text of no width": (_wide_metadata, "'metadata' is not a JSON object"),
    "structured": (_own(obs=np.zeros((N, 8), [("x", "f4")])), "'obs' has dtype"),
    "objects in a structure": (_own(obs=np.zeros((N, 8), [("x", "O")])), "'obs' holds pickled objects"),
    "dates": (_own(obs=np.zeros((N, 8), "M8[s]")), "'obs' has dtype"),
    "negative shape": (_member(npy("'<f4'", "(-1, 8)", bytes(32))), "'obs' "),
    "many axes": (_member(npy("'<f4'", "(" + "1, " * 100 + ")", bytes(4))), "'obs' is truncated or damaged"),
    "shape beyond 2**64": (_member(npy("'<f4'", f"({2**70}, 8)", bytes(32))), "'obs' declares shape"),
    "long header": (_member(npy("'<f4'", "(1, 8)" + " " * 20_000, bytes(32))), "'obs' is truncated or damaged"),
    "deep header": (_member(npy("'<f4'", "(" * 2_000 + ")" * 2_000, bytes(32))), "'obs' is truncated or damaged"),
    "code as header": (
        _member(npy("'<f4'", f'__import__("os").mkdir("{CANARY}")', b"")),
        "'obs' is truncated or damaged",
    ),
    "unknown version": (_member(npy("'<f4'", "(1, 8)", bytes(32), b"\x09\x09")), "'obs' is truncated or damaged"),
    "rows more than bytes": (_member(npy("'<f4'", "(2, 8)", bytes(32))), "'obs' declares shape (2, 8)"),
    "named pipe": (os.mkfifo, "not a file"),
    "link to itself": (_loop, "no such file"),
    "not permitted in a name": (lambda path: write_members(path, {"obs.npy\0x": b""}), "obs"),
    "costs in columns": (_own(costs=np.ones((N, 2))), "'costs' has shape (6, 2), must have shape (6,)"),
    "flags of 2": (_own(truncated=np.full(N, 2)), "'truncated' holds 2 (row 0), must hold flags"),
    "flags of NaN": (_own(terminated=np.full(N, np.nan)), "'terminated' holds nan (row 0), must hold flags"),
    "episode ends between rows": (_own(episode_ends=np.array([2.5, N])), "'episode_ends' holds 2.5 (entry 0)"),
    "episode ends of NaN": (_own(episode_ends=np.array([np.nan, N])), "'episode_ends' holds nan (entry 0)"),
    "episode ends as flags": (_own(episode_ends=np.ones(2, bool)), "'episode_ends' has dtype bool"),
    "one episode end too many": (_own(episode_ends=np.array([3, 6, 6])), "'episode_ends' does not increase"),
    "ends beyond int64": (_own(episode_ends=np.array([3, 2**64 - 1], np.uint64)), "'episode_ends'"),
}


def _legacy(**changes: Any) -> Callable[[Path], None]:
    return lambda path: write_npz(path, {**legacy_arrays(), **changes})


class Call:
    """Unpickling it calls `function(*arguments)`."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.what = function, arguments

    def __reduce__(self) -> Any:
        return self.what


class State:
    """Unpickling it calls `__setstate__`."""

    def __setstate__(self, state: Any) -> None:
        Path(CANARY).mkdir()

    def __getstate__(self) -> Any:
        return {"x": 1}


def _holding(value: Any) -> Callable[[Path], None]:
    return _legacy(obs=objects([np.ones((2, 8)), value]))


def pickled(content: bytes, shape: str = "(2,)") -> Callable[[Path], None]:
    """A sound file whose 'obs' is this pickle."""

    def build(path: Path) -> None:
        write_npz(path, {key: value for key, value in legacy_arrays().items() if key != "obs"})
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr("obs.npy", npy("'|O'", shape, content))

    return build


def object_array(entries: bytes, shape: bytes = b"K\x02\x85", kind: bytes = b"X\x02\x00\x00\x00O8") -> bytes:
    """The pickle of an object array [2] whose list is built by `entries`."""
    new = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
    order = b"(K\x03X\x01\x00\x00\x00|NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK?tb"
    return (
        b"\x80\x03"
        + new
        + b"(K\x01"
        + shape
        + b"cnumpy\ndtype\n"
        + kind
        + b"\x89\x88\x87R"
        + order
        + b"\x89"
        + entries
        + b"tb."
    )


def vector(shape: bytes, kind: bytes = b"f8", content: bytes = b"C\x08" + bytes(8)) -> bytes:
    """Opcodes that make an array of one number, unless told otherwise."""
    new = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
    code = b"X" + struct.pack("<I", len(kind)) + kind
    order = b"(K\x03X\x01\x00\x00\x00<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    return new + b"(K\x01" + shape + b"cnumpy\ndtype\n" + code + b"\x89\x88\x87R" + order + b"\x89" + content + b"tb"


def _system(module: str, name: str, argument: str) -> bytes:
    text = argument.encode()
    return f"c{module}\n{name}\n".encode() + b"X" + struct.pack("<I", len(text)) + text + b"\x85R"


def _with(entries: bytes) -> Callable[[Path], None]:
    """'obs' as a sound array of two entries, the second made by these opcodes."""
    return pickled(object_array(b"](" + vector(b"K\x01\x85") + entries + b"e"))


def _laughs(width: int, depth: int) -> bytes:
    """Lists of the same list, over and over."""
    line = b"](" + b"G" + struct.pack(">d", 1.0) + b"eq\x01"
    for level in range(depth):
        line += b"](" + bytes([0x68, 1 + level]) * width + b"eq" + bytes([2 + level])
    return line


_DAMAGED = "'obs' is truncated or damaged, or no array of arrays"
LEGACY: dict[str, Case] = {
    "os.mkdir": (_holding(Call(os.mkdir, CANARY)), "'obs' holds a pickle that names 'posix.mkdir'"),
    "os.system": (_with(_system("os", "system", f"mkdir {CANARY}")), "names 'os.system', refused"),
    "posix.system": (_with(_system("posix", "system", f"mkdir {CANARY}")), "names 'posix.system'"),
    "eval": (_holding(Call(eval, f"__import__('os').mkdir('{CANARY}')")), "names 'builtins.eval'"),
    "exec": (_holding(Call(exec, CODE)), "names 'builtins.exec'"),
    "Python 2's eval": (_with(_system("__builtin__", "eval", CODE)), "names '__builtin__.eval'"),
    "getattr": (_holding(Call(getattr, "x", "upper")), "names 'builtins.getattr'"),
    "subprocess": (_with(_system("subprocess", "Popen", CANARY)), "names 'subprocess.Popen'"),
    "NumPy's runstring": (_with(_system("numpy.testing._private.utils", "runstring", CODE)), "runstring'"),
    "NumPy's load": (_with(_system("numpy", "load", "obs")), "names 'numpy.load'"),
    "NumPy's fromfile": (_with(_system("numpy", "fromfile", "obs")), "names 'numpy.fromfile'"),
    "dotted name": (_with(_system("numpy", "ndarray.tofile", CANARY)), "names 'numpy.ndarray.tofile'"),
    "module of a name": (_with(_system("numpy.core.multiarray", "_reconstruct.__globals__", "x")), "__globals__'"),
    "copyreg": (_with(b"ccopyreg\n_reconstructor\ncos\nmkdir\nN\x86R"), "names 'copyreg._reconstructor'"),
    "state": (_holding(State()), "holds a pickle"),
    "name on the stack": (_with(b"\x8c\x02os\x8c\x06system\x93\x8c\x06canary\x85R"), "names 'os.system'"),
    "long name": (_with(b"cos\n" + b"x" * 10_000 + b"\n"), "names 'os.xxx"),
    "name of several lines": (_with(b"\x8c\x03o\ns\x8c\x06system\x93"), "names 'o\\ns.system'"),
    "nested in a list": (_holding([[1.0, Call(os.mkdir, CANARY)]]), "names 'posix.mkdir'"),
    "in an unread key": (_legacy(rews=objects([1.0, Call(os.mkdir, CANARY)])), "'rews' holds a pickle that names"),
    "extension registry": (_with(b"\x82\x01"), "opcode EXT1"),
    "persistent id": (_with(b"Pcanary\n"), "opcode PERSID"),
    "instance": (_with(b"(X\x06\x00\x00\x00canaryios\nmkdir\n"), "opcode INST"),
    "object": (_with(b"(cos\nmkdir\nX\x06\x00\x00\x00canaryo"), "opcode OBJ"),
    "new object": (_with(b"cos\nmkdir\n)\x81"), "opcode NEWOBJ"),
    "dictionary": (_holding({"x": 1.0}), "opcode EMPTY_DICT"),
    "doubling": (_with(b"]" + b"2" * 1000), "opcode DUP"),
    "text of Python": (_with(b"S'x'\n"), "opcode STRING"),
    "memo of 2**31": (_with(b"Nr\xff\xff\xff\x7f"), _DAMAGED),
    "bytes of 2**62": (_with(b"\x8e" + struct.pack("<Q", 2**62)), _DAMAGED),
    "text of 2**32": (_with(b"X\xff\xff\xff\xff"), _DAMAGED),
    "frame of 2**62": (_with(b"\x95" + struct.pack("<Q", 2**62)), _DAMAGED),
    "memo entry missing": (_with(b"h\x77"), _DAMAGED),
    "stack empty": (pickled(b"\x80\x030000."), "opcode POP"),
    "array of 2**60": (_with(vector(b"\x8a\x08" + struct.pack("<q", 2**60) + b"\x85")), _DAMAGED),
    "array of -1": (_with(vector(b"J\xff\xff\xff\xff\x85")), _DAMAGED),
    "array without content": (
        _with(b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"),
        _DAMAGED,
    ),
    "array of void": (_with(vector(b"K\x01\x85", b"V8")), _DAMAGED),
    "array of structures": (_with(vector(b"K\x01\x85", b"f4,f4")), _DAMAGED),
    "array of complex": (_with(vector(b"K\x01\x85", b"c8")), _DAMAGED),
    "array of objects in disguise": (_with(vector(b"K\x01\x85", b"O8", b"C\x08" + bytes(8))), _DAMAGED),
    "array from text": (_with(vector(b"K\x01\x85", content=b"X\x08\x00\x00\x00aaaaaaaa")), _DAMAGED),
    "subclass": (_with(vector(b"K\x01\x85").replace(b"cnumpy\nndarray", b"cnumpy\ndtype")), _DAMAGED),
    "class instead of a value": (_with(b"cnumpy\nndarray\n"), _DAMAGED),
    "header of 8 TB": (pickled(object_array(b"](NNe"), "(1000000000000,)"), _DAMAGED),
    "list shorter than the shape": (pickled(object_array(b"](Ne")), _DAMAGED),
    "laughs": (pickled(object_array(b"](" + _laughs(200, 6) + b"Ne")), _DAMAGED),
    "list in itself": (_with(b"]q\x01h\x01a"), _DAMAGED),
    "rows named often": (_with(b"](" + vector(b"K\x01\x85") + b"q\x01" + b"h\x01" * 200_000 + b"e"), "trajectory"),
    "too many opcodes": (_with(b"](" + b"N" * 3_100_000 + b"e"), "past 3000000 opcodes of pickles"),
    "deep": (_with(b"](" * 100_000 + b"e" * 100_000), _DAMAGED),
    "none": (_holding(None), _DAMAGED),
    "text": (_holding("x" * 8), _DAMAGED),
    "integer beyond float": (_holding(10**400), _DAMAGED),
    "pickle cut": (pickled(pickle.dumps(legacy_arrays()["obs"], protocol=4)[:-20]), _DAMAGED),
    "pickle empty": (pickled(b""), _DAMAGED),
    "no pickle": (pickled(b"hello"), "obs"),
    "no array": (pickled(pickle.dumps([1.0, 2.0], protocol=3)), _DAMAGED),
    "renamed pickle": (lambda path: path.write_bytes(pickle.dumps(legacy_arrays())), "a pickle, refused"),
    "no observations": (_legacy(obs=None), "key 'obs' is missing"),
    "no trajectory": (_legacy(**dict.fromkeys(("obs", "acs", "rews", "accucost"), np.zeros((0, 3)))), "'obs'"),
    "trajectories differ": (_legacy(acs=objects([np.ones((2, 2))])), "'acs' has 1 trajectories, 'obs' has 2"),
    "lengths differ": (_legacy(acs=objects([np.ones((2, 2)), np.ones((3, 2))])), "'actions' has 5 rows, 'obs' has 6"),
    "costs of another length": (
        _legacy(accucost=objects([np.ones(2), np.ones(3)])),
        "'accucost' of trajectory 1 has shape (3,), must have shape (4,)",
    ),
    "decreasing cost": (
        _legacy(accucost=objects([np.ones(2), np.array([1.0, 2, 1, 2])])),
        "'accucost' of trajectory 1 decreases (row 2)",
    ),
    "NaN": (_legacy(obs=objects([np.ones((2, 8)), np.full((4, 8), np.nan)])), "'obs' holds NaN"),
    "NaN cost": (_legacy(accucost=objects([np.ones(2), np.full(4, np.nan)])), "'costs' holds NaN"),
    "columns differ": (_holding(np.ones((4, 7))), "'obs' of trajectory 1 has shape (4, 7), trajectory 0 has (2, 8)"),
    "numbers for trajectories": (_legacy(obs=np.ones(2)), "'obs' of trajectory 0 has shape ()"),
    "two costs": (
        _legacy(costs=objects([np.ones(2), np.ones(4)])),
        "'accucost' of trajectory 0 and 'costs' hold different costs",
    ),
    "costs in columns": (
        _legacy(accucost=None, costs=objects([np.ones((2, 3)), np.ones((4, 3))])),
        "'costs' of trajectory 0 has shape (2, 3), must have shape (2,)",
    ),
    "totals alone": (_legacy(accucost=None), "holds no cost of each step"),
    "no costs": (_legacy(accucost=None, costs=None), "holds no cost of each step"),
    "another task": (_legacy(acs=objects([np.ones((2, 3)), np.ones((4, 3))])), "'actions' has 3 columns"),
}


def _dsrl(**changes: Any) -> Callable[[Path], None]:
    return lambda path: write_hdf5(path, {**dsrl_arrays(), **changes})


def external_link(file: Any, name: str) -> None:
    """A link to another file beside this one, which exists."""
    with h5py.File(Path(file.filename).parent / "other.hdf5", "w") as other:
        other["x"] = np.ones((N, 8))
    file[name] = h5py.ExternalLink("other.hdf5", "/x")


def soft_link(file: Any, name: str) -> None:
    file["elsewhere"] = np.ones((N, 8))
    file[name] = h5py.SoftLink("/elsewhere")


def external_storage(file: Any, name: str) -> None:
    secret = Path(file.filename).parent / "secret.bin"
    secret.write_bytes(bytes(N * 8 * 8))
    file.create_dataset(name, (N, 8), "f8", external=[(str(secret), 0, N * 64)])


def virtual(file: Any, name: str) -> None:
    layout = h5py.VirtualLayout((N, 8), "f8")
    layout[:] = h5py.VirtualSource("other.hdf5", "x", (N, 8))
    file.create_virtual_dataset(name, layout)


def unknown_filter(file: Any, name: str) -> None:
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_chunk((N, 8))
    layout.set_filter(32015, h5py.h5z.FLAG_OPTIONAL)
    path = name.encode()
    parents = h5py.h5p.create(h5py.h5p.LINK_CREATE)
    parents.set_create_intermediate_group(True)
    space = h5py.h5s.create_simple((N, 8))
    h5py.h5d.create(file.id, path, h5py.h5t.NATIVE_DOUBLE, space, layout, lcpl=parents)
    file[name][:] = 1


def declared(shape: tuple[int, ...], **settings: Any) -> Callable[[Any, str], None]:
    """A dataset without data."""
    return lambda file, name: file.create_dataset(name, shape, "f8", **settings)


def bomb(file: Any, name: str) -> None:
    """Zeros that unpack to twice the limit."""
    rows = 2 * LIMIT // 64
    file.create_dataset(name, (rows, 8), "f8", chunks=(rows // 8, 8), compression="gzip", data=np.zeros((rows, 8)))


def compressed(filter_name: str) -> Callable[[Any, str], None]:
    """Sound values in chunks, with every filter that is read."""

    def build(file: Any, name: str) -> None:
        settings: dict[str, Any] = {"compression": filter_name, "shuffle": True, "fletcher32": filter_name == "gzip"}
        file.create_dataset(name, data=dsrl_arrays()[name], chunks=(4, 2), **settings)

    return build


def group(file: Any, name: str) -> None:
    file.create_group(name)


def ring(file: Any, name: str) -> None:
    file.create_group(name)["ring"] = file["/"]


def reference(file: Any, name: str) -> None:
    file.create_dataset(name, (N,), h5py.ref_dtype)


def ragged(file: Any, name: str) -> None:
    file.create_dataset(name, (N,), h5py.vlen_dtype(np.float32))[0] = np.ones(8)


def null(file: Any, name: str) -> None:
    file[name] = h5py.Empty("f8")


def _cut(path: Path) -> None:
    _dsrl()(path)
    path.write_bytes(path.read_bytes()[:-700])


HDF5_DATA: dict[str, tuple[Any, str]] = {  # what may stand in place of observations, in either HDF5 family
    "external link": (external_link, "is a link, refused"),
    "soft link": (soft_link, "is a link, refused"),
    "external storage": (external_storage, "is kept in other files, refused"),
    "virtual dataset": (virtual, "is kept in other files, refused"),
    "unknown filter": (unknown_filter, "has filter 32015"),
    "2**50 rows": (declared((2**50, 8), chunks=(1024, 8)), "declares shape (1125899906842624, 8)"),
    "rows without data": (declared((N, 8)), "holds no data"),
    "chunk beyond the limit": (declared((1, 8), chunks=(LIMIT // 32, 8), maxshape=(None, 8)), "declares shape (1, 8)"),
    "bomb": (bomb, "more than the limit"),
    "group": (group, "is not an array"),
    "ring": (ring, "is not an array"),
    "references": (reference, "has dtype object"),
    "ragged rows": (ragged, "has dtype object"),
    "text": (np.full((N, 8), b"x"), "has dtype |S1"),
    "structure": (np.zeros((N, 8), [("x", "f4")]), "has dtype [('x'"),
    "complex": (np.zeros((N, 8), complex), "has dtype complex128"),
    "no dataspace": (null, "has dtype float64"),
}
DSRL: dict[str, Case] = {
    **{name: (_dsrl(observations=value), message) for name, (value, message) in HDF5_DATA.items()},
    "signature alone": (lambda path: path.write_bytes(b"\x89HDF\r\n\x1a\n"), "truncated or damaged HDF5"),
    "cut": (_cut, "truncated or damaged HDF5"),
    "not at the start": (lambda path: path.write_bytes(bytes(512) + b"\x89HDF\r\n\x1a\n"), "not an .npz archive"),
    "nothing in it": (lambda path: write_hdf5(path, {}), "key 'observations' is missing"),
    "no actions": (_dsrl(actions=None), "key 'actions' is missing"),
    "no terminals": (_dsrl(terminals=None), "key 'terminals' is missing"),
    "no timeouts": (_dsrl(timeouts=None), "key 'timeouts' is missing"),
    "no costs": (_dsrl(costs=None), "holds no cost of each step"),
    "no rows": (_dsrl(**{key: value[:0] for key, value in dsrl_arrays().items()}), "no episode is complete"),
    "one number": (_dsrl(observations=1.0), "'observations' has shape ()"),
    "rows differ": (_dsrl(rewards=np.ones(N - 1)), "'rewards' has shape (5,)"),
    "never ends": (_dsrl(timeouts=np.zeros(N)), "no episode is complete"),
    "flags of 2": (_dsrl(timeouts=np.full(N, 2)), "'timeouts' holds 2 (row 0), must hold flags"),
    "flags of NaN": (_dsrl(terminals=np.full(N, np.nan)), "'terminals' holds nan (row 0), must hold flags"),
    "flags in columns": (_dsrl(timeouts=np.zeros((N, 2))), "'timeouts' has shape (6, 2), must have shape (6,)"),
    "costs in columns": (_dsrl(costs=np.zeros((N, 2))), "'costs' has shape (6, 2), must have shape (6,)"),
    "NaN": (_dsrl(actions=np.full((N, 2), np.nan)), "'actions' holds NaN"),
    "negative cost": (_dsrl(costs=-np.ones(N)), "'costs' is negative"),
    "another task": (_dsrl(actions=np.ones((N, 3))), "'actions' has 3 columns"),
}


def _minari(metadata: bytes | None = b"{}", **changes: Any) -> Callable[[Path], None]:
    names = {key: key.replace("infos_", "infos/") for key in changes}
    return lambda path: write_minari(path, {names[key]: value for key, value in changes.items()}, metadata)


def _moved(name: str, *, back: bool) -> Callable[[Path], None]:
    """A part of the folder is missing, or a link to where it has gone."""

    def build(path: Path) -> None:
        _minari()(path)
        part = path / name
        part.rename(path.parent / "moved")
        if back:
            part.symlink_to((path.parent / "moved").resolve())

    return build


def _beside(name: str, value: Any) -> Callable[[Path], None]:
    """A sound dataset and one more entry."""

    def build(path: Path) -> None:
        _minari()(path)
        with h5py.File(path / "data" / "main_data.hdf5", "a") as file:
            value(file, name) if callable(value) else file.update({name: value})

    return build


def _empty_minari(path: Path) -> None:
    (path / "data").mkdir(parents=True)
    write_hdf5(path / "data" / "main_data.hdf5", {"episode_0/x": np.ones(3)})


def _data_is_a_folder(path: Path) -> None:
    (path / "data" / "main_data.hdf5").mkdir(parents=True)


def _cut_minari(path: Path) -> None:
    _minari()(path)
    file = path / "data" / "main_data.hdf5"
    file.write_bytes(file.read_bytes()[:-900])


_FACTS = "metadata.json: not a JSON object"
MINARI: dict[str, Case] = {
    **{name: (_minari(observations=value), message) for name, (value, message) in HDF5_DATA.items()},
    "linked episode": (_beside("episode_2", external_link), "'episode_2' is a link, refused"),
    "episode is an array": (_beside("episode_2", np.ones(3)), "'episode_2' is not a group"),
    "linked infos": (_minari(infos_cost=None, infos=soft_link), "'episode_0/infos' is a link"),
    "linked cost": (_minari(infos_cost=soft_link), "'episode_0/infos/cost' is a link"),
    "no observations": (_minari(observations=None), "'episode_0/observations' is missing"),
    "no actions": (_minari(actions=None), "'episode_0/actions' is missing"),
    "no terminations": (_minari(terminations=None), "'episode_0/terminations' is missing"),
    "no truncations": (_minari(truncations=None), "'episode_0/truncations' is missing"),
    "no cost": (_minari(infos_cost=None), "'episode_0' has no costs, other episodes have"),
    "cost of another length": (
        _minari(infos_cost=np.ones(6)),
        "'episode_0/infos/cost' has shape (6,), must have shape (3,) or (4,)",
    ),
    "one cost": (_minari(infos_cost=1.0), "'episode_0/infos/cost' has shape (), must have shape (3,) or (4,)"),
    "cost in columns": (
        _minari(infos_cost=np.ones((3, 2))),
        "'episode_0/infos/cost' has shape (3, 2), must have shape (3,)",
    ),
    "two costs": (
        _minari(infos_costs=np.zeros(4)),
        "'episode_0/infos/cost' and 'episode_0/infos/costs' hold different costs",
    ),
    "costs are a group": (_minari(infos_cost=group), "'episode_0/infos/cost' is not an array but a group"),
    "costs are text": (_minari(infos_cost=np.full(4, b"x")), "'episode_0/infos/cost' has dtype |S1"),
    "linked second costs": (_minari(infos_costs=soft_link), "'episode_0/infos/costs' is a link"),
    "no rewards": (_minari(rewards=None), "'episode_0' has no rewards, other episodes have"),
    "no final observation": (
        _minari(observations=np.ones((3, 8))),
        "'episode_0/observations' has shape (3, 8), must have shape (4, columns)",
    ),
    "columns differ": (
        _minari(observations=np.ones((4, 7))),
        "'obs' of trajectory 1 has shape (3, 8), trajectory 0 has (3, 7)",
    ),
    "flags of 2": (_minari(truncations=np.full(3, 2)), "'episode_0/truncations' holds 2 (row 0), must hold flags"),
    "done inside": (_minari(terminations=np.ones(3)), "'terminated' is true before"),
    "no steps": (
        _minari(**{key.replace("/", "_"): value[:0] for key, value in episode_arrays().items()}),
        "'episode_0/actions' has no rows",
    ),
    "NaN": (_minari(rewards=np.full(3, np.nan)), "'rewards' holds NaN"),
    "negative cost": (_minari(infos_cost=-np.ones(4)), "'costs' is negative"),
    "nothing known": (_empty_minari, "holds no episode"),
    "cut": (_cut_minari, "truncated or damaged HDF5"),
    "data is a folder": (_data_is_a_folder, "main_data.hdf5: not a file"),
    "no data": (_moved("data/main_data.hdf5", back=False), "not a file, and no Minari dataset"),
    "linked data": (_moved("data/main_data.hdf5", back=True), "main_data.hdf5: a link, refused"),
    "linked folder": (_moved("data", back=True), "data: a link, refused"),
    "linked metadata": (_moved("data/metadata.json", back=True), "metadata.json: a link, refused"),
    "metadata cut": (_minari(b'{"dataset_id": '), _FACTS),
    "metadata of bytes": (_minari(b"\xff\xfe"), _FACTS),
    "metadata a number": (_minari(b"1"), _FACTS),
    "metadata a list": (_minari(b"[]"), _FACTS),
    "metadata deep": (_minari(b"[" * 200_000), _FACTS),
    "metadata long": (_minari(b'{"x": "' + b"x" * 1024**2 + b'"}'), _FACTS),
}
FAMILIES: Mapping[str, Mapping[str, Case]] = {"npz": NPZ, "legacy npz": LEGACY, "DSRL": DSRL, "Minari": MINARI}
SOUND: Mapping[str, Callable[[Path], None]] = {
    "npz": _own(),
    "legacy npz": _legacy(),
    "DSRL": _dsrl(observations=compressed("gzip"), actions=compressed("lzf")),
    "Minari": _minari(),
}
