"""Scenes of the open-world benchmark, as SUMO drives them."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.open_world import by_sumo

pytestmark = pytest.mark.slow


def test_a_scene_is_recorded(sumo: Path) -> None:
    table = by_sumo.recorded("idm_trucks", 3)
    assert table["sequence"].nunique() == by_sumo.ROADS
    assert set(table["kind"]) == {"car", "truck"}
    assert table.groupby("sequence")["agent"].nunique().eq(by_sumo.CARS).all()
    assert by_sumo.recorded("idm_trucks", 3).equals(table)
