"""Ablations: every answer is a configuration that runs, few programs, and figures that are what they are called."""

import csv
from collections.abc import Collection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ccil_jax.config import Config, validate
from ccil_jax.methods import METHODS
from experiments import ablations
from experiments.ablations import QUESTIONS
from experiments.runs import plans, run_folder
from experiments.runs.metrics_file import MetricsWriter
from experiments.sweeps import comparison, comparison_figures, variants
from experiments.sweeps.comparison import Row, multiplier_path

SHARED = {"env": "Swimmer"}


@pytest.mark.parametrize("name", QUESTIONS)
def test_every_answer_is_a_configuration(name: str) -> None:
    configs = [Config(method=QUESTIONS[name].method, **changes) for changes in QUESTIONS[name].answers.values()]
    for config in configs:
        validate(config)
    assert len(set(configs)) == len(configs) >= 2


def test_the_first_answer_is_the_papers_or_that_of_the_default(tmp_path: Path) -> None:
    """In the names of baselines there is no change. The newer questions are about the preset `default`."""

    def changed(names: Collection[str], preset: str) -> set[str]:
        answers = ablations.ask(list(names), {**SHARED, "preset": preset}, tmp_path)
        return {name for name in names if answers[name, next(iter(QUESTIONS[name].answers))].name not in METHODS}

    newer = {"cloning_updates", "action_likelihood", "cloning_weight", "warmup_iterations", "outer_loss", "gap_unit"}
    newer |= {"critic_intervals", "critic_target", "cost_gae_lambda", "mirrored_demonstrations", "batch_size"}
    newer |= {"imitation_reward", "policy_average", "cloning_selection", "evaluated_action"}
    assert changed(QUESTIONS, "paper") == newer
    assert changed(newer, "default") == set()


def test_traced_answers_share_a_program_and_baselines_have_their_own(tmp_path: Path) -> None:
    answers = ablations.ask(list(QUESTIONS), SHARED, tmp_path)
    different = {variant.name: variant for variant in answers.values()}
    programs = variants.group(different.values(), tmp_path)
    names = [{variant.name for variant in program.variants} for program in programs]
    assert {"malm"} in names
    assert {"cvag"} in names
    assert {
        *(f"malm,multiplier_learning_rate={rate}" for rate in (0.01, 0.2)),
        *(f"malm,meta_learning_rate={rate}" for rate in (0.01, 0.2)),
        *(f"malm,initial_multiplier={start}" for start in (1.0, 10.0)),
        *(f"malm,discriminator_learning_rate={rate}" for rate in (3e-05, 0.0)),
        "malm,cost_gae_lambda=0.9",
    } in names
    assert sum(map(len, names)) == len(different)
    # As few as there are static configurations, and at most one more for each baseline's speed.
    static = {plans.static_values(variant.plan.config) for variant in different.values()}
    assert len(static) < len(programs) <= len(static) + sum(variant.alone for variant in different.values())


def test_a_program_is_the_same_to_its_worker(tmp_path: Path) -> None:
    shared = {**SHARED, "hidden_sizes": (8, 8), "num_demos": 3, "bootstrap_at_truncation": False}
    chosen = ablations.ask(["windup"], shared, tmp_path).values()
    for job in variants.group(chosen, tmp_path):
        variants.write_job(job)
        read = variants.read_job(job.folder)
        for variant, again in zip(job.variants, read.variants, strict=True):
            assert again.plan.config == variant.plan.config
            assert again.plan.folder == variant.plan.folder
            assert again.plan.config.hidden_sizes == (8, 8)
            assert again.plan.setup.demonstrations is not None
            assert again.plan.setup.demonstrations.num_episodes == 3


def test_the_path_of_a_multiplier() -> None:
    """By hand: two seeds, twenty iterations, so that the last two are the final ones."""
    wound = np.array([0.0] * 4 + [4.0] * 4 + [2.0] * 10 + [1.0, 1.0])
    steady = np.full(20, 0.5)
    cost = np.array([30.0] * 6 + [20.0] * 14)
    metrics = {"multiplier": np.stack([wound, steady], 1), "episode_cost": np.stack([cost, cost], 1)}
    path = multiplier_path(Config(method="ccil"), metrics, limit=25.0)
    assert path["max_multiplier"] == (4.0 + 0.5) / 2
    assert path["final_multiplier"] == (1.0 + 0.5) / 2
    assert path["windup"] == pytest.approx((2 + 10) / 20 / 2)  # below the limit from 6 on, above 1 up to 17
    metrics["episode_cost"][:2] = np.nan  # before the first episode has ended
    assert multiplier_path(Config(method="ccil"), metrics, limit=25.0)["windup"] == pytest.approx((2 + 10) / 18 / 2)
    metrics["episode_cost"][:] = np.nan
    assert multiplier_path(Config(method="ccil"), metrics, limit=25.0)["windup"] is None


@pytest.mark.parametrize("changes", [{"method": "gail"}, {"method": "ccil", "multiplier_update": "optimal"}])
def test_a_method_without_a_multiplier_has_no_path(changes: dict[str, str]) -> None:
    """Whatever it logs."""
    metrics = {"multiplier": np.zeros((20, 2)), "episode_cost": np.ones((20, 2))}
    assert set(multiplier_path(Config(**changes), metrics, limit=25.0).values()) == {None}


def row(question: str, answer: str, level: float, rate: float | None, num_runs: int = 3) -> Row:
    content: Row = {"question": question, "answer": answer, "task": "Swimmer", "num_seeds": 3}
    content |= {"env_steps_per_second": rate, "runs_in_program": num_runs, "final_multiplier": 0.5}
    for i, name in enumerate(comparison.SCORES):
        values = [level, level + i, level + 2 * i]
        content |= {name: level + i, f"{name}_low": level, f"{name}_high": level + 2 * i, f"{name}_per_seed": values}
    return content


@pytest.mark.parametrize(
    ("rate", "num_runs", "expected"), [(50.0, 3, 0.5), (50.0, 6, None), (None, 3, None), (100.0, 3, 1.0)]
)
def test_speeds_compare_only_among_programs_of_one_size(rate: Any, num_runs: int, expected: Any) -> None:
    baseline = row("gate", "batch", 1.0, 100.0)
    assert ablations._relative_speed(row("gate", "episode", 1.0, rate, num_runs), baseline) == expected


def test_table_and_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [row("gate", "batch", 90.0, 100.0), row("gate", "episode", 95.0, None), row("windup", "1.0", 80.0, 90.0)]
    comparison.write_csv(tmp_path / "t.csv", rows)
    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert lines[0].startswith("question,answer,task,num_seeds")
    assert lines[2].startswith("gate,episode,Swimmer,3,,3,0.5,95,95,95,95 95 95,96,95,97,95 96 97")
    columns = {"answer": "answer", "recovered_return": "recovered", "env_steps_per_second": "steps/s"}
    comparison.print_rows("t", columns, rows, section="question")
    printed = capsys.readouterr().out
    assert "97.00 [95.00, 99.00]" in printed
    comparison_figures.draw_groups(tmp_path / "t.png", {"a": rows[:2], "b": rows[2:]}, "answer", "t")
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")


def test_few_seeds_have_no_interval_and_violations_are_marked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the run folder to table, CSV file and figure. The second is of an earlier version, and lacks a score."""
    rows = []
    for name, values, marks in (("[red]", [2.0, 4.0], {"violation_beyond_error": True}), ("$_{x$", [1.0, None], {})):
        folder = tmp_path / name
        folder.mkdir()
        seeds = [dict.fromkeys(comparison.SCORES, value) for value in values]
        levels = {"expert_cost": 30.0, "cost_limit": None, "env_steps": 9, "env_steps_per_second": None}
        run_folder.write_json(folder / "summary.json", {"per_seed": seeds, **levels, "runs_in_program": 2, **marks})
        with MetricsWriter(folder) as writer:
            writer.begin({"env_steps": np.ones((1, 2)), "multiplier": np.zeros((1, 2))})
        setup = SimpleNamespace(task="Swimmer", num_seeds=2)
        plan = SimpleNamespace(folder=folder, setup=setup, config=Config(method="cvag"))
        rows.append(comparison.row(SimpleNamespace(name=name, plan=plan)))
    comparison.write_csv(tmp_path / "t.csv", rows)
    with (tmp_path / "t.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    scores = [first[f"relative_cost_violation{x}"] for x in ("", "_low", "_high", "_per_seed")]
    assert scores == ["3", "", "", "2 4"]
    assert (first["violation_beyond_error"], second["violation_beyond_error"]) == ("True", "")
    assert (first["final_multiplier"], second["relative_cost_violation"]) == ("", "")
    columns = {"variant": "variant", "episode_cost": "cost", "relative_cost_violation": "rel. violation"}
    comparison.print_rows("t", columns, rows)
    printed = capsys.readouterr().out
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in printed.splitlines() if "│" in line]
    assert cells == [["[red]", "3.00 [-]", "3.00 [-] *"], ["$_{x$", "-", "-"]]
    assert "*: beyond the demonstrations' error; -: no interval below 3 seeds" in " ".join(printed.split())
    comparison_figures.draw_groups(tmp_path / "t.png", {"$_{x$": rows}, "variant", "$_{x$")
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")
