"""Launchers: `ccil NAME --help`, or `python -m experiments.NAME --help`.

`python -m` looks for packages in the current folder first. A folder there that happens to be called `ccil_jax` would be
imported instead of ours. This file checks that this has not happened; `ccil_jax` checks the same of `envs`.
"""

import importlib.util
from pathlib import Path

_spec = importlib.util.find_spec("ccil_jax")
_found = _spec and (_spec.origin or next(iter(_spec.submodule_search_locations or []), None))
_needed = Path(__file__).resolve().parent.parent / "ccil_jax" / "__init__.py"
if Path(str(_found)).resolve() != _needed:
    raise ImportError(
        f"the launchers need the package {_needed.parent}, but Python finds {_found} under the name ccil_jax; start "
        "them by the command `ccil`, or from another folder"
    )
