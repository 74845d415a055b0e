"""Hyperparameters. Importing this module imports no JAX, so launchers can answer `--help` at once.

Every field is static (it shapes the program: changing it compiles anew) or traced (a number inside the program:
sweeping it needs no compilation, and it may differ between vmapped runs).
"""

import dataclasses
import math
import numbers
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from ccil_jax.errors import ConfigError
from ccil_jax.methods import METHODS, Method

CHOICES: Mapping[str, tuple[str, ...]] = {
    "method": tuple(METHODS),
    "activation": ("tanh", "relu", "swish"),
    "meta_gradient": ("full", "direct", "indirect", "none"),
    "outer_advantage": ("stale", "re-evaluated"),
    "held_out_unit": ("transition", "trajectory"),
    "multiplier_update": ("adam", "sgd", "pid", "optimal"),
    "meta_update": ("adam", "sgd"),
    "gate": ("batch", "episode"),
    "reward_form": ("softplus", "logit", "log_sigmoid"),
    "discriminator_regularizer": ("none", "gradient_penalty", "spectral_norm"),
    "value_loss": ("value", "v0"),
}


class Use(NamedTuple):
    """Which configurations a field matters to; to all others it makes no difference, so they refuse it."""

    who: str  # completes "used by ..."
    methods: tuple[str, ...]
    where: Callable[["Config"], bool] = lambda config: True  # what other fields must hold besides

    def holds(self, config: "Config") -> bool:
        """Whether the field matters to `config`."""
        return config.method in self.methods and self.where(config)


def _methods(who: str, holds: Callable[[Method], bool]) -> Use:
    """A use that the method alone decides."""
    return Use(who, tuple(name for name, row in METHODS.items() if holds(row)))


def _named(who: str, holds: Callable[[Method], bool]) -> Use:
    """The same, with the names of the methods beside it, or in its place where `who` is empty."""
    names = ", ".join(_methods(who, holds).methods)
    return _methods(f"{who} ({names})" if who else names, holds)


ALL = _methods("every method", lambda row: True)
ACTING = _methods("every method that acts while it learns: all but bc", lambda row: row.agent != "behavior_cloning")
ON_POLICY = _methods("every on-policy method: all but bc and iq_learn", lambda row: row.agent == "on_policy")
ADVERSARIAL = _named("methods with a discriminator", lambda row: row.reward == "discriminator")
PENALIZED = Use(
    "methods with a discriminator whose discriminator_regularizer is gradient_penalty",
    ADVERSARIAL.methods,
    lambda config: config.discriminator_regularizer == "gradient_penalty",
)
CONSTRAINED = _named("methods in which the cost enters", lambda row: row.limit is not None)
LIMITED = _named("methods with a prescribed limit", lambda row: row.limit == "prescribed")
LAGRANGIAN = _named(
    "methods with a choice of multiplier", lambda row: row.constraint in ("lagrangian", "meta_lagrangian")
)
ASCENT = Use(
    f"{', '.join(LAGRANGIAN.methods)} whose multiplier_update is adam or sgd",
    LAGRANGIAN.methods,
    lambda config: config.multiplier_update in ("adam", "sgd"),
)
PID = Use(
    f"pid_il, and {', '.join(LAGRANGIAN.methods)} whose multiplier_update is pid",
    (*LAGRANGIAN.methods, "pid_il"),
    lambda config: config.row.constraint == "pid" or config.multiplier_update == "pid",
)
MULTIPLIER = Use(
    f"pid_il, and {', '.join(LAGRANGIAN.methods)} unless multiplier_update is optimal",
    PID.methods,
    lambda config: config.has_multiplier,
)
MALM = _named("", lambda row: row.constraint == "meta_lagrangian")
HELD_OUT = Use("malm whose held_out_fraction is above 0", MALM.methods, lambda config: config.held_out_fraction > 0)
META = Use("malm unless meta_gradient is none", MALM.methods, lambda config: config.meta_gradient != "none")
CVAG = _named("", lambda row: row.constraint == "alternating")
BC = _named("", lambda row: row.agent == "behavior_cloning")
IQ_LEARN = _named("", lambda row: row.agent == "iq_learn")
OFF_POLICY = _named("", lambda row: row.agent != "on_policy")


def _static(default: Any, help: str, use: Use = ON_POLICY) -> Any:
    return dataclasses.field(default=default, metadata={"traced": False, "help": help, "use": use})


def _traced(default: float | None, help: str, use: Use = ON_POLICY) -> Any:
    return dataclasses.field(default=default, metadata={"traced": True, "help": help, "use": use})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """All choices of one training program. Defaults are Table 1 of the paper (`paper` preset).

    Sources beyond Table 1 are in the field's help text; "authors" means the paper's public code.
    """

    method: str = _static("malm", "row of the methods table", ALL)
    env_steps: int = _static(3_000_000, "environment steps per seed, rounded up to whole iterations", ACTING)
    num_envs: int = _static(16, "simulations stepped side by side, per seed", ACTING)
    batch_size: int = _static(2000, "environment steps per generator step, K (Table 1)", ACTING)
    generator_steps: int = _static(3, "policy updates per iteration, each on a fresh batch (Table 1)", ACTING)
    discriminator_steps: int = _static(
        1, "discriminator updates per iteration (Table 1), each a pass over the last batch in minibatches", ADVERSARIAL
    )
    discriminator_minibatch_size: int = _static(
        128,
        "samples of either class per discriminator gradient step; the authors take the whole batch at once",
        ADVERSARIAL,
    )
    held_out_fraction: float = _static(0.3, "share of the batch kept for the outer loss (authors)", MALM)
    hidden_sizes: tuple[int, ...] = _static(
        (100, 100), "hidden layers of policy, critics and discriminator (Table 1)", ALL
    )
    activation: str = _static("tanh", "activation of every network (Table 1)", ALL)
    meta_gradient: str = _static("full", "outer step: total derivative, one of its two parts, or none", MALM)
    outer_advantage: str = _static(
        "stale",
        "outer loss: advantages as the policy step saw them (authors), or by the updated networks",
        META,
    )
    held_out_unit: str = _static(
        "transition",
        "what is drawn for the outer loss: steps (authors), or whole simulations' stretches of the batch",
        HELD_OUT,
    )
    multiplier_update: str = _static(
        "adam",
        "dual step: adam on softplus(xi) (authors), projected sgd (Algorithm 1), a pid controller, or the optimal "
        "value for each single step",
        LAGRANGIAN,
    )
    meta_update: str = _static(
        "adam", "outer step: adam on the multiplier's parameter (authors) or sgd on lambda (line 16)", META
    )
    gate: str = _static("batch", "one decision per batch (Algorithm 2) or per episode (authors)", CVAG)
    reward_form: str = _static(
        "softplus", "imitation reward from the logit h: softplus(h) = -log D, h, or log sigmoid(h)", ADVERSARIAL
    )
    discriminator_regularizer: str = _static("gradient_penalty", "what keeps the discriminator smooth", ADVERSARIAL)
    cg_iterations: int = _static(10, "conjugate-gradient iterations (authors)")
    fisher_stride: int = _static(5, "the Fisher product uses every n-th sample (authors)")
    line_search_steps: int = _static(10, "halvings of the policy step before it is rejected (authors)")
    critic_epochs: int = _static(5, "passes over the batch per critic regression (authors)")
    critic_minibatch_size: int = _static(
        128, "samples per critic gradient step (authors); per step of bc; of either source per step of iq_learn", ALL
    )
    standardize_cost_advantage: bool = _static(False, "also divide the cost advantage by its deviation", CONSTRAINED)
    bootstrap_at_truncation: bool = _static(True, "use the critic's value at a time limit; false zeroes it (authors)")
    bc_epochs: int = _static(200, "passes over the demonstrations; each is an iteration", BC)
    replay_size: int = _static(
        200_000, "latest steps that are learnt from (published: 1e6, never filled here)", IQ_LEARN
    )
    updates_per_step: int = _static(1, "gradient updates per environment step (published)", IQ_LEARN)
    value_loss: str = _static(
        "value",
        "second term of the loss: V - y over expert and learner, or v0, (1 - gamma) V at first states",
        IQ_LEARN,
    )
    max_skipped_updates: int = _static(
        10, "a seed stops after so many iterations in a row that were not finite; each is taken back", ALL
    )

    gamma: float = _traced(0.995, "discount of reward and cost (Table 1)", ACTING)
    gae_lambda: float = _traced(0.97, "decay of generalised advantage estimation, of the reward (Table 1)")
    cost_gae_lambda: float = _traced(0.97, "the same, of the cost (Table 1)", CONSTRAINED)
    max_kl: float = _traced(0.01, "trust-region radius, nats (Table 1)")
    kl_tolerance: float = _traced(1.5, "a step is accepted up to this multiple of max_kl (authors)")
    cg_damping: float = _traced(0.1, "added to the Fisher matrix's diagonal (authors)")
    critic_learning_rate: float = _traced(1e-3, "Adam, both critics (Table 1)", ACTING)
    discriminator_learning_rate: float = _traced(3e-4, "Adam (Table 1)", ADVERSARIAL)
    policy_entropy_coefficient: float = _traced(0.0, "beta, weight of the policy's entropy (Table 1)")
    discriminator_entropy_coefficient: float = _traced(
        1e-3, "weight of the discriminator's entropy bonus (Table 1)", ADVERSARIAL
    )
    gradient_penalty_coefficient: float = _traced(1.0, "weight of the gradient penalty", PENALIZED)
    initial_multiplier: float = _traced(0.01, "lambda before the first iteration (Table 1)", MULTIPLIER)
    multiplier_learning_rate: float = _traced(0.05, "dual step size (Table 1)", ASCENT)
    meta_learning_rate: float = _traced(0.05, "outer step size (Table 1)", META)
    multiplier_max: float = _traced(100.0, "cap of the multiplier", MULTIPLIER)
    pid_proportional_gain: float = _traced(0.5, "of the smoothed cost gap, relative to the limit", PID)
    pid_integral_gain: float = _traced(0.05, "of the sum of relative gaps", PID)
    pid_derivative_gain: float = _traced(0.5, "of the rise of the smoothed relative gap", PID)
    pid_smoothing: float = _traced(0.9, "share of the previous smoothed gap that stays", PID)
    actor_learning_rate: float = _traced(1e-3, "Adam, policy of bc and iq_learn", OFF_POLICY)
    target_update_rate: float = _traced(0.005, "Polyak average of the target critic (published)", IQ_LEARN)
    chi2_coefficient: float = _traced(0.5, "alpha of the chi-square term, r^2 / (4 alpha) (published)", IQ_LEARN)
    temperature: float | None = _traced(None, "weight of the entropy; none: the task's published value", IQ_LEARN)
    cost_limit: float | None = _traced(
        None, "episode cost limit; all other constrained methods take the demonstrations' mean", LIMITED
    )

    @classmethod
    def from_preset(cls, preset: str, **changes: Any) -> "Config":
        """The preset with `changes` on top. What it says of fields that the method does not use is left out.

        Raises:
            ConfigError: the preset or a field is unknown, or a change is of a field that the method does not use.
        """
        if preset not in PRESETS:
            raise ConfigError(f"--preset {preset!r}: unknown; choose one of {', '.join(PRESETS)}")
        return cls.from_base(PRESETS[preset], changes)

    @classmethod
    def from_base(cls, base: Mapping[str, Any], changes: Mapping[str, Any]) -> "Config":
        """As `from_preset`, with the fields of the preset given."""
        if unknown := changes.keys() - _DEFAULTS.keys():
            raise ConfigError(f"--{min(unknown)}: unknown; no field of Config has that name")
        config = cls(**{**base, **changes})
        check_types(config)
        check_used(config, changes)
        return config.replace(**{name: _DEFAULTS[name] for name in unused(config) if name not in changes})

    @property
    def row(self) -> Method:
        """The method's row of the table."""
        return METHODS[self.method]

    @property
    def prescribed_limit(self) -> float | None:
        """The episode cost limit that the user has given; None where the method has none, or the demonstrations'."""
        return self.cost_limit if self.row.limit == "prescribed" else None

    @property
    def has_multiplier(self) -> bool:
        """Whether the cost is weighed by a multiplier that is carried from one iteration to the next."""
        return self.row.constraint == "pid" or (LAGRANGIAN.holds(self) and self.multiplier_update != "optimal")

    @property
    def num_steps(self) -> int:
        """T: steps per simulation and generator step."""
        return self.batch_size // self.num_envs

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps that one iteration of one seed consumes; behaviour cloning needs none."""
        return 0 if BC.holds(self) else self.generator_steps * self.batch_size

    @property
    def num_iterations(self) -> int:
        """Iterations needed to consume at least `env_steps`; passes over the demonstrations for behaviour cloning."""
        return self.bc_epochs if BC.holds(self) else math.ceil(self.env_steps / self.steps_per_iteration)

    @property
    def num_held_out(self) -> int:
        """V: samples kept for the outer loss; 0 for every method but malm."""
        if not MALM.holds(self):
            return 0
        if self.held_out_unit == "trajectory":
            return int(self.held_out_fraction * self.num_envs) * self.num_steps
        return int(self.held_out_fraction * self.batch_size)

    @property
    def num_training(self) -> int:
        """M: samples of the policy step and the critic regressions."""
        return self.batch_size - self.num_held_out

    def replace(self, **changes: Any) -> "Config":
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)


def field_names(*, traced: bool) -> tuple[str, ...]:
    """Names of the traced or of the static fields, in declaration order."""
    return tuple(f.name for f in dataclasses.fields(Config) if f.metadata["traced"] is traced)


_USES: Mapping[str, Use] = {f.name: f.metadata["use"] for f in dataclasses.fields(Config)}
_DEFAULTS: Mapping[str, Any] = {f.name: f.default for f in dataclasses.fields(Config)}


def unused(config: Config) -> tuple[str, ...]:
    """Names of the fields that make no difference to what `config` trains.

    `cost_limit` is among them where a method takes its limit from the demonstrations: it is not for the user to give.
    """
    return tuple(name for name, use in _USES.items() if not use.holds(config))


def relevant(config: Config) -> dict[str, Any]:
    """The fields that tell one training from another, by name. The limit of the demonstrations' is told by them."""
    idle = unused(config)
    return {name: value for name, value in dataclasses.asdict(config).items() if name not in idle}


def with_limit_of(config: Config, mean_episode_cost: float) -> Config:
    """The configuration with its cost limit resolved: J_E where the method takes it from the demonstrations.

    Raises:
        ConfigError: another limit was given by hand.
    """
    if config.row.limit != "demonstrations":
        return config
    if config.cost_limit not in (None, mean_episode_cost):
        raise ConfigError(_limit_by_hand(config))
    return config.replace(cost_limit=mean_episode_cost)


def _limit_by_hand(config: Config) -> str:
    return (
        f"--cost_limit {config.cost_limit}: method {config.method} is held to the mean cost of its demonstrations; "
        "leave it out, or use --method lgail for a limit of your own"
    )


def check_used(config: Config, given: Iterable[str]) -> None:
    """Raises `ConfigError` for the first of the fields `given` by hand that makes no difference to `config`."""
    idle = unused(config)
    for name in given:
        if name not in idle:
            continue
        if name == "cost_limit" and config.row.limit == "demonstrations":
            raise ConfigError(_limit_by_hand(config))
        raise ConfigError(
            f"--{name} {getattr(config, name)}: makes no difference to this run of method {config.method}; leave it "
            f"out (used by {_USES[name].who})"
        )


PRESETS: Mapping[str, Mapping[str, Any]] = {
    # Table 1 says "1 discriminator update" for 3 policy steps. One full-batch step trails the policy (on Swimmer the
    # two went round in circles), hence minibatches; without a penalty the discriminator then wins outright where the
    # classes part easily (HalfCheetah).
    "paper": {},
    # The best of what docs/ablations.md measures at this length: CVAG's gate by episode, and a multiplier that moves
    # with the size of the gap (CCIL: 74 % of the return instead of 58 on HalfCheetah, 98 instead of 66 on Swimmer).
    "default": {
        "env_steps": 1_500_000,
        "gate": "episode",
        "multiplier_update": "sgd",
        "multiplier_learning_rate": 5e-4,
    },
    # Algorithm 1 line by line: one full-batch step of the discriminator, lambda itself projected to [0, max], and the
    # derivative of line 16 with the policy and its advantages held fixed.
    "printed": {
        "meta_gradient": "direct",
        "multiplier_update": "sgd",
        "meta_update": "sgd",
        "discriminator_minibatch_size": 2000,
        "discriminator_regularizer": "none",
    },
    # What the authors' code does: Adam on xi for both steps of the multiplier, CVAG's gate by episode, no value beyond
    # a time limit. It counts the steps of one batch of the three, so its 1e7 are 3e7 here.
    "authors": {
        "meta_gradient": "direct",
        "gate": "episode",
        "bootstrap_at_truncation": False,
        "discriminator_minibatch_size": 2000,
        "discriminator_regularizer": "none",
    },
    # No discriminator has to keep up with the policy: one larger batch and a wider trust region per iteration.
    "expert": {"env_steps": 2_000_000, "batch_size": 4000, "generator_steps": 1, "max_kl": 0.02, "gamma": 0.99},
    # Costs are rare here (some 25 visits of a hazard in 20,000 steps), so their gradient is mostly noise. Hence large
    # batches, small steps, and a multiplier that slows down as the cost nears its limit: Adam's walks past it. A short
    # lambda for the cost leaves the critic's errors in charge: with 0.8 PointGoal1's cost did not fall at all.
    "safety_gym_expert": {
        "env_steps": 8_000_000,
        "num_envs": 32,
        "batch_size": 20_000,
        "generator_steps": 1,
        "gamma": 0.99,
        "gae_lambda": 0.9,
        "critic_learning_rate": 3e-4,
        "initial_multiplier": 0.0,
        "multiplier_update": "sgd",
        "multiplier_learning_rate": 7e-4,
    },
    "bc": {"method": "bc"},
    # As published, but for the length: 60,000 steps with as many updates sufficed on HalfCheetah.
    "iq_learn": {
        "method": "iq_learn",
        "env_steps": 100_000,
        "num_envs": 4,
        "batch_size": 1000,
        "generator_steps": 1,
        "hidden_sizes": (256, 256),
        "activation": "relu",
        "gamma": 0.99,
        "critic_learning_rate": 3e-4,
        "actor_learning_rate": 3e-5,
        "critic_minibatch_size": 256,
    },
    "tiny": {
        "env_steps": 240,
        "num_envs": 4,
        "batch_size": 40,
        "hidden_sizes": (8, 8),
        "discriminator_minibatch_size": 20,
        "critic_minibatch_size": 10,
        "critic_epochs": 2,
    },
}


def check_types(config: Config) -> None:
    """Raises `ConfigError` for a value of another kind than the field's: one that is no choice, or no such number."""
    for name, default in _DEFAULTS.items():
        value = getattr(config, name)
        if name in CHOICES:
            if value not in CHOICES[name]:
                raise ConfigError(f"--{name} {value!r}: unknown; choose one of {', '.join(CHOICES[name])}")
            continue
        if isinstance(default, bool):
            sound, wanted = isinstance(value, bool), "True or False"
        elif isinstance(default, tuple):
            sound, wanted = isinstance(value, tuple) and all(map(is_integer, value)), "a tuple such as (100, 100)"
        elif isinstance(default, int):
            sound, wanted = is_integer(value), "an integer"
        else:
            sound, wanted = _is_number(value) or (value is None and default is None), "a number"
        if not sound:
            raise ConfigError(f"--{name} {value!r}: give {wanted}")


def _is_number(value: Any) -> bool:
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        return False
    try:
        float(value)
    except OverflowError:  # an integer beyond all floats
        return False
    return True


def is_integer(value: Any) -> bool:
    """Whether the value is an integer of Python or NumPy, and no boolean."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def validate(config: Config) -> None:
    """Raises `ConfigError` for a combination that cannot run, before anything is compiled.

    A field that makes no difference must have its default: any other value was given by hand, in vain. A resolved
    limit of the demonstrations' is let through; `with_limit_of` compares it with them.
    """
    check_types(config)
    resolved = {"cost_limit"} if config.row.limit == "demonstrations" else set()
    check_used(config, (n for n in _USES if getattr(config, n) != _DEFAULTS[n] and n not in resolved))
    for name, default in _DEFAULTS.items():
        if is_integer(default) and getattr(config, name) < 1:
            raise ConfigError(f"--{name} {getattr(config, name)}: must be at least 1")
    if not config.hidden_sizes or min(config.hidden_sizes) < 1:
        raise ConfigError(f"--hidden_sizes {config.hidden_sizes}: give at least one layer of at least one unit")
    for name in field_names(traced=True):
        value = getattr(config, name)
        if value is not None and not (math.isfinite(value) and value >= 0):
            raise ConfigError(f"--{name} {value}: must be finite and not negative")
    for name in ("gamma", "gae_lambda", "cost_gae_lambda"):
        if getattr(config, name) > 1:
            raise ConfigError(f"--{name} {getattr(config, name)}: must be at most 1")
    if config.max_kl == 0:
        raise ConfigError("--max_kl 0: the policy could never move; give a positive radius such as 0.01")
    if config.batch_size % config.num_envs:
        raise ConfigError(
            f"--batch_size {config.batch_size} is not divisible by --num_envs {config.num_envs}; "
            f"use --batch_size {config.batch_size // config.num_envs * config.num_envs or config.num_envs}"
        )
    if not 0 <= config.held_out_fraction < 1:
        raise ConfigError(f"--held_out_fraction {config.held_out_fraction}: must be in [0, 1)")
    if MALM.holds(config) and config.multiplier_update not in ("adam", "sgd"):
        raise ConfigError(
            f"--multiplier_update {config.multiplier_update}: has no parameter for malm's outer step; use adam or sgd, "
            f"or --method ccil"
        )
    if config.standardize_cost_advantage and (
        config.row.constraint == "trust_region_optimal" or config.multiplier_update == "optimal"
    ):
        raise ConfigError(
            "--standardize_cost_advantage true: the optimal multiplier compares the cost's surrogate with its gap, so "
            "it must keep its unit; leave it out"
        )
    if config.pid_smoothing >= 1:
        raise ConfigError(f"--pid_smoothing {config.pid_smoothing}: must be below 1, or no gap is ever felt")
    if META.holds(config) and config.num_held_out == 0:
        raise ConfigError(
            f"--held_out_fraction {config.held_out_fraction}: malm's outer loss needs held-out samples; "
            "use --held_out_fraction 0.3, or --meta_gradient none for the Lagrangian method"
        )
    if ON_POLICY.holds(config) and config.critic_minibatch_size > config.num_training:
        raise ConfigError(
            f"--critic_minibatch_size {config.critic_minibatch_size} exceeds the {config.num_training} training "
            f"samples of a batch; use --critic_minibatch_size {config.num_training} or less"
        )
    if ADVERSARIAL.holds(config) and config.discriminator_minibatch_size > config.batch_size:
        raise ConfigError(
            f"--discriminator_minibatch_size {config.discriminator_minibatch_size} exceeds the batch; "
            f"use --discriminator_minibatch_size {config.batch_size} or less"
        )
    if ON_POLICY.holds(config) and config.num_training < config.fisher_stride:
        raise ConfigError(f"--fisher_stride {config.fisher_stride} exceeds the {config.num_training} training samples")
    if IQ_LEARN.holds(config) and config.replay_size < config.num_envs:
        raise ConfigError(
            f"--replay_size {config.replay_size}: holds not even one step of {config.num_envs} simulations"
        )
    if IQ_LEARN.holds(config) and config.chi2_coefficient == 0:
        raise ConfigError("--chi2_coefficient 0: the loss divides by it; give a positive number such as 0.5")
    if LIMITED.holds(config) and config.cost_limit is None:
        raise ConfigError(f"--cost_limit: method {config.method} needs a prescribed episode cost limit")
