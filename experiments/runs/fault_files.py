"""Diagnostic files: the state, with its random key, before an iteration that ended not finite; for `replay_fault`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccil_jax.demonstrations import npz

if TYPE_CHECKING:
    from ccil_jax.training.runner import Result

_STATE = "state:"  # stands before the names of the state's leaves


def write(folder: Path, result: "Result", seed: int) -> Path:
    """Writes fault_seed_N.npz: the state before the fault of one stopped seed, and the run's config.json."""
    import jax

    from envs.jax_tools import as_numbers

    state = jax.tree.map(lambda leaf: leaf[seed], result.state.agent)
    arrays: dict[str, Any] = {_STATE + name: np.asarray(as_numbers(leaf)) for name, leaf in _named(state).items()}
    path = folder / f"fault_seed_{seed}.npz"
    facts = (folder / "config.json").read_text(encoding="utf-8")
    npz.write(path, {"config": np.array(facts), **arrays})
    return path


def read_facts(path: Path) -> dict[str, Any]:
    """The content of the run's config.json. Raises `ArchiveError`."""
    remedy = "give a fault_seed_N.npz of a run folder"
    text = str(npz.read(path, ("config",), remedy=remedy)["config"])
    try:
        facts = json.loads(text)
    except ValueError:
        facts = None
    if not isinstance(facts, dict):
        raise npz.ArchiveError(f"{path}: 'config' is not a JSON object; {remedy}")
    return facts


def read_state(path: Path, like: Any) -> Any:
    """The state in `path`; `like` gives its structure. Raises `ArchiveError` where it does not fit."""
    import jax

    from envs.jax_tools import as_numbers, is_key

    names = _named(like)
    arrays = npz.read(path, [_STATE + name for name in names], remedy="use the version that wrote the file")
    leaves = []
    for name, leaf in names.items():
        value = arrays[_STATE + name]
        shape = jax.eval_shape(as_numbers, leaf)
        if (value.shape, value.dtype) != (shape.shape, shape.dtype):
            raise npz.ArchiveError(f"{path}: '{name}' is {value.dtype}{value.shape}; use the version that wrote it")
        leaves.append(jax.random.wrap_key_data(jax.numpy.asarray(value)) if is_key(leaf) else value)
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _named(state: Any) -> dict[str, Any]:
    import jax

    found = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in found}
