"""The package's own format: an `.npz` archive of plain arrays, without pickled objects.

Keys: `obs [n, obs_dim]`, `actions [n, action_dim]`, `rewards [n]` (optional), `costs [n]`, `terminated [n]`,
`truncated [n]`, `episode_ends [E]`, and `metadata`, a JSON object as text.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.demonstrations import columns, npz
from ccil_jax.demonstrations.npz import ArchiveError

_REWRITE = "write the file with ccil_jax.save_demonstrations"


def read(path: Path) -> dict[str, Any]:
    """The arrays of the file; `rewards` is None where it has none. Raises `ArchiveError`."""
    arrays: dict[str, Any] = {"rewards": None}
    arrays.update(npz.read(path, (*columns.FORMS, "metadata"), optional=frozenset({"rewards"}), remedy=_REWRITE))
    arrays["metadata"] = _parse_metadata(arrays["metadata"], path)
    return arrays


def _parse_metadata(array: np.ndarray, path: Path) -> dict[str, Any]:
    try:
        if array.nbytes > npz.MAX_METADATA_BYTES or (array.dtype != np.uint8 and array.ndim):
            raise ValueError("not a text of reasonable length")
        text = array.tobytes().decode() if array.dtype == np.uint8 else str(array.astype(np.str_)[()])
        metadata = json.loads(text.removeprefix("\ufeff"))  # some editors begin a text with a byte order mark
    except (ValueError, RecursionError):
        metadata = None
    if not isinstance(metadata, dict):
        raise ArchiveError(f"{path}: 'metadata' is not a JSON object as text; {_REWRITE}")
    return metadata
