"""What a player holds: positions to the centimetre, few bytes, and how much was left out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nnode.data.sequence import Sequence
from nnode.errors import ConfigError
from nnode.pages import replay
from nnode.pages.page import Heading, write_page, write_player
from nnode.pages.replay import ReplayBlock, Scene, Zone, packed
from tests.builders import lane


def platoon(name: str = "lane/1", samples: int = 31, dt: float = 0.2, **more: object) -> Sequence:
    x = 1e5 + 15 * dt * np.arange(samples)[:, None] + np.array([0.0, 20.0, 45.0])
    return lane(x, dt, start=100.0, name=name, **more)


def scene(s: Sequence, late: float = 1.0) -> Scene:
    return Scene(s, {"late": s.x - late})


def unpacked(rows: list[list[int | None]]) -> np.ndarray:
    """Positions in m, ``(K, rows)``, read as the page reads them."""
    found = []
    for row in rows:
        place, track = 0, []
        for step in row:
            place += step or 0
            track.append(np.nan if step is None else place / 100)
        found.append(track)
    return np.array(found).T


def block(scenes: list[Scene], **more: object) -> ReplayBlock:
    return ReplayBlock("player", scenes, "Caption.", "Cars drive.", **more)  # type: ignore[arg-type]


def test_positions_come_back_to_the_centimetre_and_absent_ones_stay_absent() -> None:
    x = np.cumsum(np.random.default_rng(1).normal(0, 3, (50, 4, 2)), axis=0) - 1e6
    x[:7, 1] = x[20:24, 1] = np.nan
    x[30:, 2] = 1e30  # a simulation that went astray
    x[3, 3, 0] = np.inf
    expected = np.where(np.abs(x) < 1e7, x, np.nan).reshape(50, -1)
    np.testing.assert_allclose(unpacked(packed(x)), expected, rtol=0, atol=0.00501)
    assert json.loads(json.dumps(packed(x), allow_nan=False)) == packed(x)


def test_dense_samples_are_thinned_out_and_keep_their_times() -> None:
    s = platoon(samples=101, dt=0.04)
    (one,) = json.loads(block([scene(s)]).data()[0])["scenes"]
    assert (one["start"], one["dt"], one["dims"]) == (100.0, 0.08, 1)
    np.testing.assert_allclose(unpacked(one["measured"]), s.x[::2, :, 0], atol=0.00501)
    np.testing.assert_allclose(unpacked(one["simulated"][0]["x"]), s.x[::2, :, 0] - 1, atol=0.00501)
    (one,) = json.loads(block([scene(platoon())]).data()[0])["scenes"]
    assert one["dt"] == 0.2


def people(name: str, number: int, samples: int) -> Sequence:
    time = 0.2 * np.arange(samples)
    x = np.stack(np.broadcast_arrays(time[:, None], np.arange(number)), -1)
    return Sequence(name=name, recording="hall", time=time, x=x)


def test_the_player_opens_on_the_median_error(monkeypatch: pytest.MonkeyPatch) -> None:
    many = []
    for i, error in enumerate((3.0, 9.0, np.nan, 1.0, 2.0)):
        s = people(f"hall/{i}", 2, 20)
        many.append(Scene(s, {"a": s.x + error, "b": s.x}))

    def read(scenes: list[Scene]) -> tuple[int, list[str]]:
        content = json.loads(block(scenes).data()[0])
        return content["first"], [one["name"] for one in content["scenes"]]

    assert read(many) == (0, [f"hall/{i}" for i in range(5)])
    monkeypatch.setattr(replay, "MOST", 3)  # at equal steps, and only of those on the page
    assert read(many) == (0, ["hall/0", "hall/2", "hall/4"])
    assert read(many[1:2])[0] == 0


def test_what_is_left_out_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    many = [scene(platoon(f"lane/{i}")) for i in range(9)]
    text, said = block(many).data()
    assert len(json.loads(text)["scenes"]) == 9
    assert said == "Cars of unknown length are drawn 4.5 m long."
    one = len(block(many[:1]).data()[0])
    monkeypatch.setattr(replay, "BYTES", 3 * one)
    text, said = block(many).data()
    kept = len(json.loads(text)["scenes"])
    assert kept < 9
    assert len(text) < 3 * one + 1000
    assert said.startswith(f"The player contains {kept} of 9 sequences.")
    assert block(many[:1], total=40).data()[1].startswith("The player contains 1 of 40 sequences.")
    monkeypatch.setattr(replay, "BYTES", 1)
    assert len(json.loads(block(many).data()[0])["scenes"]) == 1
    monkeypatch.setattr(replay, "MOST", 0)
    assert json.loads(block(many).data()[0])["scenes"] == []


def test_lengths_walls_and_zones_are_there(tmp_path: Path) -> None:
    long = platoon(length=np.array([4.0, np.nan, 12.5]))
    zones = [Zone("zone", x=(1.0, 2.0)), Zone("post", circle=(0.0, 1.0, 0.5)), Zone("t", t=(3, 4))]
    found = json.loads(block([scene(long)], zones=zones).data()[0])
    assert found["scenes"][0]["length"] == [4.0, replay.CAR, 12.5]
    assert found["zones"][0] == {"label": "zone", "x": [1.0, 2.0]}
    assert found["zones"][1] == {"label": "post", "circle": [0.0, 1.0, 0.5]}
    walls = np.array([[-6.0, 0.0, 6.0, 0.0]])
    time = 0.1 * np.arange(5)
    people = Sequence(name="a", recording="a", time=time, x=np.ones((5, 2, 2)), walls=walls)
    text, said = block([scene(people)]).data()
    assert json.loads(text)["scenes"][0]["walls"] == walls.tolist()
    assert said == "People are drawn with a radius of 0.2 m."


def test_a_name_cannot_end_the_data(tmp_path: Path) -> None:
    bad = "</script><b>&amp;"
    path = write_player(block([scene(platoon(bad))]), tmp_path / "new" / "p.html", title="T")
    page = path.read_text(encoding="utf-8")
    data = page[page.index('"application/json">') + 19 :]
    held = json.loads(data[: data.index("</script>")])
    assert held["scenes"][0]["name"] == bad
    assert "<b>" not in page


def test_a_player_alone_and_on_a_page(tmp_path: Path) -> None:
    one = block([scene(platoon())])
    write_page([Heading("H"), one], tmp_path, title="T")
    assert {p.name for p in tmp_path.iterdir()} == {"study.html", "study.md"}
    assert "Player (in study.html): Caption." in (tmp_path / "study.md").read_text()
    page = (tmp_path / "study.html").read_text(encoding="utf-8")
    assert page.count("class Replay") == 1
    write_page([Heading("H")], tmp_path, title="T")
    assert "<script" not in (tmp_path / "study.html").read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match=r"expected a path ending in \.html"):
        write_player(one, tmp_path / "p.txt", title="T")
    with pytest.raises(ConfigError, match="cannot be written to"):
        write_player(one, tmp_path / "study.md" / "p.html", title="T")
    with pytest.raises(ValueError, match="several of the page's figures are named"):
        write_page([one, one], tmp_path, title="T")
