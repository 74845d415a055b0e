"""Hyperparameters. Importing this module imports no JAX, so launchers can answer `--help` at once.

Every field is static (it shapes the program: changing it compiles anew) or traced (a number inside the program:
sweeping it needs no compilation, and it may differ between vmapped runs).
"""

import dataclasses
import math
import numbers
from collections.abc import Iterable, Mapping
from typing import Any

from ccil_jax.errors import ConfigError
from ccil_jax.methods import Method, find_method
from ccil_jax.presets import PRESETS
from ccil_jax.uses import (
    ACTING,
    ADVERSARIAL,
    ALL,
    ASCENT,
    BC,
    CONSTRAINED,
    CVAG,
    HELD_OUT,
    IQ_LEARN,
    LAGRANGIAN,
    LIMITED,
    MALM,
    META,
    MULTIPLIER,
    OFF_POLICY,
    ON_POLICY,
    PENALIZED,
    PID,
    Use,
)

CHOICES: Mapping[str, tuple[str, ...]] = {
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
        return find_method(self.method)

    @property
    def prescribed_limit(self) -> float | None:
        """The episode cost limit that the user has given; None where the method has none, or the demonstrations'."""
        return self.cost_limit if self.row.limit == "prescribed" else None

    @property
    def has_multiplier(self) -> bool:
        """Whether the cost is weighed by a multiplier that is carried from one iteration to the next."""
        return self.row.has_multiplier and not (self.reads("multiplier_update") and self.multiplier_update == "optimal")

    @property
    def num_steps(self) -> int:
        """T: steps per simulation and generator step."""
        return self.batch_size // self.num_envs

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps that one iteration of one seed consumes; behaviour cloning needs none."""
        return self.generator_steps * self.batch_size if self.reads("env_steps") else 0

    @property
    def num_iterations(self) -> int:
        """Iterations needed to consume at least `env_steps`; passes over the demonstrations for behaviour cloning."""
        return math.ceil(self.env_steps / self.steps_per_iteration) if self.reads("env_steps") else self.bc_epochs

    @property
    def num_held_out(self) -> int:
        """V: samples kept for the outer loss; 0 for methods without one."""
        if not self.reads("held_out_fraction"):
            return 0
        if self.held_out_unit == "trajectory":
            return int(self.held_out_fraction * self.num_envs) * self.num_steps
        return int(self.held_out_fraction * self.batch_size)

    @property
    def num_training(self) -> int:
        """M: samples of the policy step and the critic regressions."""
        return self.batch_size - self.num_held_out

    def reads(self, name: str) -> bool:
        """Whether the field `name` makes a difference to what this configuration trains."""
        return name in self.row.reads or _USES[name].holds(self)

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
    return tuple(name for name in _USES if not config.reads(name))


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
    if _is_traced(config.cost_limit) or config.cost_limit not in (None, mean_episode_cost):
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


def check_types(config: Config) -> None:
    """Raises `ConfigError` for a value of another kind than the field's: one that is no choice, or no such number."""
    if unknown := set(find_method(config.method).reads) - _DEFAULTS.keys():
        raise ConfigError(
            f"--method {config.method}: reads {min(unknown)}, which is no field of Config; correct its row"
        )
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
        elif isinstance(default, str):
            sound, wanted = isinstance(value, str), "a name"
        else:
            sound, wanted = _is_number(value) or (value is None and default is None), "a number"
        if not sound:
            raise ConfigError(f"--{name} {value!r}: give {wanted}")


_ANY = 0.5  # within the range of every traced field


def _is_traced(value: Any) -> bool:
    """Whether this is a number of JAX, inside a program perhaps, where nobody knows it yet."""
    return not isinstance(value, numbers.Number) and getattr(value, "shape", None) == () and hasattr(value, "aval")


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
    limit of the demonstrations' is let through; `with_limit_of` compares it with them. Numbers of JAX, as traced fields
    have them inside a program, are taken on trust.
    """
    traced = (name for name in field_names(traced=True) if _is_traced(getattr(config, name)))
    config = config.replace(**dict.fromkeys(traced, _ANY))
    check_types(config)
    resolved = {"cost_limit"} if config.row.limit == "demonstrations" else set()
    check_used(config, (n for n in _USES if getattr(config, n) != _DEFAULTS[n] and n not in resolved))
    _check_ranges(config)
    _check_batches(config)
    _check_method(config)


def _check_ranges(config: Config) -> None:
    """Each number by itself."""
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
    if not 0 <= config.held_out_fraction < 1:
        raise ConfigError(f"--held_out_fraction {config.held_out_fraction}: must be in [0, 1)")
    if config.pid_smoothing >= 1:
        raise ConfigError(f"--pid_smoothing {config.pid_smoothing}: must be below 1, or no gap is ever felt")


def _check_batches(config: Config) -> None:
    """That batches divide as they have to, and hold enough samples."""
    if config.batch_size % config.num_envs:
        raise ConfigError(
            f"--batch_size {config.batch_size} is not divisible by --num_envs {config.num_envs}; "
            f"use --batch_size {config.batch_size // config.num_envs * config.num_envs or config.num_envs}"
        )
    if ON_POLICY.holds(config) and config.critic_minibatch_size > config.num_training:
        raise ConfigError(
            f"--critic_minibatch_size {config.critic_minibatch_size} exceeds the {config.num_training} training "
            f"samples of a batch; use --critic_minibatch_size {config.num_training} or less"
        )
    if config.reads("discriminator_minibatch_size") and config.discriminator_minibatch_size > config.batch_size:
        raise ConfigError(
            f"--discriminator_minibatch_size {config.discriminator_minibatch_size} exceeds the batch; "
            f"use --discriminator_minibatch_size {config.batch_size} or less"
        )
    if ON_POLICY.holds(config) and config.num_training < config.fisher_stride:
        raise ConfigError(f"--fisher_stride {config.fisher_stride} exceeds the {config.num_training} training samples")
    if config.reads("replay_size") and config.replay_size < config.num_envs:
        raise ConfigError(
            f"--replay_size {config.replay_size}: holds not even one step of {config.num_envs} simulations"
        )


def _check_method(config: Config) -> None:
    """What the method needs of its own fields."""
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
    if META.holds(config) and config.num_held_out == 0:
        raise ConfigError(
            f"--held_out_fraction {config.held_out_fraction}: malm's outer loss needs held-out samples; "
            "use --held_out_fraction 0.3, or --meta_gradient none for the Lagrangian method"
        )
    if IQ_LEARN.holds(config) and config.chi2_coefficient == 0:
        raise ConfigError("--chi2_coefficient 0: the loss divides by it; give a positive number such as 0.5")
    if LIMITED.holds(config) and config.cost_limit is None:
        raise ConfigError(f"--cost_limit: method {config.method} needs a prescribed episode cost limit")
