"""The checks of Theorem 1 hold, and fail where an ingredient is wrong."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from experiments import theorem1
from experiments.theory import tabular, theorem1_checks, theorem1_methods, theorem1_problem
from experiments.theory.theorem1_problem import Problem


@pytest.fixture(scope="module")
def problem() -> Problem:
    return theorem1_problem.make_problem(1)


def test_every_claim_holds_and_the_figure_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert theorem1.main(["--out", str(tmp_path / "figure.png")]) == 0
    printed = capsys.readouterr().out
    assert printed.count("holds") > 20
    assert "FAILS" not in printed
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_the_constraint_binds_for_one_expert_only(problem: Problem) -> None:
    assert problem.bound_by_cheap.multiplier > 0.05
    assert problem.bound_by_costly.multiplier == 0.0


@pytest.mark.parametrize("wrong", ["flipped discriminator", "half the multiplier", "no constraint"])
def test_a_wrong_ingredient_fails(problem: Problem, monkeypatch: pytest.MonkeyPatch, wrong: str) -> None:
    if wrong == "flipped discriminator":
        monkeypatch.setattr(tabular, "best_discriminator", lambda rho, expert: expert / (rho + expert))
        assert not all(check.passed for check in theorem1_checks.check_discriminator(problem))
        assert not all(check.passed for check in theorem1_checks.check_minimax(problem))
        return
    solution = problem.bound_by_cheap
    other = 0.5 * solution.multiplier if wrong == "half the multiplier" else 0.0
    learner = tabular.learner(problem.process, problem.cheap, theorem1_problem.BETA, other)
    mistaken = dataclasses.replace(problem, bound_by_cheap=learner)
    assert not all(check.passed for check in theorem1_checks.check_slackness(mistaken))
    rounds = np.ones(theorem1_methods.NUM_ROUNDS)
    run = theorem1_methods.Run(cost=rounds, multiplier=solution.multiplier * rounds, distance=0 * rounds)
    assert theorem1_checks.check_methods(mistaken, run, run, solution)[1].passed is False


def test_an_unwritable_folder_is_refused_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(SystemExit, match="2"):
        theorem1.main(["--out", str(tmp_path / "file" / "figure.png")])
    assert "--out" in capsys.readouterr().err
