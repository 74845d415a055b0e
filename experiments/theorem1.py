"""Checks Theorem 1 on a decision process of 5 states and 3 actions, where everything can be computed exactly.

The learner minimises 2 JS(rho, rho_E) - log 4 + max over lambda of lambda (J - J_E) - beta H. Two experts are imitated.
One is cheap: without the constraint, the entropy bonus would make the learner cost more, so the constraint is active.
The other is costly: the constraint is inactive. The table shows for each claim the measured error and the largest error
allowed; if a claim fails, the exit status is 1. docs/theorem1.md gives the assumptions that the printed theorem omits.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.cli import command_line
from experiments.cli.command_line import Parser
from experiments.cli.tables import show
from experiments.theory import theorem1_checks, theorem1_methods, theorem1_problem
from experiments.theory.theorem1_checks import Check


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("theorem1", __doc__ or "")
    parser.add_argument("--seed", default=0, type=command_line.natural, metavar="N", help="of the process (default: 0)")
    parser.add_argument(
        "--out", default=Path("theorem1.png"), type=Path, metavar="FILE", help="figure (default: theorem1.png)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing --out file")
    return parser


def print_checks(checks: Sequence[Check]) -> None:
    """Prints the claims as a table."""
    from rich.table import Table

    table = Table(title="Theorem 1, checked on 5 states and 3 actions", title_justify="left")
    table.add_column("claim")
    for heading in ("measured", "at most", ""):
        table.add_column(heading, justify="right", no_wrap=True)
    for check in checks:
        verdict = "holds" if check.passed else "FAILS"
        table.add_row(check.claim, f"{check.measured:.1e}", f"{check.tolerance:.0e}", verdict)
    show(table)


def run(arguments: argparse.Namespace) -> int:
    """Computes all claims, prints and draws them. Returns the exit status, 1 if a claim fails."""
    command_line.check_new_file(arguments.out, "--out", overwrite=arguments.overwrite)
    command_line.check_writable(arguments.out.parent, "--out")
    problem = theorem1_problem.make_problem(arguments.seed)
    learners, small = theorem1_checks.bounded_learners(problem), theorem1_checks.distances(problem)
    ccil = theorem1_methods.run_ccil(problem)
    cvag, settled = theorem1_methods.run_cvag(problem)
    checks = [
        *theorem1_checks.check_discriminator(problem),
        *theorem1_checks.check_bounded_multiplier(problem, learners),
        *theorem1_checks.check_minimax(problem),
        *theorem1_checks.check_slackness(problem),
        *theorem1_checks.check_small_entropy(small),
        *theorem1_checks.check_methods(problem, ccil, cvag, settled),
    ]
    print_checks(checks)
    from experiments.theory import theorem1_figure  # imports matplotlib: no argument error should wait for it

    theorem1_figure.draw(arguments.out, problem, learners, small, ccil, cvag, settled)
    print(f"figure  {arguments.out}")
    return int(not all(check.passed for check in checks))


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
