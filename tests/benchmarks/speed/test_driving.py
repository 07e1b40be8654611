"""The benchmark of driven vehicles: one scene for all, and everybody driven without a crash."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.speed.driving import LAWS, SECONDS, STEP, alone, measured, rows, scene


@pytest.mark.thorough
def test_a_small_case() -> None:
    pytest.importorskip("sumo")
    found = list(rows([25], LAWS, ["traci"], repeats=1))
    assert [row["law"] for row in found] == ["SUMO's", *LAWS]
    for row in found[1:]:
        assert (row["driven"], row["collisions"]) == (25, 0)
        assert 0 < row["in_sumo"] < 1
        assert row["steps_per_s"] > 0


@pytest.mark.thorough
def test_all_make_the_same_steps(tmp_path: Path) -> None:
    pytest.importorskip("sumo")
    path = scene(tmp_path, 3)
    own, driven = alone("traci", path, tmp_path), measured("idm", "traci", path, tmp_path)
    assert own["steps"] == driven["steps"] == round(SECONDS / STEP)
