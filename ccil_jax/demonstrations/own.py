"""The package's own format: an `.npz` archive of plain arrays, without pickled objects.

Keys: `obs [n, obs_dim]`, `actions [n, action_dim]`, `rewards [n]` (optional), `costs [n]`, `terminated [n]`,
`truncated [n]`, `episode_ends [E]`, and `metadata`, a JSON object as text.
"""

from pathlib import Path
from typing import Any

from ccil_jax.demonstrations import columns, npz

_REWRITE = "write the file with ccil_jax.save_demonstrations"


def read(path: Path) -> dict[str, Any]:
    """The arrays of the file; `rewards` is None where it has none. Raises `ArchiveError`."""
    arrays: dict[str, Any] = {"rewards": None}
    arrays.update(npz.read(path, (*columns.FORMS, "metadata"), optional=frozenset({"rewards"}), remedy=_REWRITE))
    arrays["metadata"] = npz.json_object(arrays["metadata"], f"{path}: 'metadata'", _REWRITE)
    return arrays
