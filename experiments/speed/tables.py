"""Measured speeds as terminal tables."""

from collections.abc import Sequence
from typing import Any

from experiments.cli.tables import show


def print_rows(rows: Sequence[dict[str, Any]]) -> None:
    """Rows of `measuring.measure` as a terminal table."""
    from rich.table import Table

    table = Table(title="control steps per second, all seeds together", title_justify="left")
    for title in ("task", "seeds x envs", "physics alone", "rollout", "training"):
        table.add_column(title, justify="left" if title == "task" else "right", no_wrap=True)
    for title in ("training / physics", "training / rollout", "meta-gradient / policy step", "compile, s", "peak, MiB"):
        table.add_column(title, justify="right")
    for row in rows:
        rates = [row[f"{name}_steps_per_second"] for name in ("physics", "rollout", "training")]
        table.add_row(
            f"{row['task']} ({row['physics']})",
            f"{row['num_seeds']} x {row['num_envs']}",
            *(f"{rate:,.0f}" for rate in rates),
            f"{row['training_to_physics']:.2f}",
            f"{row['training_to_rollout']:.2f}",
            f"{row['meta_gradient_to_policy_step']:.2f}",
            f"{row['compile_seconds']:.1f}",
            f"{row['peak_memory']:,.0f}",
        )
    show(table)


def print_profiles(rows: Sequence[dict[str, Any]]) -> None:
    """Rows of `profiling.profile` as a terminal table: the parts of an iteration."""
    from rich.table import Table

    table = Table(
        title="microseconds per environment step, all seeds together (ratio to physics)", title_justify="left"
    )
    table.add_column("part")
    for row in rows:
        table.add_column(f"{row['task']}, {row['num_seeds']} x {row['num_envs']}", justify="right")
    for part in rows[0]["parts"]:
        of_rows = [row["parts"][part] for row in rows]
        table.add_row(part, *(f"{x['microseconds_per_step']:.2f} ({x['to_physics']:.2f})" for x in of_rows))
    show(table)


def print_peers(compared: Sequence[dict[str, Any]]) -> None:
    """Comparisons of `peers.compare` as a terminal table."""
    from rich.table import Table

    table = Table(title="training, environment steps per second", title_justify="left")
    for title in ("trainer", "steps/s", "ours : it"):
        table.add_column(title, justify="left" if title == "trainer" else "right")
    for comparison in compared:
        for way, rates in comparison["ways"].items():
            table.add_row(f"{comparison['peer']}, {way}", " ".join(f"{rate:,.0f}" for rate in rates), "")
        for seeds, rate in comparison["our_steps_per_second"].items():
            ours = f"ours: {comparison['our_method']} on {comparison['task']}, {seeds} seed(s)"
            table.add_row(ours, f"{rate:,.0f}", f"{comparison['ratio'][seeds]:.1f}")
        table.add_section()
    show(table)
