"""The benchmark of externally driven SUMO vehicles."""

from __future__ import annotations

import pytest

from benchmarks.speed.driving import LAWS, OWN, SECONDS, STEP, rows


@pytest.mark.thorough
def test_vehicles_are_driven_without_collisions() -> None:
    pytest.importorskip("sumo")
    reference, *driven = rows([25], LAWS, ["traci"], repeats=1)
    assert [row["law"] for row in (reference, *driven)] == [OWN, *LAWS]
    for row in driven:
        assert (row["driven"], row["collisions"]) == (25, 0)
        assert row["steps"] == reference["steps"] == round(SECONDS / STEP)
        assert 0 < row["in_sumo"] < 1
        assert row["steps_per_s"] > 0
