"""The table of results of the preset `default`: `python docs/results/make_table.py [RUN ...]`.

Takes finished runs into `shipped.json`, where each replaces the entry of the same task, demonstrations, method and
steps, and writes the table of `docs/results.md` anew from it.
"""

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from envs.registry import TASKS

NUMBERS = Path(__file__).parent / "shipped.json"
PAGE = Path(__file__).parents[1] / "results.md"
METHODS = ("bc", "gail", "malm")  # in this order
HEADER = (
    "| task, demonstrations | method | steps | recovered return of each seed, % | mean | cost of each seed | mean "
    "| the demonstrations' cost |"
)
FEW = 3  # demonstrations, of which the standard error of their cost is not shown: it is hardly known itself
Entry = dict[str, Any]


def entry_of(run: Path) -> Entry:
    """The numbers of a finished run of `experiments.train`."""
    started, ended = (json.loads((run / name).read_text("utf-8")) for name in ("config.json", "summary.json"))

    def each(name: str) -> list[float]:
        return [round(float(seed[name]), 2) for seed in ended["per_seed"]]

    return {
        "task": ended["task"],
        "demonstrations": started["demonstrations"]["num_episodes"],
        "method": ended["method"],
        "env_steps": ended["env_steps"],
        "seed": started["seed"],
        "episodes_per_seed": started["eval_episodes"],
        "deterministic": ended["evaluation"]["deterministic"],
        **{name: ended[name] for name in ("expert_return", "expert_cost", "expert_cost_standard_error")},
        "random_return": ended["random_return"],
        "wall_seconds": round(ended["wall_seconds"]),
        "recovered_return": each("recovered_return"),
        "episode_return": each("episode_return"),
        "episode_return_standard_error": each("episode_return_standard_error"),
        "episode_cost": each("episode_cost"),
        "episode_cost_standard_error": each("episode_cost_standard_error"),
        "git_commit": started["git_commit"],
        "versions": {name: started["versions"][name] for name in ("python", "jax", "mujoco")},
    }


def key(entry: Mapping[str, Any]) -> tuple[int, int, int, int]:
    """What an entry is about, in the order of the table: tasks as in the registry, most demonstrations first."""
    place = list(TASKS).index(entry["task"]), METHODS.index(entry["method"])
    return place[0], -entry["demonstrations"], place[1], entry["env_steps"]


def updated(entries: Sequence[Entry], new: Sequence[Entry]) -> list[Entry]:
    """All entries in the order of the table; a new one takes the place of an old one of the same key."""
    return [entry for _, entry in sorted({key(entry): entry for entry in [*entries, *new]}.items())]


def row(entry: Mapping[str, Any], *, is_first: bool) -> str:
    """A line of the table; the first of a task and its demonstrations tells what those cost.

    The standard error of a mean over the seeds is that over their episodes, as if the policies were given.
    """
    percent = 100 / (entry["expert_return"] - entry["random_return"])
    return_errors = [percent * error for error in entry["episode_return_standard_error"]]
    cells = [
        f"{entry['task']}, {entry['demonstrations']}",
        entry["method"],
        f"{entry['env_steps']:,}" if entry["env_steps"] else "-",
        *each_and_mean(entry["recovered_return"], return_errors),
        *each_and_mean(entry["episode_cost"], entry["episode_cost_standard_error"]),
        demonstrations_cost(entry) if is_first else "",
    ]
    return f"| {' | '.join(cells)} |".replace("|  |", "| |")


def each_and_mean(values: Sequence[float], errors: Sequence[float]) -> tuple[str, str]:
    """The values of the seeds, and their mean with its standard error, which has two digits where one would be 0."""
    error = math.hypot(*errors) / len(errors)
    mean = f"{math.fsum(values) / len(values):.1f} +- {error:.{1 if error >= 0.095 else 2}f}"
    return ", ".join(f"{value:.1f}" for value in values), mean


def demonstrations_cost(entry: Mapping[str, Any]) -> str:
    """Their mean with its standard error, unless they are too few for that."""
    cost, error = entry["expert_cost"], entry["expert_cost_standard_error"]
    return f"{cost:.1f}" if entry["demonstrations"] <= FEW else f"{cost:.1f} +- {error:.1f}"


def table(entries: Sequence[Entry]) -> str:
    """The table in Markdown."""
    lines, before = [HEADER, "|" + "---|" * (HEADER.count("|") - 1)], None
    for entry in entries:
        given = entry["task"], entry["demonstrations"]
        lines.append(row(entry, is_first=given != before))
        before = given
    return "\n".join(lines) + "\n"


def with_table(page: str, entries: Sequence[Entry]) -> str:
    """The page with its table replaced."""
    before, _, rest = page.partition(HEADER)
    return before + table(entries) + "\n" + rest.partition("\n\n")[2]


def main() -> None:
    """Takes in the runs that are named, and writes both files."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="run folder of experiments.train")
    entries = updated(json.loads(NUMBERS.read_text("utf-8")), [entry_of(run) for run in parser.parse_args().runs])
    NUMBERS.write_text("[\n" + ",\n".join(f" {json.dumps(entry)}" for entry in entries) + "\n]\n", encoding="utf-8")
    PAGE.write_text(with_table(PAGE.read_text("utf-8"), entries), encoding="utf-8")


if __name__ == "__main__":
    main()
