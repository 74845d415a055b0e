"""What a row of a benchmark measures, and the training that it describes."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from ccil_jax.presets import PRESETS

_LONG = 1_000_000  # environment steps of an iteration of all seeds, from which on one iteration is measured, not two


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """What a row measures."""

    task: str
    physics: str
    method: str
    num_seeds: int
    num_envs: int
    preset: str
    rounds: int  # number of measurements of each kind; in every round each kind is measured once
    seconds: float  # shortest duration of one measurement
    seed: int
    changes: Mapping[str, Any] = dataclasses.field(
        default_factory=dict
    )  # fields of `Config` that differ from the preset
    num_demonstration_steps: int = 10_000
    turns: str | None = None  # lock file, see `turns.turn`


def make_config(setting: Setting) -> Config:
    """The configuration of the training that is measured: two iterations, which make a chunk, or a single long one."""
    changes = {name: tuple(value) if isinstance(value, list) else value for name, value in setting.changes.items()}
    chosen = {"method": setting.method, "num_envs": setting.num_envs}
    # A method with a prescribed limit needs one. Its value does not matter for the speed.
    config = Config.from_base({"cost_limit": 0.0, **PRESETS[setting.preset], **changes}, chosen)
    num_iterations = 2 if setting.num_seeds * config.steps_per_iteration < _LONG else 1
    return config.replace(env_steps=num_iterations * config.steps_per_iteration)


def noise(env: Any, setting: Setting) -> Demonstrations:
    """Random demonstrations of the right shapes. Their content does not matter for the speed of learning."""
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
