"""Scenes of the open-world benchmark, as SUMO drives them."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.discovery import sumo_scenes as by_sumo

pytestmark = pytest.mark.slow


def test_a_scene_is_recorded(sumo: Path) -> None:
    table, _ = by_sumo.recorded("idm_trucks", 3)
    assert table["sequence"].nunique() == by_sumo.ROADS
    assert set(table["kind"]) == {"car", "truck"}
    assert table.groupby("sequence")["agent"].nunique().eq(by_sumo.CARS).all()
    assert by_sumo.recorded("idm_trucks", 3)[0].equals(table)
