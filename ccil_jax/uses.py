"""To whom each hyperparameter makes a difference, derived from the table of methods.

A field of `Config` has one of these uses. From it follow the groups of options in `--help`, the note "used by ..." and
the refusal of an option that would have no effect. `tests/test_config.py` compares the uses with the traced programs.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

from ccil_jax.methods import METHODS, Method


@dataclasses.dataclass(frozen=True)
class Use:
    """Which configurations a field matters to; to all others it makes no difference, so they refuse it."""

    reads: Callable[[Method], bool]  # whether the method of a row reads the field
    # Completes "used by ..."; {methods} stands for the names of those methods, {others} for those of all others.
    note: str = "{methods}"
    where: Callable[[Any], bool] = lambda config: True  # what other fields of the `Config` must hold besides

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods that read the field."""
        return tuple(name for name, row in METHODS.items() if self.reads(row))

    @property
    def who(self) -> str:
        """Completes "used by ..."."""
        others = (name for name in METHODS if name not in self.methods)
        return self.note.format(methods=", ".join(self.methods), others=", ".join(others))

    def holds(self, config: Any) -> bool:
        """Whether the field matters to `config`."""
        return self.reads(config.row) and self.where(config)


ALL = Use(lambda row: True, "every method")
ACTING = Use(lambda row: row.agent != "behavior_cloning", "every method that acts while it learns: all but {others}")
ON_POLICY = Use(lambda row: row.agent == "on_policy", "every on-policy method: all but {others}")
TD_LAMBDA = Use(
    ON_POLICY.reads,
    "on-policy methods whose critic_target is td_lambda",
    lambda config: config.critic_target == "td_lambda",
)
IMITATING = Use(lambda row: row.imitates, "every method that imitates ({methods})")
IMITATION = Use(
    lambda row: row.agent == "on_policy" and row.reward == "discriminator",
    "methods with an imitation reward ({methods})",
)
ADVERSARIAL = Use(
    lambda row: row.reward == "discriminator",
    "methods with a discriminator ({methods}), unless imitation_reward is coherent",
    lambda config: config.imitation_reward == "discriminator",
)
PENALIZED = Use(
    ADVERSARIAL.reads,
    "methods with a discriminator whose discriminator_regularizer is gradient_penalty",
    lambda config: ADVERSARIAL.where(config) and config.discriminator_regularizer == "gradient_penalty",
)
CONSTRAINED = Use(lambda row: row.limit is not None, "methods in which the cost enters ({methods})")
STANDARDIZED = Use(
    lambda row: CONSTRAINED.reads(row) and row.constraint != "trust_region_optimal",
    "methods in which the cost enters, unless the multiplier is optimal: that one needs the cost's unit ({methods})",
    lambda config: not (config.reads("multiplier_update") and config.multiplier_update == "optimal"),
)
LIMITED = Use(lambda row: row.limit == "prescribed", "methods with a prescribed limit ({methods})")
LAGRANGIAN = Use(
    lambda row: row.constraint in ("lagrangian", "meta_lagrangian"), "methods with a choice of multiplier ({methods})"
)
ASCENT = Use(
    LAGRANGIAN.reads,
    "{methods} whose multiplier_update is adam or sgd",
    lambda config: config.multiplier_update in ("adam", "sgd"),
)
SGD = Use(
    LAGRANGIAN.reads, "{methods} whose multiplier_update is sgd", lambda config: config.multiplier_update == "sgd"
)
PID = Use(
    lambda row: row.constraint in ("lagrangian", "meta_lagrangian", "pid"),
    "{methods} with a pid controller: where multiplier_update is an option, if it is pid",
    lambda config: config.row.constraint == "pid" or config.multiplier_update == "pid",
)
MULTIPLIER = Use(
    PID.reads,
    "{methods}, unless multiplier_update is optimal",
    lambda config: config.has_multiplier,
)
MALM = Use(lambda row: row.constraint == "meta_lagrangian")
HELD_OUT = Use(MALM.reads, "{methods} whose held_out_fraction is above 0", lambda config: config.held_out_fraction > 0)
META = Use(MALM.reads, "{methods} unless meta_gradient is none", lambda config: config.meta_gradient != "none")
LAGRANGIAN_LOSS = Use(
    MALM.reads,
    "{methods} whose outer_loss is lagrangian",
    lambda config: META.holds(config) and config.outer_loss == "lagrangian",
)
CVAG = Use(lambda row: row.constraint == "alternating")
GAUSSIAN = Use(lambda row: row.agent in ("on_policy", "behavior_cloning"), "methods with a Gaussian policy ({methods})")
AVERAGED = Use(
    GAUSSIAN.reads,
    "methods with a Gaussian policy whose policy_average is polynomial_decay",
    lambda config: config.policy_average == "polynomial_decay",
)
CLONING = Use(
    lambda row: row.imitates and row.agent in ("on_policy", "behavior_cloning", "iq_learn"),
    "methods that can begin with a clone ({methods})",
)
CLONED = Use(
    lambda row: row.agent == "on_policy" and row.imitates,
    "{methods} whose cloning_updates are above 0",
    lambda config: config.cloning_updates > 0,
)
SELECTING = Use(CLONING.reads, CLONED.note, CLONED.where)
IQ_LEARN = Use(lambda row: row.agent == "iq_learn")
ACTOR = Use(
    CLONING.reads,
    "{methods}; an on-policy method only if its cloning_updates are above 0",
    lambda config: config.row.agent != "on_policy" or config.cloning_updates > 0,
)
