"""The figure in which finished variants are compared."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.runs.figures import COLORS, STYLE, png
from experiments.runs.labels import literal
from experiments.sweeps.comparison import Row, note_on_intervals

_MEASURED = {"recovered_return": "recovered return, %", "relative_cost_violation": "rel. violation"}
_RAW = {"episode_return": "return per episode", "episode_cost": "cost per episode"}
_REFERENCES = {"recovered_return": 100.0, "relative_cost_violation": 0.0}  # the expert's


def draw_groups(path: Path, groups: Mapping[str, Sequence[Row]], label: str, title: str) -> None:
    """Writes a PNG file with one panel per group: a line for each row, named by its column `label`.

    On the left is the recovered return, on the right the relative cost violation: the interquartile mean, its 95 %
    interval, and every seed as a dot. If there is no expert to compare with, return and cost themselves are shown.
    Unknown values are left out.
    """
    note = note_on_intervals([row for rows in groups.values() for row in rows])
    known = all(row["recovered_return"] is not None for rows in groups.values() for row in rows)
    sizes = [len(rows) for rows in groups.values()]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 0.34 * sum(sizes) + 0.62 * len(sizes) + 0.9), dpi=150, layout="constrained")
        panels = figure.subplots(len(sizes), 2, squeeze=False, sharex="col", height_ratios=[n + 0.6 for n in sizes])
        for (left, right), (text, rows) in zip(panels, groups.items(), strict=True):
            for axes, name in zip((left, right), _MEASURED if known else _RAW, strict=True):
                _draw_rows(axes, rows, name)
            left.set_yticks(range(len(rows)), [literal(row[label]) for row in rows], color="#22262b")
            left.set_title(literal(text), fontsize=10)
            right.set_yticks(range(len(rows)), [])
        for axes, text in zip(panels[-1], (_MEASURED if known else _RAW).values(), strict=True):
            axes.set_xlabel(text)
        title = literal(f"{title} ({note})" if note else title)
        figure.suptitle(title, x=0.008, horizontalalignment="left", fontsize=10.5, color="#4a4f57")
        path.write_bytes(png(figure))


def _draw_rows(axes: Axes, rows: Sequence[Row], name: str) -> None:
    for i, row in enumerate(rows):
        color = COLORS[i % len(COLORS)]
        value, low, high = np.array([row[name], row[f"{name}_low"], row[f"{name}_high"]], np.float64)  # NaN: not drawn
        axes.plot([low, high], [i, i], color=color, linewidth=2.2, alpha=0.55)
        values = np.array(row[f"{name}_per_seed"], np.float64)
        axes.plot(values, [i] * len(values), linestyle="", marker="o", markersize=3.2, color=color, alpha=0.8)
        axes.plot(value, i, marker="D", markersize=7, color=color, markeredgecolor="white")
    if name in _REFERENCES:
        axes.update_datalim([(_REFERENCES[name], 0), (_REFERENCES[name] + 0.1, 0)])  # no scale of rounding errors
        axes.axvline(_REFERENCES[name], color="#22262b", linewidth=1.0, linestyle=(0, (5, 3)))
    axes.grid(visible=False, axis="y")
    axes.set_ylim(len(rows) - 0.4, -0.6)
