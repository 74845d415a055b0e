"""The package's own format: an `.npz` archive of plain arrays, without pickled objects.

Keys: `obs [n, obs_dim]`, `actions [n, action_dim]`, `rewards [n]` (optional), `costs [n]`, `terminated [n]`,
`truncated [n]`, `episode_ends [E]`, `final_obs [E, obs_dim]` (optional), and `metadata`, a JSON object as text.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccil_jax.demonstrations import columns, npz

_REWRITE = "write the file with ccil_jax.save_demonstrations"


def read(path: Path) -> dict[str, Any]:
    """The arrays of the file; None in the place of those that it may lack and does. Raises `ArchiveError`."""
    arrays: dict[str, Any] = dict.fromkeys(columns.OPTIONAL)
    arrays.update(npz.read(path, (*columns.FORMS, "metadata"), optional=columns.OPTIONAL, remedy=_REWRITE))
    arrays["metadata"] = npz.json_object(arrays["metadata"], f"{path}: 'metadata'", _REWRITE)
    return arrays


def write(path: Path, arrays: Mapping[str, Any], metadata: Mapping[str, Any]) -> None:
    """Writes a file, whole or not at all. Equal demonstrations give equal bytes. Raises `OSError`."""
    present = {key: array for key, array in arrays.items() if array is not None}
    npz.write(path, {**present, "metadata": np.array(json.dumps(metadata, sort_keys=True))})
