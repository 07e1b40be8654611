"""Ends of periods that lie within a sequence."""

from __future__ import annotations

import pytest

import nnode
from benchmarks import drivers
from nnode.calibrate.parameters import ParameterVector
from nnode.diagnosis.lanes.followers import FollowersEngine
from nnode.diagnosis.residuals.fit import refine
from nnode.diagnosis.search import _with_best_ends
from nnode.model import Traffic, make_law
from nnode.model.effects.lane import SpeedPeriod


def test_an_end_between_sequences_moves_into_the_sequence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drivers, "PERIOD", (250.0, 518.0))
    monkeypatch.setitem(drivers.HIDDEN["lin"], "speed_period", 0.7)
    table = drivers.platoons("lin", "speed_period", 0.15, 5, number=9, vehicles=4)
    engine = FollowersEngine(list(nnode.sequences(table)))
    period = SpeedPeriod(alpha=0.7, a=250.0, b=465.0)
    system = Traffic([make_law("lin"), period], leader="measured").double()
    engine.fit_whitening(system, ParameterVector(system).row)
    fit = refine(engine, system)
    end = fit.names.index("terms.1.b")
    assert not 500 < fit.row[end] < 530  # drivers of the platoon at 500 s are estimated as slow
    found = _with_best_ends(engine, fit, SpeedPeriod)
    assert found.row[end] == pytest.approx(518, abs=5)
