"""The methods, one row each: who learns, where the reward comes from, how the cost enters, and whose limit holds.

Importing this module imports no JAX. The names in a row are keys of the tables that hold the functions:
`agents.AGENTS`, `reward_models.REWARD_MODELS` and `constraints.CONSTRAINTS`.
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple


class Method(NamedTuple):
    """One row of the table. None where the method has no such part."""

    agent: Literal["on_policy", "behavior_cloning", "iq_learn"] = "on_policy"
    reward: Literal["discriminator", "task"] | None = None
    constraint: str | None = None
    limit: Literal["demonstrations", "prescribed"] | None = None  # the first is J_E, the demonstrations' mean cost

    @property
    def imitates(self) -> bool:
        """Whether the method learns from demonstrations."""
        return self.reward != "task"


METHODS: Mapping[str, Method] = {
    "malm": Method(reward="discriminator", constraint="meta_lagrangian", limit="demonstrations"),
    "cvag": Method(reward="discriminator", constraint="alternating", limit="demonstrations"),
    "ccil": Method(reward="discriminator", constraint="lagrangian", limit="demonstrations"),
    "lgail": Method(reward="discriminator", constraint="lagrangian", limit="prescribed"),
    "gail": Method(reward="discriminator", constraint="unconstrained"),
    "cpo_il": Method(reward="discriminator", constraint="trust_region_optimal", limit="demonstrations"),
    "pid_il": Method(reward="discriminator", constraint="pid", limit="demonstrations"),
    "bc": Method(agent="behavior_cloning"),
    "iq_learn": Method(agent="iq_learn"),
    "trpo": Method(reward="task", constraint="unconstrained"),
    "expert": Method(reward="task", constraint="lagrangian", limit="prescribed"),
}
