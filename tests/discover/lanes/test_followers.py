"""Followers behind measured leaders: derivatives of residuals are differences of simulations."""

from __future__ import annotations

import pytest

import nnode
from benchmarks.drivers import platoons
from nnode.calibrate.parameters import ParameterVector
from nnode.discover.lanes.followers import FollowersEngine
from nnode.model import Traffic, make_law
from nnode.model.effects import Effect
from nnode.model.effects.lane import Inertia, MultiAnticipation, ReactionDelay
from nnode.model.extend import extended


@pytest.mark.parametrize("memory", [Inertia(tau_v=0.3), ReactionDelay(T=0.5)])
def test_derivatives_beside_a_memory_are_differences(memory: Effect) -> None:
    table = platoons("lin", "inertia", 0.15, 77, number=6, vehicles=4)
    engine = FollowersEngine(list(nnode.sequences(table)))
    system = Traffic([make_law("lin"), memory], leader="measured").double()
    engine.fit_whitening(system, ParameterVector(system).row)
    assert engine.population is not None
    system = engine.population.system
    row = ParameterVector(system).row
    probe = MultiAnticipation.probes(engine.batch, system)[0]
    (column,) = engine.screen_columns(system, row, MultiAnticipation, probe)
    size = 1e-3
    larger, _ = extended(system, MultiAnticipation(c=size).double())
    before, after = (
        engine.residuals(model, ParameterVector(model).row[None])[0] for model in (system, larger)
    )
    difference = (after - before) / size
    assert float((column - difference).norm()) < 0.05 * float(difference.norm())
