"""Scenes of the discovery benchmark, simulated by SUMO."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.discovery import sumo_scenes as by_sumo

pytestmark = pytest.mark.slow


def test_scene_is_recorded_reproducibly(sumo: Path) -> None:
    table, _ = by_sumo.recorded("idm_trucks", 3)
    assert table["sequence"].nunique() == by_sumo.ROADS
    assert set(table["kind"]) == {"car", "truck"}
    assert table.groupby("sequence")["agent"].nunique().eq(by_sumo.CARS).all()
    assert by_sumo.recorded("idm_trucks", 3)[0].equals(table)
