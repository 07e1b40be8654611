"""Right answers in worlds of other laws, and how often they were given."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.discovery import jupedsim_scenes, sumo_scenes, worlds
from benchmarks.discovery.tables import share
from benchmarks.discovery.worlds import Answer, allowed, criteria
from benchmarks.programs.sumo import STEP
from benchmarks.synthetic_cases.laws import RANGES
from nnode.app import discover
from nnode.app.nearest_law import LAWS
from nnode.model.effects import CATALOGUE


def test_the_true_law_s_effects_are_allowed() -> None:
    assert allowed("idm", "idm") == ()
    assert {"relative_speed", "inertia", "time_gap"} < set(allowed("idm", "lin"))
    assert "time_gap" not in allowed("krauss", "idm")
    assert "leader_length" in allowed("log", "idm")
    every = {name for true in RANGES for law in RANGES for name in allowed(true, law)}
    assert every <= set(CATALOGUE.effects)
    assert set(RANGES) == set(LAWS["traffic"])


def test_answers_are_names_of_the_catalogue() -> None:
    for domain, module in (("traffic", sumo_scenes), ("crowd", jupedsim_scenes)):
        scenes: dict[str, Any] = vars(module)["SCENES"]
        for scene in scenes.values():
            assert {*scene.answer.right, *scene.answer.allowed} <= set(CATALOGUE.effects)
            assert set(scene.answer.first) <= set(LAWS[domain])
        kind = "sumo" if domain == "traffic" else "jupedsim"
        assert len(worlds.cases(kind, DiscoveryBenchmarkOptions(seeds=2), 5)) == 2 * len(scenes)
    laws = worlds.cases("laws", DiscoveryBenchmarkOptions(seeds=2), 5)
    assert [laws[f"laws-idm-s{seed}"]["asked"] for seed in (5, 6)] == ["lin", "idm"]


def report(*effects: tuple[str, ...], verdict: str = "named", first: str = "idm") -> dict[str, Any]:
    """A report that names effects, each with its equals."""
    named = [{"name": n, "alternatives": [{"name": o} for o in more]} for n, *more in effects]
    laws = {"ranking": [{"name": first}]}
    return {"laws": laws, "laws_again": None, "verdict": verdict, "effects": named, "leads": []}


PILLAR = Answer(right=("obstacle",), allowed=("anticipation",))
LATE = Answer(right=("reaction_delay", "inertia"), unknown=True)
DRIVERS = Answer(first=("idm",), right=("driver_heterogeneity",))


@pytest.mark.parametrize(
    ("answer", "effects", "verdict", "right", "false"),
    [
        (PILLAR, [("obstacle",)], "named", True, []),
        (PILLAR, [("anticipation",), ("attraction", "obstacle")], "named", True, []),
        (PILLAR, [("anticipation",)], "named", False, []),
        (PILLAR, [], "unknown", False, []),
        (PILLAR, [("obstacle",), ("drift",)], "named", False, ["drift"]),
        (LATE, [("multi_anticipation", "inertia")], "named", True, []),
        (LATE, [], "unknown", True, []),
        (LATE, [], "none", False, []),
        (DRIVERS, [("memory", "lasting_time_gap")], "named", True, []),
        (DRIVERS, [("memory", "inertia")], "named", False, ["memory"]),
        (worlds.NOTHING, [], "none", True, []),
    ],
)
def test_right_answers(
    answer: Answer, effects: list[tuple[str, ...]], verdict: str, right: bool, false: list[str]
) -> None:
    row = answer.judge(report(*effects, verdict=verdict), None)
    assert (row["right"], row["false"]) == (right, false)
    assert row["law_right"] is (True if answer.first else None)
    assert row["names"] == [answer.called(effect) for effect in report(*effects)["effects"]]


def test_the_best_fitting_law_and_the_last_ranking_are_judged() -> None:
    asked = {**report(verdict="unknown", first="gipps")}
    asked["laws_again"] = {"ranking": [{"name": "krauss"}]}
    nearest = {**report(("speed_zone",)), "leads": [{"name": "inertia"}]}
    row = Answer(first=("krauss",), right=("speed_zone",)).judge(asked, nearest)
    assert (row["first"], row["law_right"], row["right"]) == ("krauss", True, True)
    assert (row["verdict"], row["asked_verdict"]) == ("named", "unknown")
    assert (row["names"], row["asked_names"], row["leads"]) == (["speed_zone"], [], ["inertia"])
    assert not Answer(first=("krauss",)).judge(report(), None)["law_right"]


def test_shares_are_counted_by_program() -> None:
    law = {"program": "laws", "asked": "lin", "asked_false": [], "right": True, "false": []}
    sumo = {"program": "sumo", "first": "idm", "law_right": False, "right": True, "false": []}
    rows = [
        {**law, "first": "idm", "law_right": True},
        {**law, "first": "idm", "law_right": True, "false": ["inertia"], "right": False},
        {**law, "first": "fvdm", "law_right": False, "asked_false": ["memory"]},
        {**law, "first": "lin", "law_right": True, "false": ["memory"], "asked_false": ["memory"]},
        sumo,
        {**sumo, "law_right": None},
    ]
    table = criteria(rows).set_index("program")
    assert table.loc["laws", "right law ranks first"].startswith("3 of 4 (75 %")
    # if the requested law ranks first, there is one diagnosis, not two
    assert table.loc["laws", "false name"].startswith("3 of 7")
    assert table.loc["sumo", "right law ranks first"].startswith("0 of 1")
    assert len(worlds.blocks(rows)) == 3


def test_a_world_of_a_law_is_evaluated(monkeypatch: pytest.MonkeyPatch) -> None:
    said = {**report(("memory",)), "laws_again": None}
    said["laws"] = {"ranking": [{"name": "lin", "behind": 0.0, "p_value": None}]}
    answer = SimpleNamespace(plain=lambda: said, nearest=None)
    monkeypatch.setattr(discover, "diagnose_table", lambda *given, **options: answer)
    row = worlds.evaluate("laws", "lin", 5, "lin")
    assert (row["law_right"], row["false"], row["asked_false"]) == (True, ["memory"], ["memory"])
    assert (row["behind"], row["p"]) == (0.0, None)


def test_shares_have_exact_intervals() -> None:
    # Clopper and Pearson 1934: 0 of 10 leaves up to 1 - 0.025^(1/10)
    limit = 100 * (1 - 0.025**0.1)
    assert share(pd.Series([False] * 10)) == f"0 of 10 (0 %, 0–{limit:.0f} %)"
    assert share(pd.Series([], dtype=bool)) == "–"


@pytest.mark.parametrize("name", ["krauss_light", "krauss_lane_drop", "krauss_factors"])
def test_sumo_drives_a_scene(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sumo")
    monkeypatch.setattr(sumo_scenes, "ROADS", 6)
    table, _ = sumo_scenes.recorded(name, 5)
    assert table["agent"].nunique() == 6 * sumo_scenes.CARS
    paths = table.pivot_table(index="time", columns=["sequence", "agent"], values="x")
    speed = np.diff(paths.to_numpy(), axis=0) / (STEP * sumo_scenes.EVERY)
    assert np.isfinite(speed).all()
    assert speed.max() < 40  # no jumps at nodes of the roads
    np.testing.assert_array_equal(sumo_scenes.recorded(name, 5)[0]["x"], table["x"])


def test_followers_wait_at_a_light(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sumo")
    monkeypatch.setattr(sumo_scenes, "ROADS", 12)
    table, _ = sumo_scenes.recorded("idm_light", 555000)
    paths = table.pivot_table(index="time", columns="agent", values="x").to_numpy()
    still = np.abs(paths[25:] - paths[:-25]).min(0) < 2.0  # in 5 s, with errors of measurement
    assert still.any()
    assert (paths[:, still].min(0) < sumo_scenes.STRETCH[0]).all()


@pytest.mark.parametrize("name", ["sf_door", "cfsm_door"])
def test_people_go_through_a_door(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("jupedsim")
    monkeypatch.setattr(jupedsim_scenes, "SEQUENCES", 2)
    table, walls = jupedsim_scenes.recorded(name, 5)
    assert walls is None
    near = table[table["x"].abs() < 0.1]
    assert len(near)
    assert near["y"].abs().max() < jupedsim_scenes.DOOR + 0.1
