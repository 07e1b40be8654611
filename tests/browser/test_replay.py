"""The player in a browser: playing, controls, and positions on the screen."""

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
REPLAY = "document.querySelector('figure').replay"
WALLS = np.array([[-6.0, 0.0, 6.0, 0.0], [6.0, 4.0, -6.0, 4.0]])

#: Columns (CSS px) of pixels of a colour between two rows.
PIXELS = """([r, g, b], top, bottom) => {
  const canvas = document.querySelector("canvas"), scale = canvas.width / canvas.clientWidth;
  const context = canvas.getContext("2d"), columns = new Set();
  const height = Math.max(1, Math.round((bottom - top) * scale));
  const { data, width } = context.getImageData(0, Math.round(top * scale), canvas.width, height);
  for (let i = 0; i < data.length; i += 4)
    if (data[i] === r && data[i + 1] === g && data[i + 2] === b)
      columns.add((i / 4) % width / scale);
  return [...columns].sort((a, b) => a - b);
}"""


def car(name: str, seconds: float) -> Scene:
    """One car; its simulation is `LATE` metres behind."""
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
    with Browser() as browser:
        yield browser


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
    """The state in the canvas' data attributes."""
    return dict(browser.evaluate("({...document.querySelector('canvas').dataset})"))


def columns(browser: Browser, colour: tuple[int, ...], top: float, bottom: float) -> np.ndarray:
    return np.array(browser.evaluate(f"({PIXELS})({list(colour)}, {top}, {bottom})"))


def replay(browser: Browser, expression: str) -> Any:
    """A member of the player, or the result of a method."""
    return browser.evaluate(f"{REPLAY}.{expression}")


def metres(browser: Browser, px: np.ndarray) -> np.ndarray:
    """Positions (m) of columns."""
    width = browser.evaluate("document.querySelector('canvas').clientWidth")
    half = replay(browser, "scene.view.half")
    return replay(browser, "seen") - half + px / width * 2 * half


def fronts(browser: Browser) -> np.ndarray:
    """Fronts of the simulated and of the measured car (m), read from the pixels."""
    # the second strip begins at 78 px; the centre of its cars lies 21 px below
    simulated = columns(browser, ORANGE, 98, 100)
    measured = columns(browser, (102, 102, 102), 38, 40)
    return metres(browser, np.array([simulated[-1] + 1, measured[-1] + 1]))


def test_cars_are_drawn_at_their_positions(browser: Browser, pages: dict[str, str]) -> None:
    browser.open(pages["lane"], 800)
    for time in (0.0, 1.25, 4.0):
        replay(browser, f"show({time})")
        assert float(state(browser)["time"]) == time
        simulated, measured = fronts(browser)
        pixel = 2 * replay(browser, "scene.view.half") / 768
        assert measured == pytest.approx(SPEED * time, abs=1.5 * pixel)
        assert simulated == pytest.approx(SPEED * time - LATE, abs=1.5 * pixel)
    assert "late: distance 3.00 m" in browser.evaluate(
        f"(() => {{ const r = {REPLAY}, texts = [], original = r.pen.fillText.bind(r.pen);"
        " r.pen.fillText = (text, ...at) => { texts.push(text); original(text, ...at); };"
        " r.show(2); return texts.join('; '); })()"
    )


def test_zone_is_shaded_at_its_position(browser: Browser, pages: dict[str, str]) -> None:
    browser.open(pages["lane"], 800)
    shade = (243, 198, 107)
    replay(browser, "show(0)")
    assert not len(columns(browser, shade, 20, 25))
    replay(browser, "show(2.5)")  # the car is at 50 m
    shaded = columns(browser, shade, 70 + 9, 70 + 12)
    width = browser.evaluate("document.querySelector('canvas').clientWidth")
    half = replay(browser, "scene.view.half")
    ends = 50 - half + np.array([shaded[0], shaded[-1] + 1]) / width * 2 * half
    expected = np.clip(ZONE, 50 - half, 50 + half)
    assert ends == pytest.approx(expected, abs=3 * half / width)


def test_player_runs_in_real_time_and_stops_at_the_end(
    browser: Browser, pages: dict[str, str]
) -> None:
    browser.open(pages["lane"], 800)
    assert state(browser) == {"time": "0.000", "scene": "first", "playing": "false"}
    browser.page.get_by_role("button", name="Play").click()
    begin = browser.evaluate("performance.now()")
    browser.page.wait_for_function("Number(document.querySelector('canvas').dataset.time) > 1")
    elapsed = (browser.evaluate("performance.now()") - begin) / 1000
    assert state(browser)["playing"] == "true"
    assert float(state(browser)["time"]) == pytest.approx(elapsed, abs=0.5)
    browser.page.get_by_role("button", name="Pause").click()
    paused = state(browser)
    browser.page.wait_for_timeout(200)
    assert state(browser) == paused | {"playing": "false"}
    browser.page.get_by_label("Speed").select_option("10")
    browser.page.get_by_role("button", name="Play").click()
    browser.page.wait_for_function("document.querySelector('button').textContent === 'Play'")
    assert float(state(browser)["time"]) == 4.0
    browser.press(" ")  # the focused button restarts the player
    browser.page.wait_for_function("Number(document.querySelector('canvas').dataset.time) < 4")
    assert browser.complaints == []


def test_keys_control_time_speed_and_sequence(browser: Browser, pages: dict[str, str]) -> None:
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


def test_slider_and_list(browser: Browser, pages: dict[str, str]) -> None:
    browser.open(pages["lane"], 800)
    browser.page.get_by_label("Sequence").select_option(label="second")
    assert state(browser)["scene"] == "second"
    browser.page.get_by_label("Time").fill("1.5")
    assert float(state(browser)["time"]) == 1.5
    assert browser.evaluate("document.querySelector('output').textContent") == "1.5 of 2.0 s"


def test_reduced_motion_shows_still_images(browser: Browser, pages: dict[str, str]) -> None:
    browser.open(pages["lane"], 800, motion=False)
    browser.evaluate(
        f"window.times = new Set(); const r = {REPLAY}, original = r.show.bind(r);"
        " r.show = (t) => { original(t); times.add(r.time); }; r.play(true)"
    )
    browser.page.wait_for_function("Number(document.querySelector('canvas').dataset.time) > 1.5")
    times = sorted(browser.evaluate("[...times]"))
    assert np.diff(times).min() > 0.45
    replay(browser, "play(false)")
    browser.evaluate("document.querySelector('.stage').focus()")
    browser.press("Home")
    browser.press("ArrowRight")
    assert float(state(browser)["time"]) == 0.5


@pytest.mark.parametrize("width", [380, 800, 1400])
@pytest.mark.parametrize("name", ["lane", "corridor"])
def test_player_fits_every_width(
    browser: Browser, pages: dict[str, str], name: str, width: int
) -> None:
    browser.open(pages[name], width)
    assert browser.complaints == []
    assert browser.requests == [pages[name]]
    box: Any = browser.page.locator("canvas").bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= width
    assert 120 < box["height"] < 900
    colours = browser.evaluate(
        "(() => { const c = document.querySelector('canvas'), colours = new Set(),"
        " d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        " for (let i = 0; i < d.length; i += 4) colours.add(`${d[i]},${d[i + 1]},${d[i + 2]}`);"
        " return [...colours]; })()"
    )
    assert {"102,102,102", "213,94,0"} <= set(colours)
    assert ("0,114,178" in colours) == (name == "corridor")
