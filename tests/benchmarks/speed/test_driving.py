"""The benchmark of driven vehicles: one scene for all, and everybody driven without a crash."""

from __future__ import annotations

import pytest

from benchmarks.speed.driving import LAWS, OWN, SECONDS, STEP, rows


@pytest.mark.thorough
def test_a_small_case() -> None:
    pytest.importorskip("sumo")
    own, *driven = rows([25], LAWS, ["traci"], repeats=1)
    assert [row["law"] for row in (own, *driven)] == [OWN, *LAWS]
    for row in driven:
        assert (row["driven"], row["collisions"]) == (25, 0)
        assert row["steps"] == own["steps"] == round(SECONDS / STEP)
        assert 0 < row["in_sumo"] < 1
        assert row["steps_per_s"] > 0
