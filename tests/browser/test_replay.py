"""The player in a real browser: it plays, is scrubbed by keys, and shows what was asked for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from nnode.pages.page import write_player
from nnode.pages.replay import ReplayBlock, Scene, Zone
from tests.browser.chromium import MISSING, Browser
from tests.builders import lane, people

pytestmark = pytest.mark.skipif(bool(MISSING), reason=MISSING)

SPEED, LATE, ZONE = 20.0, 3.0, (40.0, 60.0)
ORANGE = (213, 94, 0)
WALLS = np.array([[-6.0, 0.0, 6.0, 0.0], [6.0, 4.0, -6.0, 4.0]])

# columns (px of the style sheet) of the pixels of a colour between two rows
PIXELS = """([r, g, b], top, bottom) => {
  const canvas = document.querySelector("canvas"), dense = canvas.width / canvas.clientWidth;
  const pen = canvas.getContext("2d"), columns = new Set();
  const high = Math.max(1, Math.round((bottom - top) * dense));
  const { data, width } = pen.getImageData(0, Math.round(top * dense), canvas.width, high);
  for (let i = 0; i < data.length; i += 4)
    if (data[i] === r && data[i + 1] === g && data[i + 2] === b)
      columns.add((i / 4) % width / dense);
  return [...columns].sort((a, b) => a - b);
}"""


def car(name: str, seconds: float) -> Scene:
    """One car, which a model has LATE metres behind."""
    s = lane(SPEED * 0.1 * np.arange(round(10 * seconds) + 1)[:, None], 0.1, start=50.0, name=name)
    return Scene(s, {"late": s.x - LATE})


def corridor() -> Scene:
    """Two people who pass each other."""
    right = np.stack([-3 + 0.13 * np.arange(31), np.full(31, 1.0)], -1)
    s = people(np.stack([right, right * [-1, 1] + [0, 2]], 1), 0.1, name="walk", walls=WALLS)
    return Scene(
        s,
        {"without effects": s.x + np.array([0.0, 0.3]), "with effects": s.x + np.array([0.0, 0.1])},
    )


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as found:
        yield found


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("players")
    zone = [Zone("slow zone", x=ZONE)]
    blocks = {
        "lane": ReplayBlock(
            "p", [car("first", 4.0), car("second", 2.0)], "Cars.", "A car drives.", zone
        ),
        "corridor": ReplayBlock("p", [corridor()], "People.", "Two people pass each other."),
    }
    return {
        name: write_player(block, folder / f"{name}.html", title=name).as_uri()
        for name, block in blocks.items()
    }


def state(browser: Browser) -> dict[str, str]:
    """What the canvas says it shows."""
    return dict(browser.evaluate("({...document.querySelector('canvas').dataset})"))


def columns(browser: Browser, colour: tuple[int, ...], top: float, bottom: float) -> np.ndarray:
    found = browser.evaluate(f"({PIXELS})({list(colour)}, {top}, {bottom})")
    return np.array(found)


def seen(browser: Browser) -> tuple[float, float]:
    """Fronts of the simulated and of the measured car, m, read from the pixels."""
    wide = browser.evaluate("document.querySelector('canvas').clientWidth")
    view = browser.evaluate("document.querySelector('figure').replay.scene.view.half")
    middle = browser.evaluate("document.querySelector('figure').replay.seen")

    def place(px: float) -> float:
        return middle - view + px / wide * 2 * view

    # the second strip begins at 78 px; the middle of its cars lies 21 px below
    model = columns(browser, ORANGE, 98, 100)
    real = columns(browser, (102, 102, 102), 38, 40)
    return place(model[-1] + 1), place(real[-1] + 1)


def test_the_pixels_are_where_the_cars_are(browser: Browser, pages: dict[str, str]) -> None:
    browser.open(pages["lane"], 800)
    for time in (0.0, 1.25, 4.0):
        browser.evaluate(f"document.querySelector('figure').replay.show({time})")
        assert float(state(browser)["time"]) == time
        simulated, measured = seen(browser)
        pixel = (
            2 * browser.evaluate("document.querySelector('figure').replay.scene.view.half") / 768
        )
        assert measured == pytest.approx(SPEED * time, abs=1.5 * pixel)
        assert simulated == pytest.approx(SPEED * time - LATE, abs=1.5 * pixel)
    assert "late: distance 3.00 m" in browser.evaluate(
        "(() => { const r = document.querySelector('figure').replay, said = [];"
        " const old = r.pen.fillText.bind(r.pen);"
        " r.pen.fillText = (text, ...at) => { said.push(text); old(text, ...at); };"
        " r.show(2); return said.join('; '); })()"
    )


def test_the_named_place_is_shaded_where_it_is(browser: Browser, pages: dict[str, str]) -> None:
    browser.open(pages["lane"], 800)
    shade = (243, 198, 107)
    browser.evaluate("document.querySelector('figure').replay.show(0)")
    assert not len(columns(browser, shade, 20, 25))
    browser.evaluate("document.querySelector('figure').replay.show(2.5)")  # the car is at 50 m
    found = columns(browser, shade, 70 + 9, 70 + 12)
    wide = browser.evaluate("document.querySelector('canvas').clientWidth")
    half = browser.evaluate("document.querySelector('figure').replay.scene.view.half")
    ends = 50 - half + np.array([found[0], found[-1] + 1]) / wide * 2 * half
    expected = np.clip(ZONE, 50 - half, 50 + half)
    assert ends == pytest.approx(expected, abs=3 * half / wide)


def test_it_plays_in_its_own_time_and_stops_at_the_end(
    browser: Browser, pages: dict[str, str]
) -> None:
    browser.open(pages["lane"], 800)
    assert state(browser) == {"time": "0.000", "scene": "first", "playing": "false"}
    browser.page.get_by_role("button", name="Play").click()
    begin = browser.evaluate("performance.now()")
    browser.page.wait_for_function("Number(document.querySelector('canvas').dataset.time) > 1")
    passed = (browser.evaluate("performance.now()") - begin) / 1000
    assert state(browser)["playing"] == "true"
    assert float(state(browser)["time"]) == pytest.approx(passed, abs=0.5)
    browser.page.get_by_role("button", name="Pause").click()
    held = state(browser)
    browser.page.wait_for_timeout(200)
    assert state(browser) == held | {"playing": "false"}
    browser.page.get_by_label("Speed").select_option("10")
    browser.page.get_by_role("button", name="Play").click()
    browser.page.wait_for_function("document.querySelector('button').textContent === 'Play'")
    assert float(state(browser)["time"]) == 4.0
    browser.press(" ")  # the button has the focus: once more from the start
    browser.page.wait_for_function("Number(document.querySelector('canvas').dataset.time) < 4")
    assert browser.complaints == []


def test_keys_scrub_change_the_speed_and_choose(browser: Browser, pages: dict[str, str]) -> None:
    browser.open(pages["lane"], 380)
    browser.evaluate("document.querySelector('.stage').focus()")
    for keys, time in (
        (["ArrowRight"] * 3, 0.3),
        (["ArrowLeft"], 0.2),
        (["End"], 4.0),
        (["ArrowRight"], 4.0),
        (["Home"], 0.0),
        (["ArrowLeft"], 0.0),
    ):
        for key in keys:
            browser.press(key)
        assert float(state(browser)["time"]) == pytest.approx(time)
    speed = "document.querySelector('.speed').value"
    for key, value in (("+", "2"), ("+", "5"), ("-", "2"), ("-", "1"), ("-", "0.5")):
        browser.press(key)
        assert browser.evaluate(speed) == value
    browser.press("End")
    browser.press("PageDown")
    assert state(browser) == {"time": "0.000", "scene": "second", "playing": "false"}
    browser.press("PageDown")
    assert state(browser)["scene"] == "second"
    browser.press("End")
    assert float(state(browser)["time"]) == 2.0
    browser.press("PageUp")
    assert state(browser)["scene"] == "first"
    browser.press(" ")
    assert state(browser)["playing"] == "true"
    browser.press(" ")
    assert browser.evaluate("document.querySelector('button').textContent") == "Play"


def test_the_slider_and_the_list_choose(browser: Browser, pages: dict[str, str]) -> None:
    browser.open(pages["lane"], 800)
    browser.page.get_by_label("Sequence").select_option(label="second")
    assert state(browser)["scene"] == "second"
    browser.page.get_by_label("Time").fill("1.5")
    assert float(state(browser)["time"]) == 1.5
    assert browser.evaluate("document.querySelector('output').textContent") == "1.5 of 2.0 s"


def test_who_asked_for_less_motion_sees_still_moments(
    browser: Browser, pages: dict[str, str]
) -> None:
    browser.open(pages["lane"], 800, motion=False)
    browser.evaluate(
        "window.times = new Set(); const r = document.querySelector('figure').replay,"
        " old = r.show.bind(r); r.show = (t) => { old(t); times.add(r.time); }; r.play(true)"
    )
    browser.page.wait_for_function("Number(document.querySelector('canvas').dataset.time) > 1.5")
    times = sorted(browser.evaluate("[...times]"))
    assert np.diff(times).min() > 0.45
    browser.evaluate("document.querySelector('figure').replay.play(false)")
    browser.evaluate("document.querySelector('.stage').focus()")
    browser.press("Home")
    browser.press("ArrowRight")
    assert float(state(browser)["time"]) == 0.5


@pytest.mark.parametrize("width", [380, 800, 1400])
@pytest.mark.parametrize("name", ["lane", "corridor"])
def test_it_fits_every_width(
    browser: Browser, pages: dict[str, str], name: str, width: int
) -> None:
    browser.open(pages[name], width)
    assert browser.complaints == []
    assert browser.requests == [pages[name]]
    box: Any = browser.page.locator("canvas").bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= width
    assert 120 < box["height"] < 900
    inks = browser.evaluate(
        "(() => { const c = document.querySelector('canvas'), seen = new Set(),"
        " d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        " for (let i = 0; i < d.length; i += 4) seen.add(`${d[i]},${d[i + 1]},${d[i + 2]}`);"
        " return [...seen]; })()"
    )
    assert {"102,102,102", "213,94,0"} <= set(inks)
    assert ("0,114,178" in inks) == (name == "corridor")
