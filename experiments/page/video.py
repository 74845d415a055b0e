"""Videos of films: GIF by Pillow, MP4 by the package imageio-ffmpeg. The frames are drawn as on a page."""

import importlib.util
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from experiments.cli.command_line import UsageError
from experiments.cli.tables import number

if TYPE_CHECKING:
    from experiments.page.film import Film

SUFFIXES = (".gif", ".mp4")
_WIDTH = 640  # pixels; of an arena less, as its pictures are square
_ARENA_WIDTH = 480
_HEADER = 64  # pixels, above the picture: a title, and return and cost so far
_LEGEND = 28  # pixels, below that: the colours of an arena's objects
_FINER = 2  # pictures are drawn larger by this factor and then reduced, so that edges are smooth
_INK, _SOFT, _GRID, _FLOOR = "#22262b", "#5b626c", "#e3e6ea", "#8a8f98"
_LAST_FRAME = 1.0  # s that the last frame stays, before a GIF begins again


def check(path: Path, option: str) -> None:
    """Raises `UsageError`, which names `option`, where no video can be written to a file of this name."""
    if path.suffix not in SUFFIXES:
        raise UsageError(f"{option} {path}: unknown kind of video; end its name with {' or '.join(SUFFIXES)}")


def check_encoder(path: Path, option: str) -> None:
    """Raises `UsageError`, which names `option`, where the package that writes such a video is not installed."""
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise UsageError(
            f"{option} {path}: needs the package imageio-ffmpeg; `pip install 'ccil_jax[video]'`, or end its name "
            "with .gif"
        )


def durations(film: "Film") -> np.ndarray:
    """[F] s: how long each frame is shown; the last one a second."""
    return np.append(np.diff(film.steps) * film.dt, _LAST_FRAME)


def write(
    path: Path,
    film: "Film",
    title: str,
    *,
    cost_limit: float | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> None:
    """Writes a film, whole or not at all.

    Args:
        path: a file whose name ends with one of SUFFIXES.
        film: what is shown.
        title: stands above the picture.
        cost_limit: is shown beside the cost; None where there is none.
        on_progress: is told how many of how many frames are drawn.
    """

    def frames() -> Iterator[Image.Image]:
        for i in range(len(film.steps)):
            yield draw(film, i, title, cost_limit)
            if on_progress is not None:
                on_progress(i + 1, len(film.steps))

    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        (_write_gif if path.suffix == ".gif" else _write_mp4)(temporary, frames(), film)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _write_gif(path: Path, frames: Iterator[Image.Image], film: "Film") -> None:
    # One palette for all frames: it is faster, and what does not move keeps its colours.
    some = np.unique(np.linspace(0, len(film.steps) - 1, 8).astype(int))
    if film.paid.any():
        some = np.append(some, np.argmax(film.paid))
    sample = np.concatenate([np.asarray(draw(film, i, "")) for i in some])
    palette = Image.fromarray(sample).quantize(64)
    indexed = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    # GIF counts hundredths of a second: the ends of the frames are rounded, so that errors do not add up.
    hundredths = np.diff(np.round(100 * np.cumsum(durations(film))), prepend=0.0)
    milliseconds = (10 * hundredths).astype(int).tolist()
    next(indexed).save(path, save_all=True, append_images=indexed, duration=milliseconds, loop=0)


def _write_mp4(path: Path, frames: Iterator[Image.Image], film: "Film") -> None:
    # The package would fork this process, and JAX's threads could hang the child; with this it starts ffmpeg directly.
    os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
    import imageio.v2 as imageio

    rate = 1 / durations(film)[0]
    opened: Any = imageio.get_writer(path, fps=rate, codec="libx264", quality=7, macro_block_size=2)
    with opened as writer:
        for last in frames:
            writer.append_data(np.asarray(last))
        for _ in range(round(_LAST_FRAME * rate) - 1):
            writer.append_data(np.asarray(last))


class _Canvas:
    """A picture under way; lengths are in metres."""

    def __init__(self, film: "Film", index: int) -> None:
        is_arena = film.view == "arena"
        width = _FINER * (_ARENA_WIDTH if is_arena else _WIDTH)
        self.top = _FINER * (_HEADER + is_arena * _LEGEND)
        self.width, self.height = width, round(width / film.aspect)
        self.scale = self.height / film.span  # pixels per metre
        self.centre = film.centre[index]
        self.picture = Image.new("RGB", (width, self.height + self.top), "white")
        self.pen = ImageDraw.Draw(self.picture, "RGBA")  # blends colours that are not opaque

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Where points [..., 2] are in the picture."""
        middle = np.array([self.width / 2, self.height / 2 + self.top])
        where: np.ndarray = middle + (points - self.centre) * self.scale * [1, -1]
        return where

    def line(self, ends: np.ndarray, width: float, color: str, *, is_round: bool = False) -> None:
        """A line between two points [2, 2]; one that is round and of no length is a disc."""
        pixels, half = self.pixels(ends), max(width * self.scale, _FINER) / 2
        along = pixels[1] - pixels[0]
        length = float(np.hypot(*along))
        if length > 0:
            across = half * np.array([-along[1], along[0]]) / length
            corners = [pixels[0] + across, pixels[1] + across, pixels[1] - across, pixels[0] - across]
            self.pen.polygon([tuple(corner) for corner in corners], fill=color)
        if is_round:
            for x, y in pixels if length > 0 else pixels[:1]:
                self.pen.ellipse((x - half, y - half, x + half, y + half), fill=color)

    def write(self, place: tuple[float, float], text: str, size: int, color: str) -> float:
        """Writes a line of text at a place of the reduced picture, in pixels; returns its length."""
        font = ImageFont.load_default(size=_FINER * size)
        self.pen.text((_FINER * place[0], _FINER * place[1]), text, fill=color, font=font)
        return float(self.pen.textlength(text, font=font)) / _FINER


def draw(film: "Film", index: int, title: str, cost_limit: float | None = None) -> Image.Image:
    """The frame `index` of a film as a picture, with the running return and cost above it."""
    from experiments.page.strokes import COLORS, PAID

    canvas = _Canvas(film, index)
    _draw_ground(canvas, film)
    if film.way is not None:
        for i in range(1, index + 1):
            canvas.line(film.way[i - 1 : i + 1], 0.02, PAID if film.paid[i] else _FLOOR)
    for shape, place in zip(film.strokes.shapes, film.strokes.places[index], strict=True):
        is_red = film.paid[index] and shape.kind in ("body", "robot")
        color = PAID if is_red else COLORS[shape.kind]
        canvas.line(place.reshape(2, 2), shape.width, color, is_round=shape.is_round)
    canvas.pen.rectangle((0, 0, canvas.width, canvas.top), fill="white")
    step, of = film.steps[index], film.steps[-1]
    limit = "" if cost_limit is None else f" (limit {_amount(cost_limit)})"
    canvas.write((12, 8), f"{title}   step {step} of {of}, {step * film.dt:.1f} s", 15, _SOFT)
    reached = f"return {number(film.returns[index])}   cost {_amount(film.costs[index])}{limit}"
    canvas.write((12, 32), reached, 18, PAID if film.paid[index] else _INK)
    if film.view == "arena":
        x = 12.0
        for kind in dict.fromkeys(shape.kind for shape in film.strokes.shapes):
            box = np.array([x, _HEADER + 6, x + 12, _HEADER + 18])
            canvas.pen.rectangle(tuple(_FINER * box), fill=COLORS[kind])
            x += 28 + canvas.write((x + 17, _HEADER + 3), kind.replace("_", " "), 14, _SOFT)
    return canvas.picture.reduce(_FINER)


def _amount(cost: float) -> str:
    """A cost, which is a number of steps in all tasks of this package, or any number in others."""
    return f"{cost:.0f}" if float(cost).is_integer() else number(cost)


def _draw_ground(canvas: _Canvas, film: "Film") -> None:
    """Lines one metre apart and, seen from the side, the floor."""
    half = np.array([canvas.width, canvas.height]) / 2 / canvas.scale
    low, high = canvas.centre - half, canvas.centre + half
    for x in range(int(np.ceil(low[0])), int(np.ceil(high[0]))):
        canvas.line(np.array([[x, low[1]], [x, high[1]]]), 0.0, _GRID)
    if film.view == "side":
        canvas.line(np.array([[low[0], 0.0], [high[0], 0.0]]), 0.0, _FLOOR)
    else:
        for y in range(int(np.ceil(low[1])), int(np.ceil(high[1]))):
            canvas.line(np.array([[low[0], y], [high[0], y]]), 0.0, _GRID)
