"""Trains every combination of a grid of hyperparameters, and compares them in one table and one figure.

SPEC is a TOML or JSON file. Its fields are the options of `train`; those under `grid` have a list of values each:

    env = "Swimmer"
    method = "malm"

    [fixed]
    num_seeds = 3
    env_steps = 300000

    [grid]
    multiplier_learning_rate = [0.01, 0.05, 0.2]
    hidden_sizes = [[64, 64], [100, 100]]

Combinations that differ only in numbers inside the compiled program, such as learning rates, are trained together in
one program, with all their seeds. Any other difference, such as in the task, the method or the sizes of networks, takes
another program. Programs run in worker processes on this machine, on a Ray cluster, or under SLURM; a worker that dies
is replaced once. An interrupted sweep goes on with --resume, and does not repeat what is finished.
"""

import argparse
import functools
import itertools
import sys
from collections.abc import Hashable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ccil_jax.demonstrations.trajectories import load_demonstrations
from ccil_jax.errors import UserError
from experiments.cli import command_line, settings_file
from experiments.cli.command_line import Parser, UsageError
from experiments.cli.names import safe_name
from experiments.cli.settings_file import text
from experiments.sweeps import comparison, dispatch
from experiments.sweeps.variants import Variant, make_variant, run_of

_KEYS = ("env", "method", "fixed", "grid")
_LONGEST_NAME = 120  # of a variant's folder; longer names are replaced by numbers
_COLUMNS = {
    "variant": "variant",
    "episode_return": "return",
    "episode_cost": "cost",
    "recovered_return": "recovered return, %",
    "relative_cost_violation": "rel. violation",
    "final_multiplier": "final lambda",
}


def make_parser() -> Parser:
    """The options of this launcher."""
    parser = Parser("sweep", __doc__ or "")
    parser.add_argument("spec", type=Path, metavar="SPEC", help="TOML or JSON file that names what to train")
    dispatch.add_options(parser)
    return parser


def read_spec(path: Path) -> dict[str, Any]:
    """The content of a spec; `fixed` and `grid` are always there. Raises `UsageError` for a missing or wrong file."""
    spec = settings_file.read(path, "SPEC")
    if unknown := [key for key in spec if key not in _KEYS]:
        raise UsageError(f"SPEC {path}: '{unknown[0]}': unknown; give env, method, and the rest under fixed or grid")
    spec = {"fixed": {}, "grid": {}, **spec}
    for table in ("fixed", "grid"):
        if not isinstance(spec[table], dict):
            raise UsageError(f"SPEC {path}: {table}: give a table of fields")
        fields = [field.replace("-", "_") for field in spec[table]]  # both are the same option
        for field in fields:
            if fields.count(field) > 1 or (table == "fixed" and field in spec):
                raise UsageError(f"SPEC {path}: {table}.{field}: given twice; leave one out")
        spec[table] = dict(zip(fields, spec[table].values(), strict=True))
    _check_grid(path, spec)
    return spec


def _check_grid(path: Path, spec: Mapping[str, Any]) -> None:
    if not spec["grid"]:
        raise UsageError(f"SPEC {path}: grid: empty; give at least one field with a list of values")
    for field, values in spec["grid"].items():
        if not isinstance(values, list) or not values:
            raise UsageError(f"SPEC {path}: grid.{field}: give a list of at least one value")
        if len({text(value) for value in values}) < len(values):
            raise UsageError(f"SPEC {path}: grid.{field}: the same value twice")
        if field in {**spec, **spec["fixed"]}:
            raise UsageError(f"SPEC {path}: grid.{field}: also given outside of the grid; leave one out")


def points(grid: Mapping[str, Sequence[Any]]) -> Iterator[dict[str, Any]]:
    """Every combination of the values; those of the last field change fastest."""
    for values in itertools.product(*grid.values()):
        yield dict(zip(grid, values, strict=True))


def variants_of(path: Path, spec: Mapping[str, Any], out: Path) -> dict[str, tuple[Variant, dict[str, Any]]]:
    """The variants by name, each with its point of the grid. Raises `UsageError`, which names the spec."""
    common = {key: spec[key] for key in ("env", "method") if key in spec} | spec["fixed"]
    load = functools.cache(load_demonstrations)
    found: dict[str, tuple[Variant, dict[str, Any]]] = {}
    names: dict[Hashable, str] = {}
    for i, point in enumerate(points(spec["grid"])):
        name = safe_name(",".join(f"{field}={text(value)}" for field, value in point.items()))
        name = name if len(name) <= _LONGEST_NAME else f"variant_{i}"
        try:
            variant = make_variant(name, {**common, **point}, out, load=load)
        except UserError as error:
            raise UsageError(f"SPEC {path}: {error.on_command_line()}") from None
        if name in found:
            raise UsageError(f"SPEC {path}: grid: two points would share the folder {name}; rename what differs")
        if (run := run_of(variant)) in names:
            raise UsageError(f"SPEC {path}: grid: {name} is the same run as {names[run]}; leave one of them out")
        found[name] = variant, point
        names[run] = name
    return found


def run(arguments: argparse.Namespace) -> int:
    """Trains what is missing, then writes sweep.csv and sweep.png. Returns the exit status, 1 if a program failed."""
    spec = read_spec(arguments.spec)
    found = variants_of(arguments.spec, spec, arguments.out)
    num_failed = dispatch.carry_out([variant for variant, _ in found.values()], arguments, "sweep.json", spec)
    rows = [
        {**{field: text(value) for field, value in point.items()}, **comparison.row(variant)}
        for variant, point in found.values()
        if variant.finished
    ]
    if not rows:
        raise UsageError(f"--out {arguments.out}: no variant was finished; see the worker.log of each program there")
    table, figure = arguments.out / "sweep.csv", arguments.out / "sweep.png"
    comparison.write_csv(table, rows)
    from experiments.sweeps import comparison_figures  # imports matplotlib

    groups = {task: [row for row in rows if row["task"] == task] for task in dict.fromkeys(r["task"] for r in rows)}
    title = "interquartile mean and 95 % interval over seeds, dots: seeds"
    comparison_figures.draw_groups(figure, groups, "variant", title)
    comparison.print_rows("IQM over seeds [95 % interval]", _COLUMNS, rows, section="task")
    print(f"table   {table}\nfigure  {figure}")
    return 1 if num_failed else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return command_line.run_launcher(make_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())
