"""Hyperparameters. Importing this module imports no JAX, so launchers can answer `--help` at once.

Every field is static (it shapes the program: changing it compiles anew) or traced (a number inside the program:
sweeping it needs no compilation, and it may differ between vmapped runs).
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

METHOD_NAMES = ("malm", "cvag", "ccil", "lgail", "gail", "cpo_il", "pid_il", "bc", "iq_learn", "trpo", "expert")
ADVERSARIAL_METHODS = frozenset({"malm", "cvag", "ccil", "lgail", "gail", "cpo_il", "pid_il"})  # by a discriminator
IMITATION_METHODS = ADVERSARIAL_METHODS | {"bc", "iq_learn"}
PRESCRIBED_LIMIT_METHODS = frozenset({"lgail", "expert"})

CHOICES: Mapping[str, tuple[str, ...]] = {
    "method": METHOD_NAMES,
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


class ConfigError(ValueError):
    """A configuration that cannot run. The message names the option and the remedy."""


def _static(default: Any, help: str) -> Any:
    return dataclasses.field(default=default, metadata={"traced": False, "help": help})


def _traced(default: float | None, help: str) -> Any:
    return dataclasses.field(default=default, metadata={"traced": True, "help": help})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """All choices of one training program. Defaults are Table 1 of the paper (`paper` preset).

    Sources beyond Table 1 are in the field's help text; "authors" means the paper's public code.
    """

    method: str = _static("malm", "row of the methods table")
    env_steps: int = _static(3_000_000, "environment steps per seed, rounded up to whole iterations")
    num_envs: int = _static(16, "simulations stepped side by side, per seed")
    batch_size: int = _static(2000, "environment steps per generator step, K (Table 1)")
    generator_steps: int = _static(3, "policy updates per iteration, each on a fresh batch (Table 1)")
    discriminator_steps: int = _static(
        1, "discriminator updates per iteration (Table 1), each a pass over the last batch in minibatches"
    )
    discriminator_minibatch_size: int = _static(
        128, "samples of either class per discriminator gradient step; the authors take the whole batch at once"
    )
    held_out_fraction: float = _static(0.3, "share of the batch kept for the outer loss, malm only (authors)")
    hidden_sizes: tuple[int, ...] = _static((100, 100), "hidden layers of policy, critics and discriminator (Table 1)")
    activation: str = _static("tanh", "activation of every network (Table 1)")
    meta_gradient: str = _static("full", "outer step of malm: total derivative, one of its two parts, or none")
    outer_advantage: str = _static(
        "stale", "outer loss of malm: advantages as the policy step saw them (authors), or by the updated networks"
    )
    held_out_unit: str = _static(
        "transition", "what is drawn for the outer loss: steps (authors), or whole simulations' stretches of the batch"
    )
    multiplier_update: str = _static(
        "adam",
        "dual step: adam on softplus(xi) (authors), projected sgd (Algorithm 1), a pid controller, or the optimal "
        "value for each single step",
    )
    meta_update: str = _static(
        "adam", "outer step: adam on the multiplier's parameter (authors) or sgd on lambda (line 16)"
    )
    gate: str = _static("batch", "cvag: one decision per batch (Algorithm 2) or per episode (authors)")
    reward_form: str = _static(
        "softplus", "imitation reward from the logit h: softplus(h) = -log D, h, or log sigmoid(h)"
    )
    discriminator_regularizer: str = _static("gradient_penalty", "what keeps the discriminator smooth")
    cg_iterations: int = _static(10, "conjugate-gradient iterations (authors)")
    fisher_stride: int = _static(5, "the Fisher product uses every n-th sample (authors)")
    line_search_steps: int = _static(10, "halvings of the policy step before it is rejected (authors)")
    critic_epochs: int = _static(5, "passes over the batch per critic regression (authors)")
    critic_minibatch_size: int = _static(
        128, "samples per critic gradient step (authors); per step of bc; of either source per step of iq_learn"
    )
    standardize_cost_advantage: bool = _static(False, "also divide the cost advantage by its deviation")
    bootstrap_at_truncation: bool = _static(True, "use the critic's value at a time limit; false zeroes it (authors)")
    bc_epochs: int = _static(200, "passes over the demonstrations, bc only: its iterations")
    replay_size: int = _static(200_000, "latest steps that iq_learn learns from (published: 1e6, never filled here)")
    updates_per_step: int = _static(1, "gradient updates per environment step, iq_learn only (published)")
    value_loss: str = _static(
        "value", "second term of iq_learn's loss: V - y over expert and learner, or v0, (1 - gamma) V at first states"
    )
    max_skipped_updates: int = _static(
        10, "a seed stops after so many iterations in a row that were not finite; each is taken back"
    )

    gamma: float = _traced(0.995, "discount of reward and cost (Table 1)")
    gae_lambda: float = _traced(0.97, "decay of generalised advantage estimation, of the reward (Table 1)")
    cost_gae_lambda: float = _traced(0.97, "the same, of the cost (Table 1)")
    max_kl: float = _traced(0.01, "trust-region radius, nats (Table 1)")
    kl_tolerance: float = _traced(1.5, "a step is accepted up to this multiple of max_kl (authors)")
    cg_damping: float = _traced(0.1, "added to the Fisher matrix's diagonal (authors)")
    critic_learning_rate: float = _traced(1e-3, "Adam, both critics (Table 1)")
    discriminator_learning_rate: float = _traced(3e-4, "Adam (Table 1)")
    policy_entropy_coefficient: float = _traced(0.0, "beta, weight of the policy's entropy (Table 1)")
    discriminator_entropy_coefficient: float = _traced(1e-3, "weight of the discriminator's entropy bonus (Table 1)")
    gradient_penalty_coefficient: float = _traced(1.0, "weight of the gradient penalty")
    initial_multiplier: float = _traced(0.01, "lambda before the first iteration (Table 1)")
    multiplier_learning_rate: float = _traced(0.05, "dual step size (Table 1)")
    meta_learning_rate: float = _traced(0.05, "outer step size, malm only (Table 1)")
    multiplier_max: float = _traced(100.0, "cap of the multiplier")
    pid_proportional_gain: float = _traced(0.5, "of the smoothed cost gap, relative to the limit; pid only")
    pid_integral_gain: float = _traced(0.05, "of the sum of relative gaps; pid only")
    pid_derivative_gain: float = _traced(0.5, "of the rise of the smoothed relative gap; pid only")
    pid_smoothing: float = _traced(0.9, "share of the previous smoothed gap that stays; pid only")
    actor_learning_rate: float = _traced(1e-3, "Adam, policy of bc and iq_learn")
    target_update_rate: float = _traced(0.005, "Polyak average of iq_learn's target critic (published)")
    chi2_coefficient: float = _traced(0.5, "alpha of iq_learn's chi-square term, r^2 / (4 alpha) (published)")
    temperature: float | None = _traced(None, "weight of iq_learn's entropy; none: the task's published value")
    cost_limit: float | None = _traced(
        None, "episode cost limit; imitation takes the demonstrations' mean unless lgail"
    )

    @property
    def num_steps(self) -> int:
        """T: steps per simulation and generator step."""
        return self.batch_size // self.num_envs

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps that one iteration of one seed consumes; behaviour cloning needs none."""
        return 0 if self.method == "bc" else self.generator_steps * self.batch_size

    @property
    def num_iterations(self) -> int:
        """Iterations needed to consume at least `env_steps`; passes over the demonstrations for behaviour cloning."""
        return self.bc_epochs if self.method == "bc" else math.ceil(self.env_steps / self.steps_per_iteration)

    @property
    def num_held_out(self) -> int:
        """V: samples kept for the outer loss; 0 for every method but malm."""
        if self.method != "malm":
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


def validate(config: Config) -> None:
    """Raises `ConfigError` for a combination that cannot run, before anything is compiled."""
    for name, allowed in CHOICES.items():
        if getattr(config, name) not in allowed:
            raise ConfigError(f"--{name} {getattr(config, name)!r}: unknown; choose one of {', '.join(allowed)}")
    for name in (
        "env_steps",
        "num_envs",
        "batch_size",
        "generator_steps",
        "discriminator_steps",
        "discriminator_minibatch_size",
        "cg_iterations",
        "fisher_stride",
        "line_search_steps",
        "critic_epochs",
        "critic_minibatch_size",
        "bc_epochs",
        "replay_size",
        "updates_per_step",
        "max_skipped_updates",
    ):
        if getattr(config, name) < 1:
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
    if config.method == "malm" and config.multiplier_update not in ("adam", "sgd"):
        raise ConfigError(
            f"--multiplier_update {config.multiplier_update}: has no parameter for malm's outer step; use adam or sgd, "
            f"or --method ccil"
        )
    if config.standardize_cost_advantage and (config.method == "cpo_il" or config.multiplier_update == "optimal"):
        raise ConfigError(
            "--standardize_cost_advantage true: the optimal multiplier compares the cost's surrogate with its gap, so "
            "it must keep its unit; leave it out"
        )
    if config.pid_smoothing >= 1:
        raise ConfigError(f"--pid_smoothing {config.pid_smoothing}: must be below 1, or no gap is ever felt")
    if config.method == "malm" and config.meta_gradient != "none" and config.num_held_out == 0:
        raise ConfigError(
            f"--held_out_fraction {config.held_out_fraction}: malm's outer loss needs held-out samples; "
            "use --held_out_fraction 0.3, or --meta_gradient none for the Lagrangian method"
        )
    if config.critic_minibatch_size > config.num_training:
        raise ConfigError(
            f"--critic_minibatch_size {config.critic_minibatch_size} exceeds the {config.num_training} training "
            f"samples of a batch; use --critic_minibatch_size {config.num_training} or less"
        )
    if config.method in ADVERSARIAL_METHODS and config.discriminator_minibatch_size > config.batch_size:
        raise ConfigError(
            f"--discriminator_minibatch_size {config.discriminator_minibatch_size} exceeds the batch; "
            f"use --discriminator_minibatch_size {config.batch_size} or less"
        )
    if config.num_training < config.fisher_stride:
        raise ConfigError(f"--fisher_stride {config.fisher_stride} exceeds the {config.num_training} training samples")
    if config.method == "iq_learn" and config.replay_size < config.num_envs:
        raise ConfigError(
            f"--replay_size {config.replay_size}: holds not even one step of {config.num_envs} simulations"
        )
    if config.method == "iq_learn" and config.chi2_coefficient == 0:
        raise ConfigError("--chi2_coefficient 0: the loss divides by it; give a positive number such as 0.5")
    if config.method in PRESCRIBED_LIMIT_METHODS and config.cost_limit is None:
        raise ConfigError(f"--cost_limit: method {config.method} needs a prescribed episode cost limit")
