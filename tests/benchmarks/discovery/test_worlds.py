"""The scoring of diagnoses of data from other laws and programs."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.discovery import jupedsim_scenes, sumo_scenes, worlds
from benchmarks.discovery.scenes import SCENES
from benchmarks.discovery.worlds import allowed, answered
from benchmarks.programs.sumo import STEP
from benchmarks.synthetic_cases.laws import RANGES
from nnode.app import discover
from nnode.app.compared_laws import LAWS
from nnode.model.effects import CATALOGUE


def test_effects_of_the_true_law_are_allowed() -> None:
    assert allowed("idm", "idm") == ()
    assert {"relative_speed", "inertia", "time_gap"} < set(allowed("idm", "lin"))
    assert "time_gap" not in allowed("krauss", "idm")
    assert "leader_length" in allowed("log", "idm")
    names = {name for true in RANGES for law in RANGES for name in allowed(true, law)}
    assert names <= set(CATALOGUE.effects)
    assert set(RANGES) == set(LAWS["traffic"])


@pytest.mark.parametrize("program", worlds.PROGRAMS)
def test_answers_are_in_the_catalogue(program: str) -> None:
    domain, _ = worlds.PROGRAMS[program]
    for scene in SCENES[program].values():
        answer = scene["answer"]
        names = {*answer.get("right", ()), *answer.get("allowed", ())}
        assert names <= set(CATALOGUE.effects)
        assert set(answer.get("first", ())) <= set(LAWS[domain])
    cases = worlds.cases(program, DiscoveryBenchmarkOptions(seeds=2), 5)
    assert len(cases) == 2 * len(SCENES[program])


def test_base_laws_alternate_with_the_seed() -> None:
    laws = worlds.cases("laws", DiscoveryBenchmarkOptions(seeds=2), 5)
    assert [laws[f"laws-idm-s{seed}"]["law"] for seed in (5, 6)] == ["lin", "idm"]


PILLAR = {"right": ("obstacle",), "allowed": ("anticipation",)}
LATE = {"right": ("reaction_delay", "inertia"), "unknown": True}


@pytest.mark.parametrize(
    ("answer", "effects", "verdict", "right", "false"),
    [
        (PILLAR, [("obstacle",)], "named", True, ""),
        (PILLAR, [("anticipation",), ("attraction", "obstacle")], "named", True, ""),
        (PILLAR, [("anticipation",)], "named", False, ""),
        (PILLAR, [], "unknown", False, ""),
        (PILLAR, [("obstacle",), ("drift",)], "named", False, "drift"),
        (LATE, [("multi_anticipation", "inertia")], "named", True, ""),
        (LATE, [], "unknown", True, ""),
        (LATE, [], "none", False, ""),
        ({}, [], "none", True, ""),
    ],
)
def test_answers_are_scored(
    answer: dict[str, Any], effects: list[tuple[str, ...]], verdict: str, right: bool, false: str
) -> None:
    named = [{"name": n, "alternatives": [{"name": o} for o in others]} for n, *others in effects]
    row = answered({"verdict": verdict, "effects": named, "hypotheses": []}, **answer)
    assert (row["right"], row["false_names"]) == (right, false)


def test_evaluation_of_a_law(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = {"name": "memory", "alternatives": []}
    requested = {"verdict": "named", "effects": [memory], "hypotheses": [], "laws_again": None}
    requested["laws"] = {"ranking": [{"name": "lin"}]}
    best = SimpleNamespace(plain=lambda: {"verdict": "none", "effects": [], "hypotheses": []})
    report = SimpleNamespace(plain=lambda: requested, nearest=best)
    monkeypatch.setattr(discover, "diagnose_table", lambda *arguments, **options: report)
    first, second = worlds.evaluate("laws", "lin", 5, "idm")["worlds"]
    assert (first["law"], first["law_first"], first["false_name"]) == ("lin", True, False)
    assert (second["law"], second["right"], second["false_names"]) == ("idm", False, "memory")


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["krauss_light", "krauss_lane_drop", "krauss_factors"])
def test_sumo_scenes_are_plausible_and_reproducible(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("sumo")
    monkeypatch.setattr(sumo_scenes, "ROADS", 6)
    table, _ = sumo_scenes.recorded(name, 5)
    assert table["agent"].nunique() == 6 * sumo_scenes.CARS
    paths = table.pivot_table(index="time", columns=["sequence", "agent"], values="x")
    speed = np.diff(paths.to_numpy(), axis=0) / (STEP * sumo_scenes.EVERY)
    assert np.isfinite(speed).all()
    assert speed.max() < 40  # no jumps at junctions
    np.testing.assert_array_equal(sumo_scenes.recorded(name, 5)[0]["x"], table["x"])


@pytest.mark.thorough
def test_followers_wait_at_a_traffic_light(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sumo")
    monkeypatch.setattr(sumo_scenes, "ROADS", 12)
    table, _ = sumo_scenes.recorded("idm_light", 555000)
    paths = table.pivot_table(index="time", columns="agent", values="x").to_numpy()
    still = np.abs(paths[25:] - paths[:-25]).min(0) < 2.0  # within 5 s, with measurement errors
    assert still.any()
    assert (paths[:, still].min(0) < sumo_scenes.STRETCH[0]).all()


@pytest.mark.parametrize("name", ["sf_door", "cfsm_door"])
def test_people_pass_through_a_door(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("jupedsim")
    monkeypatch.setattr(jupedsim_scenes, "SEQUENCES", 2)
    table, walls = jupedsim_scenes.recorded(name, 5)
    assert walls is None
    near = table[table["x"].abs() < 0.1]
    assert len(near)
    assert near["y"].abs().max() < jupedsim_scenes.DOOR + 0.1
