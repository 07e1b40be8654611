"""Which answers are right in worlds of other laws, and how often they were given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.open_world import by_jupedsim, by_sumo, laws
from benchmarks.open_world.answers import Answer
from benchmarks.open_world.page import by_law, criteria, scene_criteria, share, write
from benchmarks.synthetic_cases.laws.motion import RANGES
from nnode.app.nearest_law import LAWS
from nnode.model.effects import CATALOGUE


def row(law: str, first: str, asked: str = "lin", **more: Any) -> dict[str, Any]:
    own = {"asked_names": [], "asked_false": [], "nearest_names": [], "nearest_false": []}
    return {"law": law, "first": first, "asked": asked, "p": 1.0, "parameters": {}, **own, **more}


def test_names_that_are_right() -> None:
    assert laws.allowed("idm", "idm") == set()
    assert {"relative_speed", "inertia", "time_gap"} < laws.allowed("idm", "lin")
    assert "time_gap" not in laws.allowed("krauss", "idm")
    assert "leader_length" in laws.allowed("log", "idm")
    every = {one for t in RANGES for d in RANGES for one in laws.allowed(t, d)}
    assert every <= set(CATALOGUE.effects)
    assert set(RANGES) == set(LAWS["traffic"])


def test_scenes_expect_names_of_the_catalogue() -> None:
    for domain, scenes in (("traffic", by_sumo.SCENES), ("crowd", by_jupedsim.SCENES)):
        for scene in scenes.values():
            answer = scene.answer
            assert {*answer.right, *answer.allowed} <= set(CATALOGUE.effects)
            assert set(answer.first) <= set(LAWS[domain])
    assert len(by_sumo.cases(5, 2)) == 2 * len(by_sumo.SCENES)
    assert len(by_jupedsim.cases(5, 2)) == 2 * len(by_jupedsim.SCENES)


def test_what_was_reached() -> None:
    rows = [
        row("idm", "idm"),
        row("idm", "idm", nearest_names=["inertia"], nearest_false=["inertia"]),
        row("helly", "fvdm", p=0.4),
        row(
            "lin",
            "lin",
            asked="lin",
            asked_names=["memory"],
            asked_false=["memory"],
            nearest_names=["memory"],
            nearest_false=["memory"],
        ),
    ]
    found = dict(zip(criteria(rows)["what"], criteria(rows)["reached"], strict=True))
    assert found["the true law comes first"].startswith("3 of 4 (75 %")
    assert found["another one comes first, not told from it (p > 0.05)"].startswith("1 of 4")
    # where the law that was asked for comes first, there is one diagnosis, not two
    assert found["a diagnosis names something false"].startswith("2 of 7")
    assert found["the diagnosis of the true law names nothing"].startswith("1 of 3")
    table = by_law(rows).set_index("true law")
    assert table.loc["helly", "else first"] == "fvdm"
    assert table.loc["idm", "of these false"] == "inertia"


def said(answer: Answer, *effects: tuple[str, ...], verdict: str = "named") -> dict[str, Any]:
    """What is judged where effects, each with its equals, are named."""
    found = [{"name": n, "alternatives": [{"name": o} for o in more]} for n, *more in effects]
    laws = {"ranking": [{"name": "idm"}]}
    report = {"laws": laws, "laws_again": None, "verdict": verdict, "effects": found, "leads": []}
    return answer.judge(report, None)


def test_what_is_right_to_say() -> None:
    pillar = Answer(right=("obstacle",), allowed=("anticipation",))
    assert said(pillar, ("obstacle",))["right"]
    assert said(pillar, ("anticipation",), ("attraction", "obstacle"))["right"]
    assert not said(pillar, ("anticipation",))["right"]
    assert not said(pillar, verdict="unknown")["right"]
    assert said(pillar, ("obstacle",), ("drift",))["false"] == ["drift"]
    assert not said(pillar, ("obstacle",), ("drift",))["right"]
    late = Answer(right=("reaction_delay", "inertia"), unknown=True)
    assert said(late, ("multi_anticipation", "inertia"))["names"] == ["inertia"]
    assert said(late, ("inertia",))["right"]
    assert said(late, verdict="unknown")["right"]
    assert not said(late, verdict="none")["right"]
    own = Answer(first=("idm",), right=("driver_heterogeneity",))
    assert said(own, ("memory", "lasting_time_gap"))["right"]
    assert said(own, ("memory", "inertia"))["false"] == ["memory"]
    assert said(own)["law_right"]
    assert not said(Answer(first=("krauss",)))["law_right"]
    assert said(Answer(), verdict="none")["right"]


def test_the_nearest_law_is_judged_and_the_last_ranking() -> None:
    report: dict[str, Any] = {
        "laws": {"ranking": [{"name": "gipps"}]},
        "laws_again": {"ranking": [{"name": "krauss"}]},
        "verdict": "unknown",
        "effects": [],
        "leads": [],
    }
    zone = {"name": "speed_zone", "alternatives": []}
    found = Answer(first=("krauss",), right=("speed_zone",)).judge(
        report, {"verdict": "named", "effects": [zone], "leads": [{"name": "inertia"}]}
    )
    assert found["first"] == "krauss"
    assert found["law_right"]
    assert found["right"]
    assert (found["verdict"], found["asked_verdict"]) == ("named", "unknown")
    assert (found["names"], found["asked_names"], found["leads"]) == (
        ["speed_zone"],
        [],
        ["inertia"],
    )


def test_the_page(tmp_path: Path) -> None:
    scene = {
        "program": "SUMO",
        "scene": "idm",
        "right": True,
        "false": [],
        "law_known": True,
        "law_right": False,
    }
    paths = write([row("idm", "idm"), scene], None, tmp_path)
    text = next(p for p in paths if p.suffix == ".md").read_text()
    assert "1 of 1 (100 %" in text
    assert "none: development" in text
    assert scene_criteria([scene])["reached"][2].startswith("0 of 1")


def test_shares_have_exact_intervals() -> None:
    # Clopper and Pearson 1934: 0 of 10 leaves up to 1 - 0.025^(1/10)
    assert share(0, 10) == f"0 of 10 (0 %, 0–{100 * (1 - 0.025**0.1):.0f} %)"
    assert share(0, 0) == "–"


@pytest.mark.parametrize("name", ["krauss_light", "krauss_lane_drop", "krauss_factors"])
def test_sumo_drives_a_scene(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sumo")
    monkeypatch.setattr(by_sumo, "ROADS", 6)
    table = by_sumo.recorded(name, 5)
    assert table["agent"].nunique() == 6 * by_sumo.CARS
    found = table.pivot_table(index="time", columns=["sequence", "agent"], values="x")
    speed = np.diff(found.to_numpy(), axis=0) / (by_sumo.STEP * by_sumo.EVERY)
    assert np.isfinite(speed).all()
    assert speed.max() < 40  # no jumps at nodes of the roads
    same = by_sumo.recorded(name, 5)
    np.testing.assert_array_equal(same["x"], table["x"])


def test_who_comes_behind_waits_at_a_light(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sumo")
    monkeypatch.setattr(by_sumo, "ROADS", 12)
    table = by_sumo.recorded("idm_light", 555000)
    found = table.pivot_table(index="time", columns="agent", values="x").to_numpy()
    still = np.abs(found[25:] - found[:-25]).min(0) < 2.0  # in 5 s, with errors of measurement
    assert still.any()
    assert (found[:, still].min(0) < by_sumo.STRETCH[0]).all()


@pytest.mark.parametrize("name", ["sf_door", "cfsm_door"])
def test_people_go_through_a_door(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("jupedsim")
    monkeypatch.setattr(by_jupedsim, "SEQUENCES", 2)
    table, walls = by_jupedsim.recorded(name, 5)
    assert walls is None
    near = table[table["x"].abs() < 0.1]
    assert len(near)
    assert near["y"].abs().max() < by_jupedsim.DOOR + 0.1
