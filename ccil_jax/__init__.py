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
    from ccil_jax.acting.evaluation import Evaluation as Evaluation
    from ccil_jax.acting.evaluation import evaluate as evaluate
    from ccil_jax.acting.evaluation import random_policy as random_policy
    from ccil_jax.acting.evaluation import record as record
    from ccil_jax.acting.networks import Network as Network
    from ccil_jax.acting.networks import Policy as Policy
    from ccil_jax.agents.base import Agent as Agent
    from ccil_jax.agents.build import make_agent as make_agent
    from ccil_jax.config import Config as Config
    from ccil_jax.demonstrations.formats import Format as Format
    from ccil_jax.demonstrations.formats import register_format as register_format
    from ccil_jax.demonstrations.trajectories import Demonstrations as Demonstrations
    from ccil_jax.demonstrations.trajectories import load_demonstrations as load_demonstrations
    from ccil_jax.demonstrations.trajectories import save_demonstrations as save_demonstrations
    from ccil_jax.errors import ConfigError as ConfigError
    from ccil_jax.errors import UserError as UserError
    from ccil_jax.learning.constraints import Constraint as Constraint
    from ccil_jax.learning.reward_models import RewardModel as RewardModel
    from ccil_jax.methods import METHODS as METHODS
    from ccil_jax.methods import Method as Method
    from ccil_jax.methods import register_method as register_method
    from ccil_jax.presets import PRESETS as PRESETS
    from ccil_jax.training.runner import Result as Result
    from ccil_jax.training.runner import train as train
    from ccil_jax.training.runner import train_runs as train_runs

__version__ = "0.1.0"

_HOMES = {
    "Evaluation": "ccil_jax.acting.evaluation",
    "evaluate": "ccil_jax.acting.evaluation",
    "random_policy": "ccil_jax.acting.evaluation",
    "record": "ccil_jax.acting.evaluation",
    "Network": "ccil_jax.acting.networks",
    "Policy": "ccil_jax.acting.networks",
    "Agent": "ccil_jax.agents.base",
    "make_agent": "ccil_jax.agents.build",
    "Config": "ccil_jax.config",
    "Format": "ccil_jax.demonstrations.formats",
    "register_format": "ccil_jax.demonstrations.formats",
    "Demonstrations": "ccil_jax.demonstrations.trajectories",
    "load_demonstrations": "ccil_jax.demonstrations.trajectories",
    "save_demonstrations": "ccil_jax.demonstrations.trajectories",
    "ConfigError": "ccil_jax.errors",
    "UserError": "ccil_jax.errors",
    "Constraint": "ccil_jax.learning.constraints",
    "RewardModel": "ccil_jax.learning.reward_models",
    "METHODS": "ccil_jax.methods",
    "Method": "ccil_jax.methods",
    "register_method": "ccil_jax.methods",
    "PRESETS": "ccil_jax.presets",
    "Result": "ccil_jax.training.runner",
    "train": "ccil_jax.training.runner",
    "train_runs": "ccil_jax.training.runner",
}

__all__ = ["__version__", *_HOMES]

# Python looks for a package beside the script or in the current folder first, where many projects have an `envs`.
_spec = importlib.util.find_spec("envs")
_found = _spec and (_spec.origin or next(iter(_spec.submodule_search_locations or []), None))
_needed = Path(__file__).resolve().parent.parent / "envs" / "__init__.py"
if Path(str(_found)).resolve() != _needed:
    raise ImportError(
        f"ccil_jax needs the package {_needed.parent}, but Python finds {_found} under the name envs; rename that, or "
        "run from another folder (the command `ccil` starts the launchers from any)"
    )


if not TYPE_CHECKING:  # a type checker knows all names, and should report others

    def __getattr__(name: str) -> Any:
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(_HOMES[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
