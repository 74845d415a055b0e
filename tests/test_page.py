"""The page in a browser: readable on a wide and on a narrow screen, and its players play. Needs Chromium."""

import base64
import io
import shutil
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

from experiments.page import document, player
from experiments.page.entries import read_entries
from tests.films import make_film
from tests.test_report import make_run

pytestmark = pytest.mark.once

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=CHROMIUM)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A page of two runs with long names, whose players have two films and one."""
    folder = tmp_path_factory.mktemp("page")
    names = ("a_rather_long_name_of_a_run_without_any_space_in_it" * 2, "b")
    entries = read_entries([make_run(folder / name, "malm") for name in names])
    arena = make_film(view="arena", way=make_film().strokes.places[:, 1, :2], dt=60.0)
    figures = iter(
        [
            player.figure([("learner", make_film()), ("<expert>", make_film(4))], "A <caption>."),
            player.figure([("learner", arena)], "An arena."),
        ]
    )
    (folder / "page.html").write_text(document.page(entries, play_run=lambda _: next(figures)), encoding="utf-8")
    return (folder / "page.html").as_uri()


@pytest.fixture(params=[1280, 390])
def page(browser: Any, address: str, request: pytest.FixtureRequest) -> Iterator[Any]:
    """The page on a screen of that width. Nothing is said on the console, and nothing else is loaded."""
    opened = browser.new_page(viewport={"width": request.param, "height": 800})
    said: list[str] = []
    opened.on("console", lambda message: said.append(message.text))
    opened.on("pageerror", lambda error: said.append(str(error)))
    opened.on("request", lambda asked: None if asked.url.startswith(("file:", "data:")) else said.append(asked.url))
    opened.goto(address)
    yield opened
    opened.close()
    assert said == []


def picture(page: Any, index: int) -> np.ndarray:
    """The pixels of a canvas, [height, width, 3]."""
    url = page.evaluate("i => document.querySelectorAll('canvas')[i].toDataURL()", index)
    png = base64.b64decode(url.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGBA"))[..., :3]


def differ(first: np.ndarray, second: np.ndarray) -> bool:
    return first.shape != second.shape or bool((first != second).any())


def seek(page: Any, figure: int, frame: int) -> None:
    slider = "document.querySelectorAll('.player')[i].querySelector('input')"
    page.evaluate(f"([i, f]) => {{ {slider}.value = f; {slider}.dispatchEvent(new Event('input')) }}", [figure, frame])


def counters(page: Any) -> list[str]:
    return [text.strip() for text in page.locator(".player").first.locator(".counters").all_inner_texts()]


def test_nothing_is_beyond_the_edge_of_the_screen(page: Any) -> None:
    """With everything unfolded; tables may scroll in their own boxes."""
    details = page.locator("details")
    assert details.count() >= 2
    assert not any(details.nth(i).evaluate("d => d.open") for i in range(details.count()))
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    beyond = "e => e.getBoundingClientRect().right > innerWidth + 1 && !e.closest('div.wide')"
    assert page.evaluate(f"[...document.querySelectorAll('body *')].filter({beyond}).length") == 0
    lefts = page.evaluate("[...document.querySelector('div.panels').children].map(e => e.getBoundingClientRect().left)")
    assert len(lefts) == 4
    assert len(set(lefts)) == (1 if page.viewport_size["width"] == 390 else 2)  # stacked on the narrow screen
    seen = page.evaluate(
        "[...document.querySelectorAll('th')].slice(1, 3)"
        ".map(e => [e.innerText, e.getBoundingClientRect().right < innerWidth])"
    )
    assert seen == [["return", True], ["cost", True]]


def test_the_slider_shows_the_films_own_numbers(page: Any) -> None:
    start = picture(page, 0)
    assert counters(page) == ["return 0.0 cost 0", "return 0.0 cost 0"]
    seek(page, 0, 2)
    assert counters(page) == ["return 3.0 cost 1", "return 3.0 cost 1"]
    assert page.locator(".pane.paid").count() == 2
    seek(page, 0, 5)
    assert counters(page) == ["return 7.5 cost 1", "return 4.5 cost 1 ended after 6 steps"]
    assert page.locator(".clock").first.inner_text() == "step 10 of 10, 0.2 s"
    shown = picture(page, 0)
    assert differ(shown, start)
    height, width, _ = shown.shape
    metre = height / 4
    column = shown[:, int(width / 2 + 0.1 * metre)]
    bar = np.flatnonzero((column == [11, 110, 153]).all(axis=-1))
    assert bar.mean() == pytest.approx(height / 2 - 0.5 * metre, abs=1.5)  # half a metre up, after five frames
    assert len(bar) == pytest.approx(0.1 * metre, abs=2)


def click(page: Any, figure: int) -> str:
    """Clicks a player's button; what the button says then."""
    script = "i => { const b = document.querySelectorAll('.player button')[i]; b.click(); return b.textContent; }"
    said: str = page.evaluate(script, figure)
    return said


def test_play_moves_the_picture_to_its_end_and_pause_stops_it(page: Any) -> None:
    before = picture(page, 0)
    assert click(page, 0) == "Pause"
    page.wait_for_function("document.querySelector('.clock').textContent.startsWith('step 10')")
    assert differ(picture(page, 0), before)
    assert page.locator(".player button").first.inner_text() == "Play"
    seek(page, 1, 5)
    end = picture(page, 2)
    assert click(page, 1) == "Pause"  # from the end it begins again; this film lasts ten minutes
    assert page.locator(".clock").nth(1).inner_text() == "step 0 of 10, 0.0 s"
    assert differ(picture(page, 2), end)
    assert click(page, 1) == "Play"
