"""The methods: where the reward comes from, how the cost enters, and whose limit holds."""

from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

from ccil_jax import constraints
from ccil_jax.config import Config
from ccil_jax.constraints import Constraint


class Method(NamedTuple):
    """One row of the table."""

    reward: Literal["discriminator", "task"]
    constraint: Callable[[Config], Constraint]
    limit: Literal["expert", "prescribed", "none"]  # "expert": the demonstrations' mean episode cost, J_E


METHODS: Mapping[str, Method] = {
    "malm": Method("discriminator", constraints.meta_lagrangian, "expert"),
    "cvag": Method("discriminator", constraints.alternating, "expert"),
    "ccil": Method("discriminator", constraints.lagrangian, "expert"),
    "lgail": Method("discriminator", constraints.lagrangian, "prescribed"),
    "cpo_il": Method("discriminator", constraints.trust_region_optimal, "expert"),
    "pid_il": Method("discriminator", constraints.pid, "expert"),
    "gail": Method("discriminator", constraints.unconstrained, "none"),
    "trpo": Method("task", constraints.unconstrained, "none"),
    "expert": Method("task", constraints.lagrangian, "prescribed"),
}
