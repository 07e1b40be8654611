"""Followers behind measured leaders: derivatives of residuals are differences of simulations."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import nnode
from benchmarks.drivers import platoons
from nnode.calibrate.parameters import ParameterVector
from nnode.discover.lanes.followers import FollowersEngine
from nnode.model import System, Traffic, make_law
from nnode.model.effects import Effect
from nnode.model.effects.lane import Inertia, MultiAnticipation, ReactionDelay, SpeedPeriod
from nnode.model.extend import extended


def estimated(memory: Effect) -> tuple[FollowersEngine, System]:
    """Followers, and their law with a memory, calibrated."""
    table = platoons("lin", "inertia", 0.15, 77, number=6, vehicles=4)
    engine = FollowersEngine(list(nnode.sequences(table)))
    system = Traffic([make_law("lin"), memory], leader="measured").double()
    engine.fit_whitening(system, ParameterVector(system).row)
    assert engine.population is not None
    return engine, engine.population.system


@pytest.mark.parametrize("memory", [Inertia(tau_v=0.3), ReactionDelay(T=0.5)])
def test_derivatives_beside_a_memory_are_differences(memory: Effect) -> None:
    engine, system = estimated(memory)
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


@pytest.mark.parametrize("memory", [Inertia(tau_v=0.3), ReactionDelay(T=0.3)])
def test_a_period_of_the_whole_record_is_another_desired_speed(memory: Effect) -> None:
    engine, system = estimated(memory)
    row = ParameterVector(system).row
    first = SpeedPeriod.probes(engine.batch, system)[0]
    always = replace(first, options={"a": -1e4, "b": 1e4})
    (column,) = engine.screen_columns(system, row, SpeedPeriod, always)
    tangents = torch.stack(list(engine.tangents(system, row)), 1)
    basis, _ = torch.linalg.qr(tangents)
    # not by another start of the memory, which is unknown
    assert float((column - basis @ (basis.T @ column)).norm()) < 0.2 * float(column.norm())


def test_differences_between_drivers_are_corrected_if_the_estimation_converged() -> None:
    engine, _ = estimated(Inertia(tau_v=0.3))
    population = engine.population
    assert population is not None
    corrected = engine.drivers(0)
    assert corrected.estimate.converged
    assert (corrected.bias != 0).any()
    engine.population = replace(population, estimate=replace(population.estimate, converged=False))
    assert engine.drivers(0) is engine.population
