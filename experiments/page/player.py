"""The HTML of a figure that plays films side by side; player.js moves them."""

import html
import json
from collections.abc import Sequence
from importlib import resources
from typing import Any

import numpy as np

from experiments.page.film import Film
from experiments.page.strokes import COLORS, PAID

_MILLIMETRES = 1000


def script() -> str:
    """The script that a page with players needs once, after the last of them."""
    return f"<script>{resources.files('experiments.page').joinpath('player.js').read_text(encoding='utf-8')}</script>"


def figure(films: Sequence[tuple[str, Film]], caption: str) -> str:
    """The HTML of a figure that plays films together, each under a title of its own."""
    panes = "".join(
        f"<div class=pane><h4>{html.escape(title)}</h4><canvas></canvas>"
        "<p class=counters>return <b class=return></b> cost <b class=cost></b> <span class=ended></span></p></div>"
        for title, _ in films
    )
    span = max(film.span for _, film in films)  # one scale, so that they can be compared
    content = json.dumps([_content(film, span) for _, film in films], separators=(",", ":"), allow_nan=False)
    single = "" if len(films) > 1 else " single"
    return (
        f"<figure class='player {films[0][1].view}{single}'><div class=panes>{panes}</div>"
        "<div class=controls><button type=button>Play</button>"
        "<input type=range min=0 value=0 step=1 aria-label='time'><output class=clock></output></div>"
        f"{_legend([film for _, film in films])}<figcaption>{html.escape(caption)}</figcaption>"
        f"<script type='application/json'>{content}</script></figure>"
    )


def _content(film: Film, span: float) -> dict[str, Any]:
    """What player.js reads of a film. Lines that never move are there once."""
    centre = np.round(_MILLIMETRES * film.centre).astype(int)
    ends = _MILLIMETRES * film.strokes.places - np.tile(centre, 2)[:, None]
    ends = np.round(ends).astype(int)
    is_still = (ends == ends[0]).all(axis=(0, 2))
    decimals = 0 if np.array_equal(film.costs, np.round(film.costs)) else 1
    return {
        "view": film.view,
        "aspect": film.aspect,
        "span": round(_MILLIMETRES * span),
        "centre": centre.tolist(),
        "way": [] if film.way is None else np.round(_MILLIMETRES * film.way).astype(int).tolist(),
        "shapes": [
            [COLORS[shape.kind], round(_MILLIMETRES * shape.width), shape.is_round, shape.kind in ("body", "robot")]
            for shape in film.strokes.shapes
        ],
        "still": [place if still else None for place, still in zip(ends[0].tolist(), is_still.tolist(), strict=True)],
        "place": (np.cumsum(~is_still) - 1).tolist(),
        "moving": ends[:, ~is_still].reshape(len(ends), -1).tolist(),
        "steps": film.steps.tolist(),
        "returns": [None if np.isnan(value) else round(float(value), 2) for value in film.returns],
        "costs": np.round(film.costs.astype(np.float64), 2).tolist(),
        "decimals": decimals,
        "paid": film.paid.astype(int).tolist(),
        "dt": film.dt,
        "red": PAID,
    }


def _legend(films: Sequence[Film]) -> str:
    kinds = dict.fromkeys(shape.kind for film in films for shape in film.strokes.shapes if shape.kind != "body")
    rows = [(COLORS[kind], kind.replace("_", " ")) for kind in kinds] + [(PAID, "a cost is paid")]
    return legend(rows)


def legend(rows: Sequence[tuple[str, str]]) -> str:
    """The HTML of a legend: colours, in CSS's form, and what they stand for."""
    items = "".join(f"<li><i style='background:{color}'></i>{html.escape(text)}</li>" for color, text in rows)
    return f"<ul class=legend>{items}</ul>"
