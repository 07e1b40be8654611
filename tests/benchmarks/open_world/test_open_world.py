"""Which answers are right in worlds of other laws, and how often they were given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.open_world import by_jupedsim, by_sumo, laws
from benchmarks.open_world.page import by_law, criteria, scene_criteria, share, write
from benchmarks.truths.laws.motion import RANGES
from nnode.app.base_laws import LAWS
from nnode.models.effects import CATALOGUE


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
    for people in by_jupedsim.SCENES.values():
        assert {*people.right, *people.allowed} <= set(CATALOGUE.effects)
        assert set(people.first) <= set(LAWS["crowd"])
    for scene in by_sumo.SCENES.values():
        assert set(scene.right) <= set(CATALOGUE.effects)
        assert set(scene.first) <= set(LAWS["traffic"])
    assert len(by_sumo.cases(5, 2)) == 2 * len(by_sumo.SCENES)


def test_what_was_reached() -> None:
    rows = [
        row("idm", "idm"),
        row("idm", "idm", nearest_names=["inertia"], nearest_false=["inertia"]),
        row("helly", "fvdm", p=0.4),
        row("lin", "lin", asked="lin", asked_names=["memory"], asked_false=["memory"],
            nearest_names=["memory"], nearest_false=["memory"]),
    ]  # fmt: skip
    found = dict(zip(criteria(rows)["what"], criteria(rows)["reached"], strict=True))
    assert found["the true law comes first"].startswith("3 of 4 (75 %")
    assert found["another one comes first, not told from it (p > 0.05)"].startswith("1 of 4")
    # where the law that was asked for comes first, there is one diagnosis, not two
    assert found["a diagnosis names something false"].startswith("2 of 7")
    assert found["the diagnosis of the true law names nothing"].startswith("1 of 3")
    table = by_law(rows).set_index("true law")
    assert table.loc["helly", "else first"] == "fvdm"
    assert table.loc["idm", "of these false"] == "inertia"


def test_equals_of_the_right_name_count_as_said() -> None:
    def effect(name: str, *others: str) -> dict[str, Any]:
        return {"name": name, "alternatives": [{"name": other} for other in others]}

    late = ("reaction_delay", "inertia")
    assert by_sumo._called(effect("memory", "lasting_time_gap"), ("driver_heterogeneity",)) == (
        "driver_heterogeneity"
    )
    assert by_sumo._called(effect("memory", "inertia"), ()) == "memory"
    assert by_sumo._called(effect("multi_anticipation", "inertia"), late) == "inertia"


def test_what_is_said_of_people() -> None:
    scene = by_jupedsim.SCENES["gcfm_pillar"]
    laws = {"ranking": [{"name": "gcfm"}]}

    def said(*effects: tuple[str, ...]) -> dict[str, Any]:
        found = [{"name": n, "alternatives": [{"name": o} for o in more]} for n, *more in effects]
        report = {
            "laws": laws,
            "laws_again": None,
            "verdict": "named",
            "effects": found,
            "leads": [],
        }
        return by_jupedsim.judged("gcfm_pillar", 1, scene, report, None, 0.0)

    assert said(("obstacle",))["right"]
    assert said(("anticipation",), ("attraction", "obstacle"))["right"]
    assert not said(("anticipation",))["right"]
    assert said(("drift",))["false"] == ["drift"]
    assert said()["right"] is False


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
