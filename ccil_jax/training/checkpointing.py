"""Whole-state checkpoints that can be believed: the only module that knows orbax.

Orbax commits a step by renaming a folder, so that a killed process leaves none half-written. What it does not notice
(flipped bits, other dtypes, a second writer, a disk that fills up behind its back) is what the manifests are for.
"""

import contextlib
import errno
import itertools
import logging
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from ccil_jax.errors import CheckpointError
from ccil_jax.training import manifests
from ccil_jax.training.filesystem import DISK_IS_FULL, unfit_for_checkpoints
from ccil_jax.training.manifests import DamageError, Identity
from ccil_jax.types import PyTree
from envs.jax_tools import numbers

KEPT = 2  # newest checkpoints that stay on disk
_FREE = frozenset({"env_steps"})  # a finished run may be continued for longer
_OVERHEAD = 2**20  # bytes of orbax's own files, at most

_log = logging.getLogger(__name__)  # warnings go to stderr unless the program says otherwise


class Checkpointer:
    """Saves and restores one pytree per step under `directory`. Close it, or use it as a context manager.

    Args:
        directory: made if need be. One writer at a time: hold its lock (`ccil_jax.training.filesystem`).
        identity: of the training; a step of another is refused.
        free: further fields in which the configurations may differ.
        readonly: never touches what is there, so that a run can be read while it is written.
    """

    def __init__(
        self,
        directory: Path,
        identity: Identity | None = None,
        *,
        free: frozenset[str] = frozenset(),
        readonly: bool = False,
    ) -> None:
        self._directory = Path(directory).resolve()  # orbax fails in the background on a relative path
        if complaint := unfit_for_checkpoints(self._directory):
            raise CheckpointError(f"{self._directory}: {complaint}")
        self._identity, self._free, self._readonly = identity, free | _FREE, readonly
        handler = ocp.StandardCheckpointHandler()  # named, so that `structure` knows how to read an older run's files
        with _warnings_of_orbax(logging.ERROR if readonly else logging.NOTSET):  # it warns of what was asked for
            options = ocp.CheckpointManagerOptions(
                max_to_keep=None if readonly else KEPT, create=not readonly, read_only=readonly
            )
            self._manager = ocp.CheckpointManager(self._directory, options=options, item_handlers=handler)

    def __enter__(self) -> "Checkpointer":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def latest_step(self) -> int | None:
        """The newest step that is finished and intact, or None if none was ever finished.

        What is newer is set aside with a warning that names it.

        Raises:
            CheckpointError: steps were finished, and every one of them is damaged.
        """
        damaged: DamageError | None = None
        passed = []
        good = None
        for step in sorted(self._manager.all_steps(), reverse=True):
            folder = self._directory / str(step)
            try:
                manifests.read(folder)
            except DamageError as error:
                passed.append((folder, error))
                damaged = error if (folder / manifests.NAME).exists() else damaged
                continue
            good = step
            break
        if good is None and len(passed) > 1:  # a kill leaves one unfinished step, no more
            damaged = damaged or passed[0][1]
        if good is None and damaged is not None:
            raise CheckpointError(f"{damaged}; no other is intact: restore it from a copy, or begin a new run")
        for folder, reason in passed:
            remedy = "starting over" if good is None else f"going on from step {good}"
            _log.warning("warning: %s; %s", reason, remedy)
            self._set_aside(folder, "damaged")
        return good

    def _set_aside(self, folder: Path, suffix: str) -> None:
        if self._readonly:
            return
        target, count = folder.with_name(f"{folder.name}.{suffix}"), itertools.count(2)
        while target.exists():
            target = folder.with_name(f"{folder.name}.{suffix}-{next(count)}")
        folder.rename(target)
        self._manager.reload()

    def check_identity(self, step: int) -> None:
        """Raises `CheckpointError` where the step is of another training; only the manifest is read."""
        folder = self._directory / str(step)
        manifests.check_identity(folder, manifests.read_manifest(folder), self._identity, self._free)

    def check_empty(self) -> None:
        """Raises `CheckpointError` where there are steps already, which a new training would mix with its own."""
        if steps := sorted(self._manager.all_steps()):
            raise CheckpointError(
                f"{self._directory}: holds checkpoints already (steps {', '.join(map(str, steps))}); resume that "
                "training, or choose another folder"
            )

    def replace(self, step: int, state: PyTree) -> None:
        """Saves as `save` does what another training may have saved here before.

        A step that holds the same arrays stays as it is; all others are set aside as `N.replaced`, `N.replaced-2`, ...
        """
        folder = self._directory / str(step)
        with contextlib.suppress(DamageError):
            if manifests.read(folder)["arrays"] == manifests.describe(state):
                return
        for old in sorted(self._manager.all_steps()):
            self._set_aside(self._directory / str(old), "replaced")
        self.save(step, state)

    def save(self, step: int, state: PyTree) -> None:
        """Saves, and proves that it is on disk.

        Raises:
            CheckpointError: the disk is full or fails, or the step is there already: what is saved is never replaced.
        """
        needed = sum(numbers(leaf).nbytes for leaf in jax.tree.leaves(state)) + _OVERHEAD
        free = shutil.disk_usage(self._directory).free
        folder = self._directory / str(step)
        if folder.exists():
            raise CheckpointError(f"{folder}: exists already; resume from it, or choose another folder")
        if free < needed:
            raise CheckpointError(self._no_space(folder, needed, free))
        try:
            saved = self._manager.save(step, args=ocp.args.StandardSave(state))
            # Waiting costs little and tells of a failure now, not one save later.
            self._manager.wait_until_finished()
            if saved:
                manifests.write(folder, state, self._identity)
        except (OSError, ValueError, RuntimeError) as error:  # TensorStore reports the system's errors as ValueError
            if _is_disk_error(error):
                free = shutil.disk_usage(self._directory).free
                raise CheckpointError(self._no_space(folder, needed, free)) from error
            raise CheckpointError(
                f"{folder}: cannot be written ({_first_line(error)}); see to the disk and resume"
            ) from error
        if not saved:  # orbax says no in silence
            raise CheckpointError(
                f"{folder}: not saved, as {self._directory} holds a later step; choose another folder"
            )

    def _no_space(self, folder: Path, needed: int, free: int) -> str:
        kept = ", ".join(str(step) for step in self._manager.all_steps() if step != int(folder.name)) or "none"
        return (
            f"{folder}: no space left on the disk; the checkpoint needs up to {needed:,} bytes, {free:,} are free; "
            f"make space and continue with --resume (steps kept: {kept})"
        )

    def restore(self, step: int, like: PyTree) -> PyTree:
        """The state saved at `step`; `like` gives structure, shapes, dtypes and shardings.

        Raises:
            CheckpointError: what was saved is something else, or damaged.
        """
        folder = self._directory / str(step)
        manifest = manifests.read(folder)
        manifests.check_identity(folder, manifest, self._identity, self._free)
        manifests.check_arrays(folder, manifest, jax.tree.map(_shape, like))
        try:
            state = self._manager.restore(step, args=ocp.args.StandardRestore(like))
        except (ValueError, KeyError, TypeError, OSError) as error:
            raise CheckpointError(f"{folder}: cannot be restored ({_first_line(error)})") from error
        manifests.check_arrays(folder, manifest, state)
        return state

    def structure(self, step: int) -> PyTree:
        """What was saved at `step`, as empty NumPy arrays of its shapes and dtypes."""
        metadata = self._manager.item_metadata(step)
        return jax.tree.map(lambda leaf: np.empty(leaf.shape, leaf.dtype), metadata)

    def close(self) -> None:
        """Frees the manager's threads. No save is in flight."""
        self._manager.close()


@contextlib.contextmanager
def _warnings_of_orbax(least: int) -> Iterator[None]:
    logger = logging.getLogger("absl")
    before = logger.level
    logger.setLevel(max(before, least))
    try:
        yield
    finally:
        logger.setLevel(before)


def _shape(leaf: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)


def _is_disk_error(error: BaseException) -> bool:
    if isinstance(error, OSError) and error.errno in DISK_IS_FULL:
        return True
    return any(os.strerror(number) in str(error) or errno.errorcode[number] in str(error) for number in DISK_IS_FULL)


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
