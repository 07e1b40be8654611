"""Residuals and derivatives of followers behind measured leaders."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import nnode
from benchmarks.drivers import ZONE, platoons
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence
from nnode.diagnosis import thresholds
from nnode.diagnosis.curves import curves
from nnode.diagnosis.lanes.followers import ERROR, FollowersEngine
from nnode.diagnosis.residuals.fit import evaluated, refine
from nnode.diagnosis.search import converged_fit
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
from tests.diagnosis.agreement import distance, residuals


def engine_of(*arguments: Any, **options: Any) -> FollowersEngine:
    return FollowersEngine(list(nnode.sequences(platoons(*arguments, vehicles=4, **options))))


def estimated(engine: FollowersEngine, law: str, *effects: Effect) -> System:
    """A law and effects, with the estimated parameters of the engine's drivers."""
    system = Traffic([make_law(law), *effects], leader="measured").double()
    engine.fit_whitening(system, ParameterVector(system).row)
    assert engine.population is not None
    return engine.population.system


def with_memory(memory: Effect) -> tuple[FollowersEngine, System]:
    engine = engine_of("lin", "inertia", 0.15, 77, number=6)
    return engine, estimated(engine, "lin", memory)


def column_error(engine: FollowersEngine, system: System, effect: Effect, size: float) -> float:
    """The distance of an effect's column from the difference that the effect makes."""
    probe = effect.probes(engine.batch, system)[0]
    row = ParameterVector(system).row
    (column,) = engine.screen_columns(system, row, type(effect), probe)
    changed, _ = extended(system, effect.double())
    change = residuals(engine, changed) - residuals(engine, system)
    return distance(column, change / size)


@pytest.mark.parametrize("memory", [Inertia(tau_v=0.3), ReactionDelay(T=0.5)])
def test_effect_column_with_memory_is_finite_difference(memory: Effect) -> None:
    assert column_error(*with_memory(memory), MultiAnticipation(c=1e-3), 1e-3) < 0.05


def test_class_column_is_finite_difference_with_drivers_who_differ() -> None:
    """Drivers with another T would explain most of the change; the whitening removes this part."""
    engine = engine_of("idm", "vehicle_class", 0.3, 78, number=6, error=0.02)
    system = estimated(engine, "idm")
    assert engine.population is not None
    assert "idm.T" in engine.population.random
    (probe,) = VehicleClass.probes(engine.batch, system)
    effect = VehicleClass(**probe.options, phi=1 + 1e-4)
    assert column_error(engine, system, effect, 1e-4) < 0.01


@pytest.mark.parametrize("memory", [Inertia(tau_v=0.3), ReactionDelay(T=0.3)])
def test_period_of_whole_record_changes_desired_speed_only(memory: Effect) -> None:
    engine, system = with_memory(memory)
    row = ParameterVector(system).row
    first = SpeedPeriod.probes(engine.batch, system)[0]
    always = replace(first, options={"a": -1e4, "b": 1e4})
    (column,) = engine.screen_columns(system, row, SpeedPeriod, always)
    tangents = torch.stack(list(engine.tangents(system, row)), 1)
    basis, _ = torch.linalg.qr(tangents)
    # the unknown start of the memory does not change
    assert float((column - basis @ (basis.T @ column)).norm()) < 0.2 * float(column.norm())


def test_population_is_corrected_for_bias_if_estimation_converged() -> None:
    engine, _ = with_memory(Inertia(tau_v=0.3))
    population = engine.population
    assert population is not None
    corrected = engine.drivers(0)
    assert corrected.estimate.converged
    assert (corrected.bias != 0).any()
    engine.population = replace(population, estimate=replace(population.estimate, converged=False))
    assert engine.drivers(0) is engine.population


@pytest.mark.parametrize(("c", "relevant"), [(0.0005, False), (0.2, True)])
def test_relevance_of_effect_depends_on_change_of_paths(c: float, relevant: bool) -> None:
    engine, system = with_memory(Inertia(tau_v=0.3))
    changed, _ = extended(system, MultiAnticipation(c=c).double())
    assert engine.relevant(system, changed, 1.0) is relevant
    before, after = (
        engine._simulated(model, ParameterVector(model).row[None])[1][:, 0, 0]
        for model in (system, changed)
    )
    assert (np.sqrt(np.mean((after - before) ** 2)) >= ERROR) is np.bool_(relevant)


def test_squares_of_diverging_paths_are_infinite(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, system = with_memory(Inertia(tau_v=0.3))
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


def test_column_of_effect_that_equals_parameter_at_bound() -> None:
    """The response of ``helly`` to the speed difference is that of ``relative_speed``."""
    engine = engine_of("idm", "none", 0.0, 77, number=6)
    system = Traffic([make_law("helly")], leader="measured").double()
    engine.fit_whitening(system, ParameterVector(system).row)
    fit = evaluated(engine, system)
    free = np.array([not name.endswith("c_v") for name in fit.names])
    fit = replace(fit, free=free)  # as at a bound
    (trace,) = traces(engine, fit, RelativeSpeed)
    remainder = Screen(fit, engine.cluster).adjusted(trace.columns)
    # free parameters alone would leave the whole column; 4 % are errors of the linear response
    assert np.linalg.norm(remainder) < 0.1 * np.linalg.norm(trace.columns)


def test_zone_is_located_with_law_that_does_not_reach_desired_speed() -> None:
    """Speeds of a map from step to step do not depend on a desired speed that none reaches."""
    engine = engine_of("idm", "speed_zone", 0.1, 79, number=8)
    law = Traffic([make_law("krauss", v0=40.0)], leader="measured").double()
    usual = engine.with_usual_variances(law)
    fit = refine(usual, law)
    (score,) = Screen(fit, usual.cluster).scores(traces(usual, fit, SpeedZone))
    low, high = ZONE
    assert low < (score.options["a"] + score.options["b"]) / 2 < high
    assert score.options["alpha"] < 1


@pytest.mark.parametrize(("law", "simulated"), [("idm", False), ("krauss", True)])
def test_columns_of_zones_are_simulated_for_maps_only(
    law: str, simulated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = engine_of("idm", "none", 0.0, 77, number=6)
    system = Traffic([make_law(law)], leader="measured").double()
    engine.fit_whitening(system, ParameterVector(system).row)
    calls, displacement = list[object](), engine._displacement

    def counted(*arguments: object) -> np.ndarray:
        calls.append(arguments)
        return displacement(*arguments)

    monkeypatch.setattr(engine, "_displacement", counted)
    traces(engine, evaluated(engine, system), SpeedZone)
    assert bool(calls) is simulated


def test_last_vehicles_that_are_slower_are_located() -> None:
    data = nnode.sequences(platoons("lin", "none", 0.0, 5, number=14, vehicles=4))
    engine = FollowersEngine([slowed(sequence) for sequence in data])
    system = Traffic([make_law("lin")], leader="measured").double()
    fit = converged_fit(engine, system)
    variables = [variable for variable in engine.variables() if not variable.lengths]
    p_values = {c.variable.name: c.p_value for c in curves(engine, fit, variables)}
    assert p_values["vehicles behind"] < thresholds.STRICT < p_values["gap"]


def slowed(sequence: Sequence) -> Sequence:
    """The last vehicle falls back by 0.3 m/s."""
    x = sequence.x.copy()
    x[:, 0] -= 0.3 * (sequence.time - sequence.time[0])[:, None]
    return replace(sequence, x=x)
