"""Trains variants of a method that differ in one choice, and compares their results and speeds.

Each question compares several answers; the first one is the baseline. All variants start from the preset `paper` unless
another one is given, so that the baseline is what that preset has. Variants that differ only in numbers inside the
compiled program are trained together in one program. Each baseline and each other variant has a program of its own,
with equally many runs, so that their speeds can be compared.
"""

import argparse
import dataclasses
import functools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ccil_jax.config import Config, check_used, unused
from ccil_jax.demonstrations.trajectories import load_demonstrations
from ccil_jax.presets import PRESETS
from experiments.cli import command_line, options
from experiments.cli.command_line import Parser, UsageError
from experiments.runs import plans
from experiments.sweeps import comparison, dispatch
from experiments.sweeps.comparison import Row
from experiments.sweeps.variants import Variant, make_variant


@dataclasses.dataclass(frozen=True)
class Question:
    """One choice of a method: the question, and the changes of `Config` that each answer makes, the baseline first."""

    text: str
    method: str
    answers: Mapping[str, Mapping[str, Any]]


def _one_field(text: str, field: str, values: Sequence[Any], method: str = "malm") -> Question:
    return Question(text, method, {str(value): {field: value} for value in values})


def _preset(name: str, method: str) -> dict[str, Any]:
    """The values that a preset has for fields which the method uses."""
    idle = unused(Config.from_preset(name, method=method))
    return {field: value for field, value in PRESETS[name].items() if field not in idle}


def _after_cloning(text: str, field: str, values: Sequence[Any]) -> Question:
    return Question(text, "malm", {str(value): {"cloning_updates": 20_000, field: value} for value in values})


QUESTIONS: Mapping[str, Question] = {
    "cloning_updates": _one_field("Does it help to begin with a clone?", "cloning_updates", (20_000, 0)),
    "cloning_selection": _after_cloning(
        "Is cloning ended by the lowest held-out loss, or by what that cannot tell from it?",
        "cloning_selection",
        ("one_standard_error", "lowest"),
    ),
    "action_likelihood": _one_field(
        "Is an action at a bound taken for all draws beyond it?", "action_likelihood", ("censored", "gaussian")
    ),
    "cloning_weight": Question(
        "How much do the demonstrations weigh in the policy's objective?",
        "malm",
        {"by their number": {"cloning_updates": 20_000, "cloning_weight": None}}
        | {str(value): {"cloning_updates": 20_000, "cloning_weight": value} for value in (0.0, 0.3, 3.0, 10.0)},
    ),
    "warmup_iterations": _after_cloning(
        "Do critics and discriminator need a start before the policy moves?", "warmup_iterations", (5, 0)
    ),
    "imitation_reward": _after_cloning(
        "Is the reward a discriminator's, or the clone's likelihood?", "imitation_reward", ("discriminator", "coherent")
    ),
    "outer_loss": Question(
        "Which outer loss?",
        "malm",
        {
            "lagrangian": {"outer_loss": "lagrangian"},
            "squared": {"outer_loss": "squared"},
            "none": {"meta_gradient": "none"},
        },
    ),
    "gap_unit": Question(
        "Is the gap that the dual step follows relative to the limit?",
        "malm",
        {
            "limit, 0.5": {"multiplier_update": "sgd", "gap_unit": "limit", "multiplier_learning_rate": 0.5},
            "limit, 0.05": {"multiplier_update": "sgd", "gap_unit": "limit", "multiplier_learning_rate": 0.05},
            "cost, 0.0005": {"multiplier_update": "sgd", "gap_unit": "cost", "multiplier_learning_rate": 0.0005},
        },
    ),
    "discriminator_learning_rate": _one_field(
        "How much may the discriminator learn?", "discriminator_learning_rate", (3e-4, 3e-5, 0.0)
    ),
    "policy_average": _one_field(
        "Is what is judged the average of the policies?", "policy_average", ("polynomial_decay", "none")
    ),
    "evaluated_action": _one_field(
        "Does the policy act with its modes when it is judged?", "evaluated_action", ("mode", "sample")
    ),
    "critic_intervals": _one_field("Do critics see observations in intervals?", "critic_intervals", (16, 0)),
    "critic_target": _one_field(
        "Have the critics' targets a lambda of their own?", "critic_target", ("td_lambda", "gae")
    ),
    "cost_gae_lambda": _one_field(
        "How much do the cost's advantages lean on its critic?", "cost_gae_lambda", (0.5, 0.9, 0.97)
    ),
    "mirrored_demonstrations": _one_field(
        "Do mirror images of the demonstrations help?", "mirrored_demonstrations", ("symmetric_tasks", "none")
    ),
    "batch_size": _one_field("How large a batch?", "batch_size", (4000, 2000, 8000)),
    "meta_gradient": _one_field(
        "Does the multiplier's gradient through the policy step help?",
        "meta_gradient",
        ("full", "direct", "indirect", "none"),
    ),
    "multiplier_update": Question(
        "Which dual step?",
        "malm",
        {
            "adam": {"multiplier_update": "adam"},
            "sgd, 0.05 (as printed)": {"multiplier_update": "sgd", "multiplier_learning_rate": 0.05},
            "sgd, 0.0005": {"multiplier_update": "sgd", "multiplier_learning_rate": 0.0005},
        },
    ),
    "multiplier": Question(
        "Whose multiplier, without a meta-gradient?",
        "ccil",
        {
            "adam": {"multiplier_update": "adam"},
            "sgd, 0.0005": {"multiplier_update": "sgd", "multiplier_learning_rate": 0.0005},
            "pid": {"multiplier_update": "pid"},
            "optimal": {"multiplier_update": "optimal"},
        },
    ),
    "preset": Question(
        "The algorithm as printed, or as its authors coded it?",
        "malm",
        {name: _preset(name, "malm") for name in ("paper", "printed", "authors")},
    ),
    "outer_advantage": _one_field(
        "Whose advantages judge the outer step?", "outer_advantage", ("stale", "re-evaluated")
    ),
    "held_out_unit": _one_field("What is held out for it?", "held_out_unit", ("transition", "trajectory")),
    "multiplier_learning_rate": _one_field("How large a dual step?", "multiplier_learning_rate", (0.05, 0.01, 0.2)),
    "meta_learning_rate": _one_field("How large an outer step?", "meta_learning_rate", (0.05, 0.01, 0.2)),
    "windup": _one_field("Does a multiplier that begins too high come down?", "initial_multiplier", (0.01, 1.0, 10.0)),
    "gate": _one_field("One decision per batch or per episode?", "gate", ("batch", "episode"), method="cvag"),
    "reward_form": _one_field("Which imitation reward?", "reward_form", ("softplus", "logit", "log_sigmoid")),
    "discriminator_regularizer": _one_field(
        "What keeps the discriminator smooth?",
        "discriminator_regularizer",
        ("gradient_penalty", "none", "spectral_norm"),
    ),
    "standardize_cost_advantage": _one_field(
        "Is the cost advantage standardised?", "standardize_cost_advantage", (False, True)
    ),
}
COLUMNS = {
    "question": "question",
    "answer": "answer",
    "recovered_return": "recovered return, %",
    "episode_cost": "cost",
    "relative_cost_violation": "rel. violation",
    "final_multiplier": "final lambda",
    "max_multiplier": "highest",
    "windup": "wound up",
    "relative_speed": "steps/s : baseline",
}


def make_parser() -> Parser:
    """The options of this launcher: those of `train`, which all variants share, and where to carry them out."""
    parser = Parser("ablations", __doc__ or "")
    parser.add_argument(
        "--questions",
        nargs="+",
        choices=tuple(QUESTIONS),
        default=tuple(QUESTIONS),
        metavar="NAME",
        help=f"of {', '.join(QUESTIONS)} (default: all)",
    )
    dispatch.add_options(parser)
    plans.add_options(parser, with_method=False)
    return parser


def ask(names: Sequence[str], shared: Mapping[str, Any], out: Path) -> dict[tuple[str, str], Variant]:
    """The variant of each (question, answer). Answers that lead to the same `Config` have the same variant.

    Args:
        names: of the questions.
        shared: options of `train` that all variants have.
        out: folder of the whole study.

    Raises:
        UserError: an option is wrong, or makes no difference to any of the variants.
    """
    found: dict[str, Variant] = {}
    answers = {}
    fields = {"preset": "paper", **shared}
    chosen = [(name, answer) for name in names for answer in QUESTIONS[name].answers]
    configs = {key: _config(fields, QUESTIONS[key[0]].answers[key[1]], QUESTIONS[key[0]].method) for key in chosen}
    idle = {key: set(unused(config)) for key, config in configs.items()}
    in_vain = {name: shared[name] for name in shared if all(name in unused_here for unused_here in idle.values())}
    check_used(configs[chosen[0]].replace(**in_vain), in_vain)
    load = functools.cache(load_demonstrations)
    for name, answer in chosen:
        question = QUESTIONS[name]
        plain, changes = _config(fields, {}, question.method), question.answers[answer]
        folder = _name(plain, changes)
        baseline = answer == next(iter(question.answers))
        if folder not in found or (baseline and not found[folder].alone):
            # An option that makes a difference to one variant may make none to another, which would refuse it.
            own = {field: value for field, value in fields.items() if field not in idle[name, answer]}
            options_of_variant = {**own, "method": question.method, **changes}
            found[folder] = make_variant(folder, options_of_variant, out, load=load, alone=baseline)
        answers[name, answer] = found[folder]
    return {key: found[variant.name] for key, variant in answers.items()}


def _config(fields: Mapping[str, Any], changes: Mapping[str, Any], method: str) -> Config:
    """The configuration of an answer. Fields that make no difference to it have their default values."""
    given = {name: value for name, value in fields.items() if name in options.CONFIG_FIELDS}
    return Config.from_base({**PRESETS[fields["preset"]], **given, **changes, "method": method}, {})


def _name(plain: Config, changes: Mapping[str, Any]) -> str:
    different = (f"{field}={value}" for field, value in changes.items() if getattr(plain, field) != value)
    return ",".join([plain.method, *different])


def rows_of(answers: Mapping[tuple[str, str], Variant]) -> list[Row]:
    """One row for each answer whose variant is finished, with its speed relative to the question's baseline."""
    rows, baselines = [], {}
    for (question, answer), variant in answers.items():
        if not variant.finished:
            continue
        row = {"question": question, "answer": answer, **comparison.row(variant)}
        if answer == next(iter(QUESTIONS[question].answers)):
            baselines[question] = row
        rows.append(row | {"relative_speed": _relative_speed(row, baselines.get(question))})
    return rows


def _relative_speed(row: Row, baseline: Row | None) -> float | None:
    """Steps per second relative to the baseline.

    None where the two cannot be compared: their programs had different numbers of runs, or one took no new step.
    """
    if baseline is None or row["runs_in_program"] != baseline["runs_in_program"]:
        return None
    rates = row["env_steps_per_second"], baseline["env_steps_per_second"]
    return rates[0] / rates[1] if all(rates) else None


def run(arguments: argparse.Namespace) -> int:
    """Trains what is missing, then writes ablations.csv and ablations.png.

    Returns the exit status, 1 if a program failed.
    """
    own = ("questions", *dispatch.option_names())
    shared = {name: value for name, value in vars(arguments).items() if name not in own}
    task = options.find_task(shared.get("env"))
    answers = ask(arguments.questions, shared, arguments.out)
    different = list({variant.name: variant for variant in answers.values()}.values())
    choices = {name: str(value) for name, value in shared.items()}
    num_failed = dispatch.carry_out(different, arguments, "ablations.json", choices)
    rows = rows_of(answers)
    if not rows:
        raise UsageError(f"--out {arguments.out}: no variant was finished; see the worker.log of each program there")
    comparison.write_csv(arguments.out / "ablations.csv", rows)
    from experiments.sweeps import comparison_figures  # imports matplotlib

    figure = arguments.out / "ablations.png"
    seeds = f"{rows[0]['num_seeds']} seeds, {rows[0]['env_steps']:,} steps each"
    title = f"{task.name}, {seeds}: interquartile mean and 95 % interval, dots: seeds, dashed: the expert"
    groups = {q.text: [row for row in rows if row["question"] == name] for name, q in QUESTIONS.items()}
    comparison_figures.draw_groups(figure, {k: v for k, v in groups.items() if v}, "answer", title)
    comparison.print_rows(f"{task.name}, {seeds}: IQM [95 % interval]", COLUMNS, rows, section="question")
    print(
        "wound up: share of the iterations with the cost below its limit and lambda above its final value\n"
        f"table   {arguments.out / 'ablations.csv'}\nfigure  {figure}"
    )
    return 1 if num_failed else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
