"""The agent of a method: the on-policy rows of `methods.METHODS` share one, the others have their own updates."""

from collections.abc import Callable, Mapping

from ccil_jax.agents import behavior_cloning, iq_learn, on_policy
from ccil_jax.agents.on_policy import Agent
from ccil_jax.config import Config
from ccil_jax.types import ExpertData
from envs.base import Environment

AGENTS: Mapping[str, Callable[[Config, Environment, ExpertData | None], Agent]] = {  # by the names in `METHODS`
    "on_policy": on_policy.make,
    "behavior_cloning": behavior_cloning.make,
    "iq_learn": iq_learn.make,
}


def make(config: Config, env: Environment, expert: ExpertData | None) -> Agent:
    """Builds the agent of `config.method`. `config` must be resolved; `expert` is None for task rewards."""
    return AGENTS[config.row.agent](config, env, expert)
