"""Demonstrations by the policy of a finished run: which seed is recorded, and what the file says about it."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations
from experiments.cli.command_line import UsageError
from experiments.cli.tables import number, show, with_error
from experiments.runs import run_folder
from experiments.runs.provenance import provenance
from experiments.runs.run_folder import Run

_SCORES = ("episode_return", "episode_cost", "episode_length")


def cost_limit(run: Run) -> float | None:
    """The limit of the episode cost in the training of a run; None for a method without a limit."""
    limits = {"prescribed": run.config.cost_limit, "demonstrations": run.facts["expert_cost"], None: None}
    limit: float | None = limits[run.config.row.limit]
    return limit


def choose_seed(rows: Sequence[dict[str, Any]], cost_limit: float | None) -> int | None:
    """The seed with the highest mean return among those whose mean cost is within the limit; None if there is none."""
    allowed = [row for row in rows if cost_limit is None or row["episode_cost"] <= cost_limit]
    return max(allowed, key=lambda row: row["episode_return"])["seed"] if allowed else None


def find_seed(run: Run, rows: Sequence[dict[str, Any]], seed_index: int | None) -> int:
    """The seed to record: `seed_index`, or where that is None the one that `expert` would choose.

    Args:
        run: whose policies there are.
        rows: of its seeds, from summary.json.
        seed_index: what a person has chosen, a seed of the run.

    Raises:
        UsageError: no seed keeps the limit.
    """
    if seed_index is None:
        limit = cost_limit(run)
        seed_index = choose_seed(rows, limit)
        if seed_index is None:
            costs = ", ".join(f"seed {row['seed']}: {row['episode_cost']:g}" for row in rows)
            raise UsageError(
                f"--record: no seed keeps the cost limit {limit:g} ({costs}); choose one by --seed-index N"
            )
    return seed_index


def read_summary(run: Run) -> dict[str, Any]:
    """The content of the run's summary.json. Raises `UsageError` if the run is not finished or the file is damaged."""
    path = run.folder / "summary.json"
    unfinished = f"--record: the run in {run.folder} is not finished; continue it with --resume"
    if not path.is_file():
        raise UsageError(unfinished)
    summary = run_folder.read_json(path)
    try:
        numbers = [row[name] for row in summary["per_seed"] for name in ("seed", *_SCORES)]
        numbers += [summary[name] for name in ("env_steps", "random_return", "random_cost")]
        is_whole = all(isinstance(number, int | float) for number in numbers) and numbers[:-3] != []
    except (KeyError, TypeError):
        is_whole = False
    if not is_whole:
        raise UsageError(f"{path}: numbers are missing; repeat the evaluation with --resume")
    if run_folder.was_continued(run, summary):
        raise UsageError(unfinished)
    return summary


def training(run: Run, env_steps: int | None) -> dict[str, Any]:
    """How the policies of a run were trained, for the metadata of files that hold them or their episodes.

    `env_steps` is how long, None where the run is not finished.
    """
    return {
        "task": run.facts["task"],
        "method": run.config.method,
        "cost_limit": cost_limit(run),
        "evaluated_action": run.config.evaluated_action,
        "env_options": run.facts["env_options"],
        "physics": run.facts["physics"],
        "env_steps": env_steps,
        "seed": run.facts["seed"],
        "trained_with": {name: run.facts.get(name) for name in ("versions", "git_commit")},
    }


def facts(
    trained: Mapping[str, Any], scores: Mapping[str, Any], seed_index: int, num_episodes: int | None, command: str
) -> dict[str, Any]:
    """The metadata of demonstrations by one seed of a training.

    Args:
        trained: what `training` says of it.
        scores: an evaluation: `per_seed`, `random_return` and `random_cost`, as in summary.json.
        seed_index: the seed that acts, as it is called in `per_seed`.
        num_episodes: of each seed in the evaluation; None where an earlier version did not say so.
        command: the commands that made the demonstrations, one a line.
    """
    (row,) = [row for row in scores["per_seed"] if row["seed"] == seed_index]
    limit = trained["cost_limit"]
    errors = {error: row.get(error) for name in _SCORES[:2] if (error := f"{name}_standard_error")}
    return {
        **trained["env_options"],  # here earlier versions look for them; the facts below come first
        **trained,
        "limit_kept": None if limit is None else row["episode_cost"] <= limit,
        "seed_index": seed_index,
        "evaluation": {name: row[name] for name in _SCORES} | errors | {"num_episodes": num_episodes},
        "random_policy": {name: scores[f"random_{name}"] for name in ("return", "cost")},
        **provenance(),
        "command": command,
    }


def record(
    config: Config,
    agents: Any,
    env: Any,
    *,
    num_trajectories: int,
    episode_seed: int,
    seed_index: int,
    facts: Mapping[str, Any],
) -> Demonstrations:
    """Records episodes of one seed's policy.

    Args:
        config: of the policies.
        agents: the policies of all seeds, [num_seeds]-leading.
        env: the task.
        num_trajectories: episodes to record.
        episode_seed: of the episodes.
        seed_index: which of the policies acts.
        facts: the metadata.
    """
    import jax

    from ccil_jax.acting import evaluation

    print(f"recording {num_trajectories} episodes ...", file=sys.stderr, flush=True)
    return evaluation.record(
        config,
        jax.tree.map(lambda leaf: leaf[seed_index], agents),
        env,
        num_episodes=num_trajectories,
        seed=episode_seed,
        metadata={**facts, "episode_seed": episode_seed},
    )


def print_demonstrations(demonstrations: Demonstrations, path: Path) -> None:
    """Prints a table: length, return and cost of each recorded trajectory, their means, and the limit."""
    from rich.table import Table

    returns = demonstrations.episode_returns
    table = Table(title="recorded demonstrations", title_justify="left")
    for heading in ("", "return", "cost", "steps"):
        table.add_column(heading, justify="right" if heading else "left")
    costs, lengths = demonstrations.episode_costs, demonstrations.episode_lengths
    for i, (cost, length) in enumerate(zip(costs, lengths, strict=True)):
        table.add_row(f"trajectory {i}", number(None if returns is None else returns[i]), number(cost), str(length))
    table.add_section()
    mean_return = with_error(demonstrations.mean_episode_return, demonstrations.return_standard_error)
    mean_cost = with_error(demonstrations.mean_episode_cost, demonstrations.cost_standard_error)
    table.add_row("mean +- standard error", mean_return, mean_cost, number(demonstrations.mean_episode_length))
    random = demonstrations.metadata["random_policy"]
    table.add_row("random policy", number(random["return"]), number(random["cost"]), "")
    if demonstrations.metadata["cost_limit"] is not None:
        table.add_row("limit", "", number(demonstrations.metadata["cost_limit"]), "")
    show(table)
    print(f"demonstrations  {path}")
