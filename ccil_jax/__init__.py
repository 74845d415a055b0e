"""Cost-constrained imitation learning in JAX.

    import ccil_jax, envs
    env = envs.make("Swimmer")
    demonstrations = ccil_jax.load_demonstrations("expert.npz")
    result = ccil_jax.train(ccil_jax.Config(method="malm"), env, demonstrations, num_seeds=3)

Names are imported on first use (PEP 562): importing the package imports no JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ccil_jax.config import Config
    from ccil_jax.demonstrations import Demonstrations, load_demonstrations, save_demonstrations
    from ccil_jax.evaluation import evaluate
    from ccil_jax.methods import METHODS
    from ccil_jax.runner import Result, train, train_runs

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

_HOMES = {
    "Config": "ccil_jax.config",
    "Demonstrations": "ccil_jax.demonstrations",
    "load_demonstrations": "ccil_jax.demonstrations",
    "save_demonstrations": "ccil_jax.demonstrations",
    "evaluate": "ccil_jax.evaluation",
    "METHODS": "ccil_jax.methods",
    "Result": "ccil_jax.runner",
    "train": "ccil_jax.runner",
    "train_runs": "ccil_jax.runner",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
