"""Small films for tests of players and videos, drawn by hand."""

from typing import Any

import numpy as np

from experiments.page.film import Film
from experiments.page.strokes import Shape, Strokes


def make_film(length: int = 6, **changes: Any) -> Film:
    """A bar of 1 m that moves up by 0.1 m a frame, beside a hazard; return 1.5 a frame; the third frame pays a cost."""
    height = 0.1 * np.arange(length)
    places = np.zeros((length, 2, 4))
    places[:, 0] = [1.0, 1.0, 1.0, 1.0]
    places[:, 1] = np.stack([-0.5 + 0 * height, height, 0.5 + 0 * height, height], axis=1)
    paid = np.arange(length) == 2
    fields: dict[str, Any] = {
        "view": "side",
        "strokes": Strokes((Shape("hazards", 0.4, True), Shape("body", 0.1, True)), places),
        "centre": np.zeros((length, 2)),
        "span": 4.0,
        "way": None,
        "steps": 2 * np.arange(length),
        "returns": 1.5 * np.arange(length),
        "costs": np.cumsum(paid).astype(np.float64),
        "paid": paid,
        "dt": 0.016,
    }
    return Film(**{**fields, **changes})
