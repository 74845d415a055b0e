"""Whole-state checkpoints: the only module that knows orbax."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from ccil_jax.config import ConfigError
from ccil_jax.types import PyTree

KEPT = 2  # newest checkpoints that stay on disk


class CheckpointError(ConfigError):
    """A checkpoint that does not fit. The message names it and the likely reason."""


class Checkpointer:
    """Saves and restores one pytree per step under `directory`. Close it, or use it as a context manager."""

    def __init__(self, directory: Path) -> None:
        # Orbax fails in the background on a relative path.
        options = ocp.CheckpointManagerOptions(max_to_keep=KEPT, create=True)
        handler = ocp.StandardCheckpointHandler()  # named, so that `structure` knows how to read an older run's files
        self._manager = ocp.CheckpointManager(directory.resolve(), options=options, item_handlers=handler)

    def __enter__(self) -> "Checkpointer":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def latest_step(self) -> int | None:
        """The newest finished step, or None."""
        return self._manager.latest_step()

    def save(self, step: int, state: PyTree) -> None:
        """Starts saving; returns once the arrays are copied, so that the caller may donate them."""
        self._manager.save(step, args=ocp.args.StandardSave(state))

    def restore(self, step: int, like: PyTree) -> PyTree:
        """The state saved at `step`; `like` gives structure, shapes, dtypes and shardings.

        Raises:
            CheckpointError: what was saved is something else, or damaged.
        """
        try:
            return self._manager.restore(step, args=ocp.args.StandardRestore(like))
        except (ValueError, KeyError, TypeError) as error:
            raise CheckpointError(
                f"{self._manager.directory}/{step}: cannot be restored; it was damaged, or written under another "
                f"configuration or version of ccil_jax ({str(error).splitlines()[0]})"
            ) from error

    def structure(self, step: int) -> PyTree:
        """What was saved at `step`, as empty NumPy arrays of its shapes and dtypes."""
        metadata = self._manager.item_metadata(step)
        return jax.tree.map(lambda leaf: np.empty(leaf.shape, leaf.dtype), metadata)

    def close(self) -> None:
        """Waits for saves in flight."""
        self._manager.wait_until_finished()
        self._manager.close()
