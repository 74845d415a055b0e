"""The agent of a method: the rows of `methods.METHODS` share one, the others have their own updates."""

from ccil_jax import behavior_cloning, iq_learn, on_policy
from ccil_jax.config import Config
from ccil_jax.on_policy import Agent
from ccil_jax.types import ExpertData
from envs.base import Environment

OWN = {"bc": behavior_cloning.make, "iq_learn": iq_learn.make}


def make(config: Config, env: Environment, expert: ExpertData | None) -> Agent:
    """Builds the agent of `config.method`. `config` must be resolved; `expert` is None for task rewards."""
    return OWN.get(config.method, on_policy.make)(config, env, expert)
