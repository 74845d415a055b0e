"""What a row of a benchmark measures, and the training that it describes."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.presets import PRESETS

_LONG = 1_000_000  # environment steps


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """What a row measures."""

    task: str
    physics: str
    method: str
    num_seeds: int
    num_envs: int
    preset: str
    rounds: int  # measurements of each kind, taken in turn
    seconds: float  # least duration of one measurement
    seed: int
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # to the preset: fields of `Config`
    num_demonstration_steps: int = 10_000
    turns: str | None = None  # a file: what is measured beside others waits until none of them compiles or measures


def make_config(setting: Setting) -> Config:
    """Of the training that is measured: two iterations, which make a chunk, or a single long one."""
    changes = {name: tuple(value) if isinstance(value, list) else value for name, value in setting.changes.items()}
    chosen = {"method": setting.method, "num_envs": setting.num_envs}
    # Where a limit is prescribed, any will do: it does not matter for the speed.
    config = Config.from_base({"cost_limit": 0.0, **PRESETS[setting.preset], **changes}, chosen)
    num_iterations = 2 if setting.num_seeds * config.steps_per_iteration < _LONG else 1
    return config.replace(env_steps=num_iterations * config.steps_per_iteration)


def noise(env: Any, setting: Setting) -> Demonstrations:
    """Demonstrations of the right shapes, whose content does not matter for the time it takes to learn from them."""
    random = np.random.default_rng(setting.seed)
    num_steps = setting.num_demonstration_steps
    return Demonstrations(
        obs=random.standard_normal((num_steps, env.obs_dim)).astype(np.float32),
        actions=random.uniform(env.action_low, env.action_high, (num_steps, env.action_dim)).astype(np.float32),
        rewards=None,
        costs=np.ones(num_steps, np.float32),
        terminated=np.zeros(num_steps, bool),
        truncated=np.arange(num_steps) % 1000 == 999,
        episode_ends=np.arange(1000, num_steps + 1, 1000),
    )
