"""Cost-constrained imitation learning in JAX.

    import ccil_jax, envs
    env = envs.make("Swimmer")
    demonstrations = ccil_jax.load_demonstrations("expert.npz")
    result = ccil_jax.train(ccil_jax.Config(method="malm"), env, demonstrations, num_seeds=3)

Names are imported on first use (PEP 562): importing the package imports no JAX.
"""

import importlib
import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ccil_jax.acting.evaluation import evaluate
    from ccil_jax.config import Config
    from ccil_jax.demonstrations.trajectories import Demonstrations, load_demonstrations, save_demonstrations
    from ccil_jax.methods import METHODS
    from ccil_jax.training.runner import Result, train, train_runs

__version__ = "0.1.0"

__all__ = [
    "METHODS",
    "Config",
    "Demonstrations",
    "Result",
    "__version__",
    "evaluate",
    "load_demonstrations",
    "save_demonstrations",
    "train",
    "train_runs",
]

# Python looks for a package beside the script or in the current folder first, where many projects have an `envs`.
_spec = importlib.util.find_spec("envs")
_found = _spec and (_spec.origin or next(iter(_spec.submodule_search_locations or []), None))
_needed = Path(__file__).resolve().parent.parent / "envs" / "__init__.py"
if Path(str(_found)).resolve() != _needed:
    raise ImportError(
        f"ccil_jax needs the package {_needed.parent}, but Python finds {_found} under the name envs; rename that, or "
        "run from another folder (the command `ccil` starts the launchers from any)"
    )

_HOMES = {
    "Config": "ccil_jax.config",
    "Demonstrations": "ccil_jax.demonstrations.trajectories",
    "load_demonstrations": "ccil_jax.demonstrations.trajectories",
    "save_demonstrations": "ccil_jax.demonstrations.trajectories",
    "evaluate": "ccil_jax.acting.evaluation",
    "METHODS": "ccil_jax.methods",
    "Result": "ccil_jax.training.runner",
    "train": "ccil_jax.training.runner",
    "train_runs": "ccil_jax.training.runner",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
