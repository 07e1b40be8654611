"""Followers behind measured leaders: derivatives of residuals are differences of simulations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import nnode
from benchmarks.drivers import ZONE, platoons
from nnode.calibrate.parameters import ParameterVector
from nnode.diagnosis.lanes.followers import ERROR, FollowersEngine
from nnode.diagnosis.residuals.fit import evaluated, refine
from nnode.diagnosis.statistics.score import Screen, traces
from nnode.model import System, Traffic, make_law
from nnode.model.effects import Effect
from nnode.model.effects.lane import (
    Inertia,
    MultiAnticipation,
    ReactionDelay,
    RelativeSpeed,
    SpeedPeriod,
    SpeedZone,
    VehicleClass,
)
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


def test_the_change_by_a_class_is_exact_where_drivers_differ() -> None:
    """Almost all of it is what drivers of another T would do, which the whitening removes."""
    table = platoons("idm", "vehicle_class", 0.3, 78, number=6, vehicles=4, error=0.02)
    engine = FollowersEngine(list(nnode.sequences(table)))
    law = Traffic([make_law("idm")], leader="measured").double()
    engine.fit_whitening(law, ParameterVector(law).row)
    assert engine.population is not None
    assert "idm.T" in engine.population.random
    system = engine.population.system
    (probe,) = VehicleClass.probes(engine.batch, system)
    row = ParameterVector(system).row
    (column,) = engine.screen_columns(system, row, VehicleClass, probe)
    size = 1e-4
    longer, _ = extended(system, VehicleClass(**probe.options, phi=1 + size).double())
    before, after = (
        engine.residuals(model, ParameterVector(model).row[None])[0] for model in (system, longer)
    )
    difference = (after - before) / size
    assert float((column - difference).norm()) < 0.01 * float(difference.norm())


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


@pytest.mark.parametrize(("c", "relevant"), [(0.0005, False), (0.2, True)])
def test_effects_that_hardly_move_the_paths_are_not_relevant(c: float, relevant: bool) -> None:
    engine, system = estimated(Inertia(tau_v=0.3))
    larger, _ = extended(system, MultiAnticipation(c=c).double())
    assert engine.relevant(system, larger, 1.0) is relevant
    before, after = (
        engine._simulated(model, ParameterVector(model).row[None])[1][:, 0, 0]
        for model in (system, larger)
    )
    assert (np.sqrt(np.mean((after - before) ** 2)) >= ERROR) is np.bool_(relevant)


def test_the_squares_of_paths_that_diverge_are_infinite(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, system = estimated(Inertia(tau_v=0.3))
    row, pseudo_residuals = ParameterVector(system).row, engine._pseudo_residuals
    finite = engine.squares(system, row).means()

    def diverging(*arguments: object) -> tuple[np.ndarray, object, np.ndarray]:
        difference, model, states = pseudo_residuals(*arguments)
        difference[0, 0, 20:] = np.nan  # of the first follower
        return difference, model, states

    monkeypatch.setattr(engine, "_pseudo_residuals", diverging)
    means = engine.squares(system, row).means()
    assert np.isinf(means[0])
    np.testing.assert_allclose(means[1:], finite[1:])


def test_an_effect_does_not_carry_a_parameter_beyond_its_bound() -> None:
    """The response of ``helly`` to the speed difference is that of ``relative_speed``."""
    table = platoons("idm", "none", 0.0, 77, number=6, vehicles=4)
    engine = FollowersEngine(list(nnode.sequences(table)))
    system = Traffic([make_law("helly")], leader="measured").double()
    engine.fit_whitening(system, ParameterVector(system).row)
    fit = evaluated(engine, system)
    free = np.array([not name.endswith("c_v") for name in fit.names])
    fit = replace(fit, free=free)  # as at a bound
    (trace,) = traces(engine, fit, RelativeSpeed)
    left = Screen(fit, engine.cluster).adjusted(trace.columns)
    # all of it would be left beside the free parameters; 4 % are errors of the linear response
    assert np.linalg.norm(left) < 0.1 * np.linalg.norm(trace.columns)


def test_a_zone_is_located_where_a_law_does_not_reach_its_desired_speed() -> None:
    """Speeds of a map from step to step do not depend on a desired speed that none reaches."""
    table = platoons("idm", "speed_zone", 0.1, 79, number=8, vehicles=4)
    engine = FollowersEngine(list(nnode.sequences(table)))
    law = Traffic([make_law("krauss", v0=40.0)], leader="measured").double()
    usual = engine.with_usual_variances(law)
    fit = refine(usual, law)
    (score,) = Screen(fit, usual.cluster).scores(traces(usual, fit, SpeedZone))
    low, high = ZONE
    assert low < (score.options["a"] + score.options["b"]) / 2 < high
    assert score.options["alpha"] < 1
