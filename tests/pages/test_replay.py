"""Data of the player: positions to the centimetre, limited size, and notes on omissions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nnode.data.sequence import Sequence
from nnode.errors import ConfigError
from nnode.pages import replay
from nnode.pages.page import Heading, write_page, write_player
from nnode.pages.replay import ReplayBlock, Scene, Zone, packed
from tests.builders import lane, people, straight


def platoon(name: str = "lane/1", samples: int = 31, dt: float = 0.2, **more: object) -> Sequence:
    x = 1e5 + 15 * dt * np.arange(samples)[:, None] + np.array([0.0, 20.0, 45.0])
    return lane(x, dt, start=100.0, name=name, **more)


def scene(s: Sequence) -> Scene:
    return Scene(s, {"late": s.x - 1.0})


def unpacked(rows: list[list[int | None]]) -> np.ndarray:
    """Positions ``(K, rows)`` (m) from the increments of a page."""
    steps = np.array(rows, dtype=float).T
    return np.where(np.isnan(steps), np.nan, np.nancumsum(steps, axis=0) / 100)


def block(scenes: list[Scene], **more: object) -> ReplayBlock:
    return ReplayBlock("player", scenes, "Caption.", "Cars drive.", **more)  # type: ignore[arg-type]


def content(scenes: list[Scene], **more: object) -> dict[str, Any]:
    """The JSON data of a player."""
    return dict(json.loads(block(scenes, **more).data()[0]))


def test_packed_positions_are_exact_to_the_centimetre() -> None:
    x = np.cumsum(np.random.default_rng(1).normal(0, 3, (50, 4, 2)), axis=0) - 1e6
    x[:7, 1] = x[20:24, 1] = np.nan
    x[30:, 2] = 1e30  # a diverged simulation
    x[3, 3, 0] = np.inf
    expected = np.where(np.abs(x) < 1e7, x, np.nan).reshape(50, -1)
    np.testing.assert_allclose(unpacked(packed(x)), expected, rtol=0, atol=0.00501)
    assert json.loads(json.dumps(packed(x), allow_nan=False)) == packed(x)


def test_dense_samples_are_thinned_out() -> None:
    s = platoon(samples=101, dt=0.04)
    (thinned,) = content([scene(s)])["scenes"]
    assert (thinned["start"], thinned["dt"], thinned["dims"]) == (100.0, 0.08, 1)
    simulated = thinned["simulated"][0]["x"]
    np.testing.assert_allclose(unpacked(thinned["measured"]), s.x[::2, :, 0], atol=0.00501)
    np.testing.assert_allclose(unpacked(simulated), s.x[::2, :, 0] - 1, atol=0.00501)
    (unchanged,) = content([scene(platoon())])["scenes"]
    assert unchanged["dt"] == 0.2


def test_player_opens_on_the_median_error(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = []
    for i, error in enumerate((3.0, 9.0, np.nan, 1.0, 2.0)):
        s = straight([[0.0, 0.0], [0.0, 1.0]], [1.0, 0.0], 20, 0.2, name=f"hall/{i}")
        scenes.append(Scene(s, {"a": s.x + error, "b": s.x}))

    def first_and_names(scenes: list[Scene]) -> tuple[int, list[str]]:
        data = content(scenes)
        return data["first"], [scene["name"] for scene in data["scenes"]]

    assert first_and_names(scenes) == (0, [f"hall/{i}" for i in range(5)])
    monkeypatch.setattr(replay, "MOST", 3)  # the median is that of the selected scenes
    assert first_and_names(scenes) == (0, ["hall/0", "hall/2", "hall/4"])
    assert first_and_names(scenes[1:2])[0] == 0


def test_omissions_are_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [scene(platoon(f"lane/{i}")) for i in range(9)]
    text, note = block(scenes).data()
    assert len(json.loads(text)["scenes"]) == 9
    assert note == "Cars of unknown length are drawn 4.5 m long."
    size = len(block(scenes[:1]).data()[0])
    monkeypatch.setattr(replay, "BYTES", 3 * size)
    text, note = block(scenes).data()
    number = len(json.loads(text)["scenes"])
    assert number < 9
    assert len(text) < 3 * size + 1000
    assert note.startswith(f"The player contains {number} of 9 sequences.")
    note = block(scenes[:1], total=40).data()[1]
    assert note.startswith("The player contains 1 of 40 sequences.")
    monkeypatch.setattr(replay, "BYTES", 1)
    assert len(content(scenes)["scenes"]) == 1
    monkeypatch.setattr(replay, "MOST", 0)
    assert content(scenes)["scenes"] == []


def test_lengths_walls_and_zones() -> None:
    long = platoon(length=np.array([4.0, np.nan, 12.5]))
    zones = [Zone("zone", x=(1.0, 2.0)), Zone("post", circle=(0.0, 1.0, 0.5)), Zone("t", t=(3, 4))]
    data = content([scene(long)], zones=zones)
    assert data["scenes"][0]["length"] == [4.0, replay.CAR, 12.5]
    assert data["zones"][0] == {"label": "zone", "x": [1.0, 2.0]}
    assert data["zones"][1] == {"label": "post", "circle": [0.0, 1.0, 0.5]}
    walls = np.array([[-6.0, 0.0, 6.0, 0.0]])
    text, note = block([scene(people(np.ones((5, 2, 2)), 0.1, walls=walls))]).data()
    assert json.loads(text)["scenes"][0]["walls"] == walls.tolist()
    assert note == "People are drawn with a radius of 0.2 m."


def test_names_are_escaped_in_the_data(tmp_path: Path) -> None:
    name = "</script><b>&amp;"
    path = write_player(block([scene(platoon(name))]), tmp_path / "new" / "p.html", title="T")
    page = path.read_text(encoding="utf-8")
    data = page[page.index('"application/json">') + 19 :]
    data = json.loads(data[: data.index("</script>")])
    assert data["scenes"][0]["name"] == name
    assert "<b>" not in page


def test_player_as_a_file_and_on_a_page(tmp_path: Path) -> None:
    player = block([scene(platoon())])
    write_page([Heading("H"), player], tmp_path, title="T")
    assert {p.name for p in tmp_path.iterdir()} == {"study.html", "study.md"}
    assert "Player (in study.html): Caption." in (tmp_path / "study.md").read_text()
    page = (tmp_path / "study.html").read_text(encoding="utf-8")
    assert page.count("class Replay") == 1
    write_page([Heading("H")], tmp_path, title="T")
    assert "<script" not in (tmp_path / "study.html").read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match=r"expected a path ending in \.html"):
        write_player(player, tmp_path / "p.txt", title="T")
    with pytest.raises(ConfigError, match="cannot be written to"):
        write_player(player, tmp_path / "study.md" / "p.html", title="T")
    with pytest.raises(ValueError, match="several of the page's figures are named"):
        write_page([player, player], tmp_path, title="T")
