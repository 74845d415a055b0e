"""Manifests of checkpoints: which training was saved, and the SHA-256 digest of every array and of every file.

The manifest of a step is written after everything else, and appears whole or not at all. So a step without a manifest
was not finished, and a step that disagrees with its manifest is damaged.
"""

import dataclasses
import hashlib
import json
import operator
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ccil_jax import earlier_versions
from ccil_jax.config import Config, unused
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.errors import CheckpointError
from ccil_jax.training.filesystem import file_sha256
from ccil_jax.training.versions import versions
from ccil_jax.types import PyTree
from envs.base import Environment
from envs.jax_tools import as_numbers

NAME = "manifest.json"


class DamageError(CheckpointError):
    """A checkpoint that is not as it was written, or was not finished."""


def describe(tree: PyTree) -> dict[str, dict[str, Any]]:
    """`{name: {dtype, shape, sha256}}` of every leaf; without `sha256` where a leaf has no values."""
    found = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): _describe(leaf) for path, leaf in found}


def _describe(leaf: Any) -> dict[str, Any]:
    facts = {"dtype": str(leaf.dtype), "shape": list(leaf.shape)}
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return facts
    values = np.ascontiguousarray(as_numbers(leaf))
    return {**facts, "sha256": hashlib.sha256(values.tobytes()).hexdigest()}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Identity:
    """Which training a checkpoint is of. A field that is None is not known, and is not compared.

    The training has [len(configs) * num_seeds] runs: all seeds of the first configuration, then all of the second, ...
    """

    configs: tuple[Config, ...]  # resolved
    num_seeds: int | None = None  # of each configuration
    seed: int | None = None  # from which the random keys of the seeds are made
    task: str | None = None
    max_episode_steps: int | None = None
    demonstrations: str | None = None  # `demonstrations_sha256`; "none" where the method does not imitate


def identity_of(
    configs: Sequence[Config], env: Environment, demonstrations: Demonstrations | None, num_seeds: int, seed: int
) -> Identity:
    """The identity of a training of these configurations, which must be resolved."""
    learnt_from = demonstrations if configs[0].row.imitates else None
    return Identity(
        configs=tuple(configs),
        num_seeds=num_seeds,
        seed=seed,
        task=env.name,
        max_episode_steps=env.max_episode_steps,
        demonstrations="none" if learnt_from is None else demonstrations_sha256(learnt_from),
    )


def demonstrations_sha256(demonstrations: Demonstrations) -> str:
    """The SHA-256 digest of all arrays that a learner uses. It does not depend on the file that they came from."""
    digest = hashlib.sha256()
    for name in ("obs", "actions", "costs", "terminated", "truncated", "episode_ends"):
        array = np.ascontiguousarray(getattr(demonstrations, name))
        digest.update(f"{name} {array.dtype} {array.shape} ".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def write(folder: Path, state: PyTree, identity: Identity | None) -> None:
    """Writes the manifest of the step in `folder`, whose files hold `state`. With it the step is finished."""
    content = {
        "identity": None if identity is None else _plain(dataclasses.asdict(identity)),
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


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a step. No other file is read. Raises `DamageError` if the manifest is missing or damaged."""
    path = folder / NAME
    try:
        content = json.loads(path.read_bytes())
        sha256 = content.pop("sha256")
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise DamageError(f"{path}: missing or damaged") from None
    if sha256 != _sha256(content):
        raise DamageError(f"{path}: damaged; it disagrees with its own digest")
    plain: dict[str, Any] = content
    return plain


def read(folder: Path) -> dict[str, Any]:
    """The manifest of a step, after checking that every file is there and as it was written. Raises `DamageError`."""
    content = read_manifest(folder)
    present = {str(file.relative_to(folder)): file for file in _files(folder)}
    for name, expected in content["files"].items():
        if name not in present:
            raise DamageError(f"{folder / name}: missing")
        if file_sha256(present[name]) != expected:
            raise DamageError(f"{folder / name}: damaged; it is not what was written")
    if strange := sorted(set(present) - set(content["files"])):
        raise DamageError(f"{folder / strange[0]}: was not there when the checkpoint was written")
    return content


def check_identity(folder: Path, manifest: Mapping[str, Any], identity: Identity | None, free: frozenset[str]) -> None:
    """Raises `CheckpointError` if the step is of another training than `identity`.

    Fields of configurations that are in `free`, or that the method does not use, may differ. A field that the step does
    not name is newer than the step, and counts as its default, see `earlier_versions`.
    """
    saved = manifest.get("identity") or _identity_of_older(manifest)
    if identity is None or saved is None:
        return
    now = _plain(dataclasses.asdict(identity))
    for name in sorted(now.keys() - {"configs"}):
        if now[name] is not None and saved.get(name) is not None and saved[name] != now[name]:
            raise _other(folder, name, saved[name], now[name])
    if saved.get("num_seeds") is not None and len(saved["configs"]) != len(now["configs"]):
        raise _other(folder, "number of configurations", len(saved["configs"]), len(now["configs"]))
    for config, named, after in zip(identity.configs, saved["configs"], now["configs"], strict=False):
        before = _plain(dataclasses.asdict(Config())) | earlier_versions.without_unread(named, config.row)
        for name in sorted((before.keys() | after.keys()) - free - set(unused(config))):
            if name in earlier_versions.GONE:
                raise CheckpointError(f"{folder}: {earlier_versions.refusal(name, before[name])}")
            if before.get(name) != after.get(name):
                raise _other(folder, name, before.get(name), after.get(name))


def _identity_of_older(manifest: Mapping[str, Any]) -> dict[str, Any] | None:
    """The identity in a manifest of early versions, which held only the first configuration."""
    return {"configs": [manifest["config"]]} if manifest.get("config") else None


def _other(folder: Path, name: str, saved: Any, now: Any) -> CheckpointError:
    return CheckpointError(
        f"{folder}: written with {name} {saved}, this run has {now}; continue with what it was written with, or begin "
        "a new run in another folder"
    )


def check_arrays(folder: Path, manifest: Mapping[str, Any], tree: PyTree) -> None:
    """Raises `CheckpointError` if an array of `tree` has another dtype or shape than the manifest says.

    Raises `DamageError` if it has other values.
    """
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
    """`value` as it would be read back from JSON: with lists for tuples, and Python's numbers for NumPy's."""
    plain: dict[str, Any] = json.loads(json.dumps(value, default=operator.methodcaller("item")))
    return plain
