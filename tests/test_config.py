"""Configurations: a field that makes no difference is refused, and what is said of that agrees with the programs."""

import functools
import re
import typing
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Jaxpr, Literal
from jax.interpreters import partial_eval

from ccil_jax.agents import build
from ccil_jax.agents.expert import expert_data
from ccil_jax.config import Config, field_names, unused, validate, with_limit_of
from ccil_jax.errors import ConfigError
from ccil_jax.fields import Fields
from ccil_jax.learning import constraints
from ccil_jax.methods import METHODS
from ccil_jax.presets import PRESETS
from experiments import ablations, expert, sweep, train
from experiments.cli.command_line import UsageError
from tests.probe_envs import Walk, walk_config, walk_demonstrations

# Who uses what ------------------------------------------------------------------------------------------------------

VARIANTS: dict[str, dict[str, Any]] = {name: {"method": name} for name in METHODS} | {
    "bc": {"method": "bc", "cloning_updates": 200},
    "malm without an outer step": {"method": "malm", "meta_gradient": "none"},
    "malm that holds nothing out": {"method": "malm", "meta_gradient": "none", "held_out_fraction": 0.0},
    "ccil with a controller": {"method": "ccil", "multiplier_update": "pid"},
    "expert with the optimal multiplier": {"method": "expert", "multiplier_update": "optimal"},
    "gail without a penalty": {"method": "gail", "discriminator_regularizer": "none"},
    "malm by projected ascent": {"method": "malm", "multiplier_update": "sgd"},
    "malm with the Lagrangian as outer loss": {"method": "malm", "outer_loss": "lagrangian"},
    "ccil that begins with a clone": {"method": "ccil", "cloning_updates": 200},
    "gail that begins with a clone": {"method": "gail", "cloning_updates": 200},
    "gail with targets of their own": {"method": "gail", "critic_target": "td_lambda"},
    "gail that averages": {"method": "gail", "policy_average": "polynomial_decay"},
    "bc that averages": {"method": "bc", "cloning_updates": 200, "policy_average": "polynomial_decay"},
    "iq_learn that begins with a clone": {"method": "iq_learn", "cloning_updates": 200},
    "malm with the coherent reward": {"method": "malm", "cloning_updates": 200, "imitation_reward": "coherent"},
    "gail with the coherent reward": {"method": "gail", "cloning_updates": 200, "imitation_reward": "coherent"},
}
# Multiplied by the weight 0 of a cost that does not enter: a dependence by the text of the program alone.
TIMES_ZERO = {"cost_gae_lambda", "cost_gamma"}
NO_COST = [name for name in VARIANTS if name.startswith(("gail", "trpo"))]
NOTHING = dict.fromkeys(NO_COST, TIMES_ZERO)
OTHER: dict[str, Any] = {  # another value of each static field that narrows what a method is
    "discriminator_steps": 2,
    "discriminator_minibatch_size": 8,
    "held_out_fraction": 0.5,
    "meta_gradient": "direct",
    "outer_loss": "lagrangian",
    "outer_advantage": "re-evaluated",
    "held_out_unit": "trajectory",
    "multiplier_update": "sgd",
    "gap_unit": "limit",
    "meta_update": "sgd",
    "gate": "episode",
    "imitation_reward": "coherent",
    "reward_form": "logit",
    "discriminator_regularizer": "spectral_norm",
    "standardize_cost_advantage": True,
    "replay_size": 64,
    "updates_per_step": 2,
    "value_loss": "v0",
    "cg_iterations": 3,
    "bootstrap_at_truncation": False,
    "action_likelihood": "censored",
    "cloning_updates": 300,
    "cloning_selection": "one_standard_error",
    "warmup_iterations": 2,
    "critic_target": "td_lambda",
    "normalize_values": True,
    "policy_average": "polynomial_decay",
}
# How long, when to give up, and what the demonstrations are: not of an iteration.
OUTSIDE = {"env_steps", "max_skipped_updates", "mirrored_demonstrations"}
NEEDS_A_CLONE = {"imitation_reward"}  # the other value of these


def resolved(changes: dict[str, Any]) -> Config:
    limit = {"cost_limit": 1.0} if METHODS[changes["method"]].limit == "prescribed" else {}
    return build.resolve(walk_config(**changes, **limit), Walk(), walk_demonstrations())


def policy_program(config: Config) -> tuple[Any, list[bool]]:
    """Four iterations from a start to a policy: what is left of the program, and whether each traced field enters."""
    values = {name: jnp.float32(getattr(config, name) or 0.0) for name in field_names(traced=True)}
    demonstrations = expert_data(walk_demonstrations())

    def train(values: dict[str, jax.Array]) -> Any:
        agent = build.make(config.replace(**values), Walk(), demonstrations)
        start = agent.init(jax.random.key(0))
        return jax.lax.scan(lambda state, _: (agent.step(state)[0], None), start, None, length=4)[0].actor

    program = jax.make_jaxpr(train)(values).jaxpr
    return partial_eval.dce_jaxpr(program, [True] * len(program.outvars))


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_traced_field_enters_the_program_exactly_where_it_is_said_to_be_used(variant: str) -> None:
    config = resolved(VARIANTS[variant])
    _, enters = policy_program(config)
    found = {name for name, enter in zip(sorted(field_names(traced=True)), enters, strict=True) if enter}
    said = set(field_names(traced=True)) - set(unused(config))
    if config.row.limit == "demonstrations":
        assert "cost_limit" in found  # but it is the demonstrations', not the user's to give
        said |= {"cost_limit"}
    assert found - NOTHING.get(variant, set()) == said


def text_of(program: Any) -> str:
    """The equations of a jaxpr, those inside loops and calls included; JAX's own text depends on what it has shared."""
    numbers: dict[Any, int] = {}

    def operand(value: Any) -> str:
        name = str(value) if isinstance(value, Literal) else f"v{numbers.setdefault(value, len(numbers))}"
        return f"{name}:{value.aval}"

    def parameter(value: Any) -> str:
        value = getattr(value, "jaxpr", value)  # a closed one
        if isinstance(value, tuple | list):
            return f"({', '.join(map(parameter, value))})"
        return text_of(value) if isinstance(value, Jaxpr) else re.sub("0x[0-9a-f]+", "", str(value))

    lines = [f"takes {' '.join(map(operand, program.invars))}"]
    for equation in program.eqns:
        parameters = {name: parameter(value) for name, value in sorted(equation.params.items())}
        outputs, inputs = (" ".join(map(operand, variables)) for variables in (equation.outvars, equation.invars))
        lines.append(f"{outputs} = {equation.primitive} {parameters} {inputs}")
    return "\n".join([*lines, f"gives {' '.join(map(operand, program.outvars))}"])


@functools.cache
def program_text(variant: str) -> str:
    return text_of(policy_program(resolved(VARIANTS[variant]))[0])


@pytest.mark.parametrize("variant", VARIANTS)
def test_static_fields_that_are_said_to_be_unused_leave_the_program_as_it_is(variant: str) -> None:
    """All of them changed at once, past the check that would refuse them."""
    config = resolved(VARIANTS[variant])
    changed = {name: OTHER[name] for name in set(unused(config)) & OTHER.keys() - NOTHING.get(variant, set())}
    assert set(unused(config)) - set(field_names(traced=True)) <= OTHER.keys() | OUTSIDE | SIZES
    assert text_of(policy_program(config.replace(**changed))[0]) == program_text(variant)


# Fields that shape arrays; a method that is said not to use them has no array to shape.
SIZES = {
    "num_envs",
    "batch_size",
    "generator_steps",
    "critic_epochs",
    "critic_intervals",
    "fisher_stride",
    "line_search_steps",
}


@pytest.mark.parametrize("name", OTHER)
def test_a_static_field_that_is_said_to_be_used_changes_the_program(name: str) -> None:
    variant = next(
        v
        for v, changes in VARIANTS.items()
        if name not in unused(resolved(changes)) and ("cloning_updates" in changes or name not in NEEDS_A_CLONE)
    )
    assert text_of(policy_program(resolved(VARIANTS[variant] | {name: OTHER[name]}))[0]) != program_text(variant)


# What is refused ----------------------------------------------------------------------------------------------------

IDLE: dict[str, tuple[dict[str, Any], str]] = {
    "gate of gail": ({"method": "gail", "gate": "episode"}, "gate episode: makes no difference .* (used by cvag)"),
    "outer step of ccil": (
        {"method": "ccil", "meta_learning_rate": 9.0},
        "meta_learning_rate 9.0: makes no difference to this run of method ccil; leave it out (used by malm unless",
    ),
    "meta update without one": (
        {"method": "malm", "meta_gradient": "none", "meta_update": "sgd"},
        "meta_update sgd: makes no difference to this run of method malm",
    ),
    "limit of trpo": (
        {"method": "trpo", "cost_limit": 100.0},
        "cost_limit 100.0: makes no difference .*methods with a prescribed limit (lgail, expert)",
    ),
    "gains without a controller": ({"method": "malm", "pid_smoothing": 0.5}, "pid_smoothing 0.5: makes no difference"),
    "steps of bc": ({"method": "bc", "env_steps": 10}, "env_steps 10: makes no difference to this run of method bc"),
    "discriminator of the coherent reward": (
        {"method": "gail", "cloning_updates": 100, "imitation_reward": "coherent", "discriminator_steps": 2},
        "discriminator_steps 2: makes no difference .*unless imitation_reward is coherent)",
    ),
    "penalty of the coherent reward": (
        {"method": "gail", "cloning_updates": 100, "imitation_reward": "coherent", "gradient_penalty_coefficient": 3.0},
        "gradient_penalty_coefficient 3.0: makes no difference",
    ),
    "imitation reward of trpo": (
        {"method": "trpo", "imitation_reward": "coherent"},
        "imitation_reward coherent: makes no difference .*methods with an imitation reward (malm, cvag, ccil, lgail,",
    ),
    "penalty without one": (
        {"method": "gail", "discriminator_regularizer": "none", "gradient_penalty_coefficient": 3.0},
        "gradient_penalty_coefficient 3.0: makes no difference",
    ),
}


def pattern(message: str) -> str:
    """The message as a regular expression, in which `.*` keeps its meaning."""
    return re.escape(message).replace(re.escape(".*"), ".*")


@pytest.mark.parametrize(("fields", "message"), IDLE.values(), ids=list(IDLE))
def test_a_field_that_makes_no_difference_is_refused_in_python(fields: dict[str, Any], message: str) -> None:
    for make in (lambda: validate(Config(**fields)), lambda: Config.from_preset("default", **fields)):
        with pytest.raises(ConfigError, match=pattern(message)):
            make()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"num_envs": 2.5}, "num_envs 2.5: give an integer"),
        ({"num_envs": True}, "num_envs True: give an integer"),
        ({"hidden_sizes": 64}, "hidden_sizes 64: give a tuple such as (100, 100)"),
        ({"hidden_sizes": [64]}, "hidden_sizes [64]: give a tuple"),
        ({"gamma": "0.9"}, "gamma '0.9': give a number"),
        ({"gamma": None}, "gamma None: give a number"),
        ({"bootstrap_at_truncation": 1}, "bootstrap_at_truncation 1: give True or False"),
        ({"method": None}, "method None: unknown; choose one of malm"),
        ({"cg_iterations": 0}, "cg_iterations 0: must be at least 1"),
    ],
)
def test_a_value_of_another_kind_is_named(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match="^" + pattern(message)):
        validate(Config(**fields))


def test_numbers_of_numpy_are_numbers_too() -> None:
    validate(Config(num_envs=np.int64(16), gamma=np.float32(0.9), hidden_sizes=(np.int32(8),)))


def options_of(fields: dict[str, Any]) -> list[str]:
    return [f"--{name.replace('_', '-')}={value}" for name, value in fields.items()]


@pytest.mark.parametrize(("fields", "message"), IDLE.values(), ids=list(IDLE))
def test_and_on_the_command_line(fields: dict[str, Any], message: str, tmp_path: Path) -> None:
    given = ["--env", "Swimmer", "--out", str(tmp_path / "run"), *options_of(fields)]
    name = next(reversed(fields)).replace("_", "-")
    with pytest.raises(ConfigError, match=f"^{next(reversed(fields))} ") as refused:
        train.make_plan(train.make_parser().parse_args(given))
    assert refused.value.on_command_line().startswith(f"--{name} ")
    assert not (tmp_path / "run").exists()


def test_an_option_that_is_given_at_its_default_is_refused_too(tmp_path: Path) -> None:
    given = ["--env", "Swimmer", "--method", "gail", "--gate", "batch", "--out", str(tmp_path / "run")]
    with pytest.raises(ConfigError, match=r"gate batch: makes no difference .*\(used by cvag\)"):
        train.make_plan(train.make_parser().parse_args(given))
    given = ["--env", "Swimmer", "--unconstrained", "--multiplier-max", "100", "--out", str(tmp_path / "x.npz")]
    with pytest.raises(ConfigError, match=r"multiplier_max 100\.0: makes no difference to") as refused:
        expert.make_plan(expert.make_parser().parse_args(given))
    wanted = "--multiplier-max 100.0: makes no difference to this run of method trpo"
    assert refused.value.on_command_line().startswith(wanted)
    given = ["--env", "Swimmer", "--method", "trpo", "--num-demos", "3", "--out", str(tmp_path / "run")]
    with pytest.raises(UsageError, match="--num-demos 3: method trpo learns from no demonstrations"):
        train.make_plan(train.make_parser().parse_args(given))


def test_a_sweep_refuses_a_grid_over_what_makes_no_difference(tmp_path: Path) -> None:
    spec = {"env": "Swimmer", "method": "ccil", "fixed": {"preset": "tiny"}, "grid": {"cost_limit": [10, 100]}}
    with pytest.raises(UsageError, match=r"--cost-limit 10\.0: method ccil is held to the mean cost of"):
        sweep.variants_of(tmp_path / "s.json", spec, tmp_path)


def test_ablations_give_what_is_shared_to_those_who_use_it_and_refuse_what_nobody_does(tmp_path: Path) -> None:
    shared = {"env": "Swimmer", "meta_learning_rate": 0.02}
    answers = ablations.ask(["meta_gradient", "gate"], shared, tmp_path)
    assert answers["meta_gradient", "full"].plan.config.meta_learning_rate == 0.02
    assert answers["meta_gradient", "none"].plan.config == Config.from_preset(
        "paper", method="malm", meta_gradient="none"
    ).replace(cost_limit=answers["gate", "batch"].plan.config.cost_limit)
    with pytest.raises(ConfigError, match=r"^gate episode: makes no difference to this run of method malm"):
        ablations.ask(["meta_gradient"], {**shared, "gate": "episode"}, tmp_path)


# Presets and limits -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("method", METHODS)
def test_every_preset_suits_every_method_that_it_is_given_to(preset: str, method: str) -> None:
    """What a preset says of other methods is left out; what it says of this one stays."""
    limit = {"cost_limit": 1.0} if METHODS[method].limit == "prescribed" else {}
    config = Config.from_preset(preset, **{"method": method, **limit})
    idle = unused(config)
    for name, value in PRESETS[preset].items():
        if name != "method":
            assert getattr(config, name) == (getattr(Config(), name) if name in idle else value)
    assert all(getattr(config, name) == getattr(Config(), name) for name in idle)


def test_a_limit_is_resolved_once_and_never_contradicted() -> None:
    config = with_limit_of(Config(method="ccil"), 18.0)
    assert config.cost_limit == 18.0
    assert config.prescribed_limit is None
    assert with_limit_of(config, 18.0) == config
    with pytest.raises(ConfigError, match=r"^cost_limit 18\.0: method ccil is held to the mean cost"):
        with_limit_of(config, 24.0)
    prescribed = Config(method="lgail", cost_limit=5.0)
    assert with_limit_of(prescribed, 18.0) == prescribed
    assert prescribed.prescribed_limit == 5.0
    with pytest.raises(ConfigError, match=r"cost_limit 9\.0: method malm is held to"):
        build.resolve(walk_config(method="malm").replace(cost_limit=9.0), Walk(), walk_demonstrations())


def test_the_methods_with_a_multiplier() -> None:
    """The package's own, and of every row: it has one where its constraint has a state that changes."""
    assert {"malm", "ccil", "lgail", "pid_il", "expert"} <= {n for n in METHODS if Config(method=n).has_multiplier}
    for name, row in METHODS.items():
        constraint = (
            constraints.make(Config(method=name, cost_limit=1.0)) if row.constraint else constraints.Constraint()
        )
        assert row.has_multiplier == bool(jax.tree.leaves(constraint.init()))
    assert not Config(method="ccil", multiplier_update="optimal").has_multiplier
    assert Config(method="ccil", multiplier_update="pid").has_multiplier


def test_the_keywords_that_editors_know_are_the_fields() -> None:
    assert typing.get_type_hints(Fields) == typing.get_type_hints(Config)
