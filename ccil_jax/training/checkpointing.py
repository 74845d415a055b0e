"""Checkpoints of the whole state of a training, saved with orbax and verified. Only this module imports orbax.

Orbax writes a step to a temporary folder and renames it at the end, so that a process that is killed leaves no step
that looks finished. It does not notice flipped bits, other dtypes, a second process that writes, or a disk that becomes
full while it writes in the background. A manifest beside each step makes these visible: see `manifests`.
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
from envs.jax_tools import as_numbers

KEPT = 2  # number of checkpoints that stay on disk: the newest
_FREE = frozenset({"env_steps"})  # may always differ: a finished training may be continued for longer
_OVERHEAD = 2**20  # bytes that orbax's own files take at most, besides the arrays

_log = logging.getLogger(__name__)  # warnings go to stderr unless the program says otherwise


class Checkpointer:
    """Saves and restores one pytree for each step under `directory`. Close it, or use it as a context manager.

    Args:
        directory: made if need be. Only one process may write at a time, so hold a lock (`filesystem.hold`).
        identity: of the training. A step of another training is refused. None compares nothing.
        free: names of fields in which the configuration of a step may differ from that of `identity`, besides
            `env_steps`.
        readonly: change nothing on disk, so that checkpoints can be read while another process writes them.

    Raises:
        CheckpointError: checkpoints cannot be kept in this folder.
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
        handler = ocp.StandardCheckpointHandler()  # orbax needs it to read the structure of what is there already
        # Orbax warns that nothing will be saved, which is what `readonly` asks for.
        with _warnings_of_orbax(logging.ERROR if readonly else logging.NOTSET):
            options = ocp.CheckpointManagerOptions(
                max_to_keep=None if readonly else KEPT, create=not readonly, read_only=readonly
            )
            self._manager = ocp.CheckpointManager(self._directory, options=options, item_handlers=handler)

    def __enter__(self) -> "Checkpointer":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def latest_step(self) -> int | None:
        """The newest step that is finished and intact, or None if no step was ever finished.

        Newer steps, which are not finished or damaged, are renamed with a warning that names them.

        Raises:
            CheckpointError: there are finished steps, and all of them are damaged.
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
        if good is None and len(passed) > 1:  # a process that is killed leaves one unfinished step: this is damage
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
        """Raises `CheckpointError` if the step is of another training. Only its manifest is read."""
        folder = self._directory / str(step)
        manifests.check_identity(folder, manifests.read_manifest(folder), self._identity, self._free)

    def check_empty(self) -> None:
        """Raises `CheckpointError` if there are steps already: a new training would mix its own with them."""
        if steps := sorted(self._manager.all_steps()):
            raise CheckpointError(
                f"{self._directory}: holds checkpoints already (steps {', '.join(map(str, steps))}); resume that "
                "training, or choose another folder"
            )

    def replace(self, step: int, state: PyTree) -> None:
        """Saves as `save` does, also where another training has saved steps before.

        If the step is there already with the same arrays, nothing is done. Else all steps that are there are renamed to
        `N.replaced`, `N.replaced-2`, ..., and the step is saved.
        """
        folder = self._directory / str(step)
        with contextlib.suppress(DamageError):
            if manifests.read(folder)["arrays"] == manifests.describe(state):
                return
        for old in sorted(self._manager.all_steps()):
            self._set_aside(self._directory / str(old), "replaced")
        self.save(step, state)

    def save(self, step: int, state: PyTree) -> None:
        """Saves `state` as `step`, and waits until it is on disk with its manifest.

        Raises:
            CheckpointError: the disk is full or fails; or this step, or a later one, is there already: what is saved is
                never replaced.
        """
        needed = sum(as_numbers(leaf).nbytes for leaf in jax.tree.leaves(state)) + _OVERHEAD
        free = shutil.disk_usage(self._directory).free
        folder = self._directory / str(step)
        if folder.exists():
            raise CheckpointError(f"{folder}: exists already; resume from it, or choose another folder")
        if free < needed:
            raise CheckpointError(self._no_space(folder, needed, free))
        try:
            saved = self._manager.save(step, args=ocp.args.StandardSave(state))
            # Waiting costs little. Without it, orbax would report a failure only at the next save.
            self._manager.wait_until_finished()
            if saved:
                manifests.write(folder, state, self._identity)
        except (OSError, ValueError, RuntimeError) as error:  # TensorStore raises ValueError for errors of the system
            if _is_disk_error(error):
                free = shutil.disk_usage(self._directory).free
                raise CheckpointError(self._no_space(folder, needed, free)) from error
            raise CheckpointError(
                f"{folder}: cannot be written ({_first_line(error)}); see to the disk and resume"
            ) from error
        if not saved:  # orbax raises no error for a step that is older than the newest
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
        """The state that was saved at `step`.

        Args:
            step: one that `latest_step` has returned.
            like: the structure of the state, with the shape, dtype and sharding of each leaf.

        Raises:
            CheckpointError: what was saved has another structure, is of another training, or is damaged.
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
        """The structure of what was saved at `step`: NumPy arrays of its shapes and dtypes, with arbitrary values."""
        metadata = self._manager.item_metadata(step)
        return jax.tree.map(lambda leaf: np.empty(leaf.shape, leaf.dtype), metadata)

    def close(self) -> None:
        """Ends orbax's threads. There is nothing to wait for, because `save` has waited already."""
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
