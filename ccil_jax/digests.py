"""Manifests of checkpoints: what was saved, down to the SHA-256 of every array and of every file.

A manifest is written last, whole or not at all: a step without one was not finished.
"""

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ccil_jax.config import Config, ConfigError
from ccil_jax.files import file_sha256
from ccil_jax.types import PyTree
from ccil_jax.versions import versions
from envs.base import numbers

NAME = "manifest.json"


class CheckpointError(ConfigError):
    """A checkpoint that cannot be written or trusted. The message names the file or array, and the remedy."""


class DamageError(CheckpointError):
    """A checkpoint that is not what was written."""


def describe(tree: PyTree) -> dict[str, dict[str, Any]]:
    """`{name: {dtype, shape, sha256}}` of every leaf; shapes alone where leaves have no values."""
    found = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): _describe(leaf) for path, leaf in found}


def _describe(leaf: Any) -> dict[str, Any]:
    facts = {"dtype": str(leaf.dtype), "shape": list(leaf.shape)}
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return facts
    values = np.ascontiguousarray(numbers(leaf))
    return {**facts, "sha256": hashlib.sha256(values.tobytes()).hexdigest()}


def write(folder: Path, state: PyTree, config: Config | None) -> None:
    """Completes the step in `folder`, whose files hold `state`."""
    content = {
        "config": None if config is None else _plain(dataclasses.asdict(config)),
        "versions": versions(),
        "device": jax.devices()[0].device_kind,
        "arrays": describe(state),
        "files": {str(path.relative_to(folder)): file_sha256(path) for path in _files(folder)},
    }
    temporary = folder / f".{NAME}.tmp"
    with temporary.open("w", encoding="utf-8") as file:
        json.dump({**content, "sha256": _sha256(content)}, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(folder / NAME)


def read(folder: Path) -> dict[str, Any]:
    """The manifest of an intact step: every file is there and as it was written. Raises `DamageError`."""
    path = folder / NAME
    try:
        content = json.loads(path.read_bytes())
        sha256 = content.pop("sha256")
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise DamageError(f"{path}: missing or damaged") from None
    if sha256 != _sha256(content):
        raise DamageError(f"{path}: damaged; it disagrees with its own digest")
    present = {str(file.relative_to(folder)): file for file in _files(folder)}
    for name, expected in content["files"].items():
        if name not in present:
            raise DamageError(f"{folder / name}: missing")
        if file_sha256(present[name]) != expected:
            raise DamageError(f"{folder / name}: damaged; it is not what was written")
    if strange := sorted(set(present) - set(content["files"])):
        raise DamageError(f"{folder / strange[0]}: was not there when the checkpoint was written")
    return content


def check_config(folder: Path, manifest: Mapping[str, Any], config: Config | None, free: frozenset[str]) -> None:
    """Raises `CheckpointError` where a field of `config`, except `free`, differs from the manifest's."""
    saved = manifest["config"]
    if config is None or saved is None:
        return
    now = _plain(dataclasses.asdict(config))
    for name in sorted((saved.keys() | now.keys()) - free):
        if saved.get(name) != now.get(name):
            raise CheckpointError(
                f"{folder}: written with {name} {saved.get(name)}, this run has {now.get(name)}; "
                "continue with the configuration that it was written with, or begin a new run"
            )


def check_arrays(folder: Path, manifest: Mapping[str, Any], tree: PyTree) -> None:
    """Raises `CheckpointError` where an array's dtype or shape is not the manifest's, `DamageError` for its values."""
    saved, now = manifest["arrays"], describe(tree)
    for name in sorted(saved.keys() | now.keys()):
        for fact in ("dtype", "shape"):
            was, wanted = saved.get(name, {}).get(fact), now.get(name, {}).get(fact)
            if was != wanted:
                raise CheckpointError(
                    f"{folder}: {name} was written with {fact} {was}, this program has {wanted}; "
                    "use the version and configuration that it was written with, or begin a new run"
                )
        if "sha256" in now[name] and now[name]["sha256"] != saved[name]["sha256"]:
            raise DamageError(f"{folder}: {name} does not hold the values that were written")


def _files(folder: Path) -> list[Path]:
    hidden = (NAME, f".{NAME}.tmp")
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in hidden)


def _sha256(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _plain(value: dict[str, Any]) -> dict[str, Any]:
    """As it comes back from JSON: lists for tuples."""
    plain: dict[str, Any] = json.loads(json.dumps(value))
    return plain
