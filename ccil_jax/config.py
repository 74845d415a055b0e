"""Hyperparameters. Importing this module imports no JAX, so launchers can answer `--help` at once.

Every field is static (it shapes the program: changing it compiles anew) or traced (a number inside the program:
sweeping it needs no compilation, and it may differ between vmapped runs).
"""

import dataclasses
import math
import numbers
import types
from collections.abc import Iterable, Mapping
from typing import Any, Unpack

from ccil_jax.errors import ConfigError
from ccil_jax.fields import Fields
from ccil_jax.methods import Method, find_method
from ccil_jax.presets import PRESETS
from ccil_jax.uses import (
    ACTING,
    ACTOR,
    ADVERSARIAL,
    ALL,
    ASCENT,
    AVERAGED,
    CLONED,
    CLONING,
    CONSTRAINED,
    CVAG,
    GAUSSIAN,
    HELD_OUT,
    IMITATING,
    IMITATION,
    IQ_LEARN,
    LAGRANGIAN,
    LAGRANGIAN_LOSS,
    LIMITED,
    MALM,
    META,
    MULTIPLIER,
    ON_POLICY,
    PENALIZED,
    PID,
    SELECTING,
    SGD,
    STANDARDIZED,
    TD_LAMBDA,
    Use,
)

CLONING_UPDATES_PER_ITERATION = 100  # after as many gradient steps, cloning looks at the held-out steps

CHOICES: Mapping[str, tuple[str, ...]] = {
    "action_likelihood": ("gaussian", "censored"),
    "activation": ("tanh", "relu", "swish"),
    "meta_gradient": ("full", "direct", "indirect", "none"),
    "outer_loss": ("squared", "lagrangian"),
    "outer_advantage": ("stale", "re-evaluated"),
    "held_out_unit": ("transition", "trajectory"),
    "multiplier_update": ("adam", "sgd", "pid", "optimal"),
    "gap_unit": ("cost", "limit"),
    "meta_update": ("adam", "sgd"),
    "gate": ("batch", "episode"),
    "imitation_reward": ("discriminator", "coherent"),
    "reward_form": ("softplus", "logit", "log_sigmoid"),
    "discriminator_regularizer": ("none", "gradient_penalty", "spectral_norm"),
    "critic_target": ("gae", "td_lambda"),
    "policy_average": ("none", "polynomial_decay"),
    "evaluated_action": ("sample", "mode"),
    "cloning_selection": ("lowest", "one_standard_error"),
    "mirrored_demonstrations": ("none", "symmetric_tasks"),
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

    method: str = _static("malm", "name of the method, a row of the table in ccil_jax/methods.py", ALL)
    env_steps: int = _static(3_000_000, "environment steps per seed, rounded up to whole iterations", ACTING)
    num_envs: int = _static(16, "simulations stepped side by side, per seed", ACTING)
    batch_size: int = _static(
        2000,
        "environment steps of one batch, K in the paper; each policy update has a batch of its own (Table 1)",
        ACTING,
    )
    generator_steps: int = _static(3, "policy updates per iteration, each on a fresh batch (Table 1)", ACTING)
    discriminator_steps: int = _static(
        1,
        "passes of the discriminator over the last batch of an iteration, in minibatches (Table 1: 1 update)",
        ADVERSARIAL,
    )
    discriminator_minibatch_size: int = _static(
        128,
        "learner's samples, and as many of the expert's, in one gradient step of the discriminator; the authors "
        "take the "
        "whole batch at once",
        ADVERSARIAL,
    )
    held_out_fraction: float = _static(
        0.3, "share of the batch that the policy step does not see: the outer loss is computed on it (authors)", MALM
    )
    hidden_sizes: tuple[int, ...] = _static(
        (100, 100), "hidden layers of policy, critics and discriminator (Table 1)", ALL
    )
    activation: str = _static("tanh", "activation of every network (Table 1)", ALL)
    meta_gradient: str = _static(
        "full",
        "derivative of the outer loss by the multiplier: full is direct + indirect. direct holds the updated "
        "policy fixed, "
        "indirect is the part through the policy step, none leaves the outer step out",
        MALM,
    )
    outer_loss: str = _static(
        "squared",
        "what the outer step lowers on held-out samples: squared is mean (w A_r - lambda d)^2 (Algorithm 1 line 16), "
        "lagrangian the negative Lagrangian of the policy after the step, with the gap's penalty in the cost's weight",
        META,
    )
    outer_advantage: str = _static(
        "stale",
        "advantages in the outer loss: stale are those that the policy step used (authors), re-evaluated are "
        "computed by "
        "the updated critics and discriminator",
        META,
    )
    held_out_unit: str = _static(
        "transition",
        "what is drawn at random for the outer loss: single steps (authors), or all steps of a simulation in the batch",
        HELD_OUT,
    )
    multiplier_update: str = _static(
        "adam",
        "how the multiplier lambda follows the cost gap: adam on xi with lambda = softplus(xi) (authors), sgd on "
        "lambda "
        "projected to [0, multiplier_max] (Algorithm 1), a pid controller, or the value that is optimal for each "
        "policy "
        "step (constrained policy optimisation)",
        LAGRANGIAN,
    )
    gap_unit: str = _static(
        "cost",
        "unit of the gap that dual ascent by sgd follows: the cost's own (Algorithm 1), or the limit (at least "
        "1), so that one learning rate suits tasks of any cost",
        SGD,
    )
    meta_update: str = _static(
        "adam",
        "how the outer step moves the multiplier: adam on its parameter (authors), or sgd on lambda (Algorithm 1 "
        "line 16)",
        META,
    )
    gate: str = _static(
        "batch",
        "whether reward or cost is followed is decided once a batch (Algorithm 2) or for each episode (authors)",
        CVAG,
    )
    imitation_reward: str = _static(
        "discriminator",
        "what rewards the learner for being like the expert: discriminator is a classifier that is trained to tell the "
        "two apart (GAIL), coherent is log q(a|s) - log p(a), where q is the clone of the demonstrations, held fixed, "
        "and p a Gaussian of mean 0 and the policy's initial deviation (Watson, Huang and Heess 2023)",
        IMITATION,
    )
    reward_form: str = _static(
        "softplus",
        "reward of the learner, from the discriminator's logit h: softplus(h) = -log D, logit h, or log sigmoid(h)",
        ADVERSARIAL,
    )
    discriminator_regularizer: str = _static(
        "gradient_penalty",
        "what keeps the discriminator smooth: a penalty on its gradient (Gulrajani et al. 2017), or spectral "
        "normalisation "
        "of its weights (Miyato et al. 2018)",
        ADVERSARIAL,
    )
    cg_iterations: int = _static(
        10, "iterations of the conjugate-gradient method that solves for the natural directions (authors)"
    )
    fisher_stride: int = _static(
        5, "every n-th sample of the batch enters the products with the Fisher matrix (authors)"
    )
    line_search_steps: int = _static(10, "halvings of the policy step before it is rejected (authors)")
    policy_average: str = _static(
        "none",
        "what is evaluated and recorded in the end: none is the policy of the last iteration, polynomial_decay the "
        "average of the parameters of all iterations, those of iteration k weighed by k^policy_average_power, so that "
        "the noise of single steps cancels (Shamir and Zhang 2013); rollouts are of the newest policy either way. "
        "Cloning averages over its gradient steps in the same way (Block et al. 2024)",
        GAUSSIAN,
    )
    evaluated_action: str = _static(
        "sample",
        "how the policy acts when it is evaluated, recorded and shown: sample draws its actions from its distribution, "
        "as while it learns, mode takes the most likely one, without the noise that learning needs",
        ALL,
    )
    critic_intervals: int = _static(
        0,
        "equal intervals into which the range of each observation entry is divided for the critics, which then tell "
        "apart values that lie close together (piecewise linear encoding, Gorishniy et al. 2022); 0 gives them the "
        "observations as they are",
    )
    critic_target: str = _static(
        "gae",
        "what the critics learn: gae is advantage + value with the advantage's own lambda (authors), td_lambda the "
        "lambda-return with critic_lambda, so that advantages can lean on the critics without spoiling what they learn",
    )
    normalize_values: bool = _static(
        False,
        "whether the critics' targets are shifted and scaled by their running mean and deviation for the networks, so "
        "that returns of hundreds are learnt as fast as returns of 1 (van Hasselt et al. 2016)",
    )
    critic_epochs: int = _static(5, "passes of both critics over each batch (authors)")
    critic_minibatch_size: int = _static(
        128,
        "samples in one gradient step of a critic (authors), of cloning, or of iq_learn, which takes as many again "
        "from the demonstrations",
        ALL,
    )
    standardize_cost_advantage: bool = _static(
        False,
        "whether the cost advantage is shifted to mean 0 and divided by its standard deviation, as the reward's "
        "always is",
        STANDARDIZED,
    )
    bootstrap_at_truncation: bool = _static(
        True, "whether the future beyond a time limit counts, with the critic's value; false takes 0 for it (authors)"
    )
    action_likelihood: str = _static(
        "gaussian",
        "likelihood of an action: gaussian is the density of the action as it was drawn (authors), censored that of "
        "the action as it is executed, where one at a bound of its range stands for all draws beyond it too",
        GAUSSIAN,
    )
    mirrored_demonstrations: str = _static(
        "none",
        "mirror images of the demonstrations that are demonstrations too: none, or symmetric_tasks for those of tasks "
        "that declare a mirror symmetry, which changes nothing on other tasks",
        IMITATING,
    )
    cloning_updates: int = _static(
        0,
        "gradient steps in which the policy is cloned from the demonstrations before anything else is learnt, rounded "
        "up to hundreds; for bc each hundred is an iteration. The policy that is kept is chosen on the held-out tenth "
        "of the demonstrations",
        CLONING,
    )
    cloning_selection: str = _static(
        "lowest",
        "which policy of the cloning is kept: lowest is that of the lowest loss on the held-out steps, "
        "one_standard_error the newest whose loss is at most a standard error above it, because longer cloning makes "
        "rollouts better where the held-out loss can hardly tell",
        SELECTING,
    )
    warmup_iterations: int = _static(
        0, "first iterations in which the policy stays as it is, while critics and discriminator learn from it", CLONED
    )
    replay_size: int = _static(
        200_000,
        "environment steps that the replay memory holds, the newest ones (published: 1e6, never filled here)",
        IQ_LEARN,
    )
    updates_per_step: int = _static(1, "gradient updates per environment step (published)", IQ_LEARN)
    value_loss: str = _static(
        "value",
        "second term of the loss: value is the mean of V - y over expert's and learner's steps, v0 is (1 - gamma) V at "
        "the demonstrations' first states",
        IQ_LEARN,
    )
    max_skipped_updates: int = _static(
        10, "an iteration that yields NaN or infinity is taken back; a seed stops after this many of them in a row", ALL
    )

    gamma: float = _traced(0.995, "discount factor of the reward, per step; the cost has the same (Table 1)", ACTING)
    cost_gamma: float | None = _traced(
        None,
        "discount factor of the cost, per step; none takes gamma. A small one charges a step with the cost that "
        "follows soon, but not with that of staying alive",
        CONSTRAINED,
    )
    gae_lambda: float = _traced(0.97, "lambda of generalised advantage estimation, for the reward (Table 1)")
    cost_gae_lambda: float = _traced(
        0.97, "lambda of generalised advantage estimation, for the cost (Table 1)", CONSTRAINED
    )
    critic_lambda: float = _traced(0.97, "lambda of the critics' targets", TD_LAMBDA)
    policy_average_power: float = _traced(
        6.0,
        "how fast older policies fade from the average; with n about the last 1/(n+1) of the iterations count, or "
        "of the gradient steps of cloning",
        AVERAGED,
    )
    max_kl: float = _traced(0.01, "radius of the trust region: KL divergence from the old policy, nats (Table 1)")
    kl_tolerance: float = _traced(
        1.5, "the line search accepts a step whose KL divergence is at most this multiple of max_kl (authors)"
    )
    cg_damping: float = _traced(0.1, "number added to the diagonal of the Fisher matrix (authors)")
    critic_learning_rate: float = _traced(1e-3, "learning rate of both critics, Adam (Table 1)", ACTING)
    discriminator_learning_rate: float = _traced(
        3e-4, "learning rate of the discriminator, Adam (Table 1)", ADVERSARIAL
    )
    policy_entropy_coefficient: float = _traced(
        0.0, "weight of the policy's entropy in its objective, beta in the paper (Table 1)"
    )
    discriminator_entropy_coefficient: float = _traced(
        1e-3, "weight of the entropy bonus in the discriminator's loss (Table 1)", ADVERSARIAL
    )
    gradient_penalty_coefficient: float = _traced(
        1.0, "weight of the gradient penalty in the discriminator's loss", PENALIZED
    )
    initial_multiplier: float = _traced(0.01, "lambda before the first iteration (Table 1)", MULTIPLIER)
    multiplier_learning_rate: float = _traced(0.05, "step size of the dual step (Table 1)", ASCENT)
    meta_learning_rate: float = _traced(0.05, "step size of the outer step (Table 1)", META)
    outer_penalty: float = _traced(
        1.0, "rho: by how much the relative gap raises the cost's weight in the lagrangian outer loss", LAGRANGIAN_LOSS
    )
    multiplier_max: float = _traced(100.0, "largest value of the multiplier", MULTIPLIER)
    pid_proportional_gain: float = _traced(0.5, "gain of the smoothed cost gap e = (J - limit) / limit", PID)
    pid_integral_gain: float = _traced(0.05, "gain of the sum of all gaps so far", PID)
    pid_derivative_gain: float = _traced(0.5, "gain of the rise of the smoothed gap, where it rises", PID)
    pid_smoothing: float = _traced(0.9, "share of the previous smoothed gap in the new one", PID)
    actor_learning_rate: float = _traced(
        1e-3, "learning rate of the policy in cloning, by bc or before another method, and in iq_learn, Adam", ACTOR
    )
    target_update_rate: float = _traced(
        0.005, "share of the critic in each update of its Polyak average, the target critic (published)", IQ_LEARN
    )
    chi2_coefficient: float = _traced(
        0.5, "alpha of the chi-square term r^2 / (4 alpha) of the loss (published)", IQ_LEARN
    )
    temperature: float | None = _traced(
        None, "weight of the entropy in the soft values; none takes the task's published value", IQ_LEARN
    )
    cloning_weight: float | None = _traced(
        0.0,
        "weight of the demonstrations' mean log likelihood in the policy's objective, after the cloning; none takes "
        "their number of steps divided by batch_size, so that a demonstrated step counts as much as one of the batch",
        CLONED,
    )
    cost_limit: float | None = _traced(
        None,
        "limit of an episode's cost; all other constrained methods take the mean cost of their demonstrations",
        LIMITED,
    )

    @classmethod
    def from_preset(cls, preset: str, **changes: Unpack[Fields]) -> "Config":
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
        """Iterations needed to consume at least `env_steps`; those of the cloning for behaviour cloning."""
        if not self.reads("env_steps"):
            return self.num_cloning_iterations
        return math.ceil(self.env_steps / self.steps_per_iteration)

    @property
    def num_cloning_iterations(self) -> int:
        """Iterations of behaviour cloning, with at least `cloning_updates` gradient steps in all."""
        return math.ceil(self.cloning_updates / CLONING_UPDATES_PER_ITERATION)

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

    def acts_by_mode(self, told: bool | None = None) -> bool:
        """Whether the policy acts with the modes of its distribution, once learnt: as told, else `evaluated_action`."""
        return self.evaluated_action == "mode" if told is None else told

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
_OPTIONAL = frozenset(f.name for f in dataclasses.fields(Config) if isinstance(f.type, types.UnionType))


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
                own = _OWN[name] if name in _OWN and (callable(value) or ":" in str(value)) else ""
                raise ConfigError(f"--{name} {value!r}: unknown; choose one of {', '.join(CHOICES[name])}{own}")
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
            optional = name in _OPTIONAL
            sound, wanted = (
                _is_number(value) or (value is None and optional),
                "a number or None" if optional else "a number",
            )
        if not sound:
            raise ConfigError(f"--{name} {value!r}: give {wanted}")


_OWN = {  # what a user who names a function of their own is told
    "multiplier_update": "; a rule of your own is the constraint of a method row, --method MODULE:ROW",
    "imitation_reward": "; a reward of your own is the reward of a method row, --method MODULE:ROW",
}
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
        smallest = 1 if default else 0
        if is_integer(default) and getattr(config, name) < smallest:
            raise ConfigError(f"--{name} {getattr(config, name)}: must be at least {smallest}")
    if not config.hidden_sizes or min(config.hidden_sizes) < 1:
        raise ConfigError(f"--hidden_sizes {config.hidden_sizes}: give at least one layer of at least one unit")
    for name in field_names(traced=True):
        value = getattr(config, name)
        if value is not None and not (math.isfinite(value) and value >= 0):
            raise ConfigError(f"--{name} {value}: must be finite and not negative")
    for name in ("gamma", "cost_gamma", "gae_lambda", "cost_gae_lambda", "critic_lambda"):
        if (value := getattr(config, name)) is not None and value > 1:
            raise ConfigError(f"--{name} {value}: must be at most 1")
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
            f"--multiplier_update {config.multiplier_update}: has no parameter for the outer step of {config.method}; "
            "use adam or sgd, or --method ccil"
        )
    if LAGRANGIAN_LOSS.holds(config) and config.meta_gradient != "full":
        raise ConfigError(
            f"--meta_gradient {config.meta_gradient}: the lagrangian outer loss depends on the multiplier through the "
            "policy alone, so there is nothing to choose; use full, or none"
        )
    if META.holds(config) and config.num_held_out == 0:
        raise ConfigError(
            f"--held_out_fraction {config.held_out_fraction}: the outer loss of {config.method} needs held-out "
            "samples; use --held_out_fraction 0.3, or --meta_gradient none for the Lagrangian method"
        )
    if IQ_LEARN.holds(config) and config.chi2_coefficient == 0:
        raise ConfigError("--chi2_coefficient 0: the loss divides by it; give a positive number such as 0.5")
    if config.imitation_reward == "coherent" and config.cloning_updates == 0:
        raise ConfigError(
            "--imitation_reward coherent: is computed from a clone of the demonstrations, and there is none; give "
            "--cloning_updates a number such as 20000, or use --imitation_reward discriminator"
        )
    if config.row.agent == "behavior_cloning" and config.cloning_updates == 0:
        raise ConfigError("--cloning_updates 0: method bc would learn nothing; give a number such as 20000")
    if LIMITED.holds(config) and config.cost_limit is None:
        raise ConfigError(f"--cost_limit: method {config.method} needs a prescribed episode cost limit")
