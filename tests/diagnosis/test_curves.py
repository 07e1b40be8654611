"""Curves and waves in what a model leaves, and what they stand against."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from nnode.calibrate.parameters import ParameterVector
from nnode.diagnosis.curves import columns_of, curves, significant_curves, with_curve
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.residuals.engine import square_of
from nnode.diagnosis.residuals.fit import Fit
from nnode.diagnosis.residuals.variables import Variable, hats, lengths_of
from nnode.diagnosis.search import converged_fit, search
from nnode.model.effects import CATALOGUE
from tests.diagnosis.platoons import lin, platoons

WAVE = 70.0


def _wavy(x: np.ndarray, law: np.ndarray, lead: np.ndarray) -> np.ndarray:
    return law * (1 + 0.08 * np.sin(2 * np.pi * x[:, :-1] / WAVE + 1.0))


@pytest.fixture(scope="module")
def wavy() -> tuple[TrafficEngine, Fit]:
    # as many clusters as it takes to be sure of one curve among many
    engine = TrafficEngine(platoons(_wavy, number=16, driver=0.1))
    return engine, converged_fit(engine, lin())


@pytest.mark.thorough
def test_a_wave_along_the_road_is_found(wavy: tuple[TrafficEngine, Fit]) -> None:
    engine, fit = wavy
    best = significant_curves(engine, fit, curves(engine, fit, engine.variables()), 0.01)[0]
    assert best.variable.name == "waves of position"
    assert best.variable.lengths[0] == pytest.approx(WAVE, rel=0.05)
    assert best.removed > 0.5
    # the curve over its knots is the wave that was hidden, in m/s
    place = np.array(best.variable.knots)
    shape = np.sin(2 * np.pi * place / best.variable.lengths[0] + 1.0)
    assert np.ptp(best.heights) == pytest.approx(2 * 0.08 * 17, rel=0.4)
    assert abs(np.corrcoef(best.heights, shape)[0, 1]) > 0.5


def test_no_effect_is_named_where_a_curve_predicts_better(wavy: tuple[TrafficEngine, Fit]) -> None:
    engine, fit = wavy
    effects = [CATALOGUE.effects[name] for name in ("speed_zone", "relative_speed")]
    assert not search(engine, fit, effects, variables=engine.variables()).steps


def test_a_curve_as_a_term_does_what_its_trace_says(wavy: tuple[TrafficEngine, Fit]) -> None:
    engine, fit = wavy
    found = curves(engine, fit, engine.variables())
    (one,) = (curve for curve in found if curve.variable.name == "gap")
    one = replace(one, amounts=1e-3 * one.amounts, shift=0 * one.shift)
    system = with_curve(fit, one)
    moved = engine.residuals(system, ParameterVector(system).row[None])[0].numpy() - fit.residual
    expected = columns_of(engine, fit, one.variable) @ one.amounts
    assert np.corrcoef(moved, expected)[0, 1] > 0.999
    assert np.std(moved) == pytest.approx(np.std(expected), rel=0.05)


def test_the_scale_of_a_curve_is_calibrated_before_it_is_weighed(
    wavy: tuple[TrafficEngine, Fit],
) -> None:
    engine, fit = wavy
    best = significant_curves(engine, fit, curves(engine, fit, engine.variables()), 0.01)[0]
    before, after = (square_of(engine, s) for s in (fit.system, with_curve(fit, best)))
    assert 0.5 < 1 - after / before <= best.removed < 1


def test_waves_are_those_that_the_data_tell_apart() -> None:
    found = lengths_of(30.0, 300.0, 600.0)
    assert max(found) == pytest.approx(300.0)
    assert 30.0 < min(found) < 31.0
    # phases of neighbouring waves part by half a turn over the span
    turns = 600.0 / np.array(found)
    assert np.diff(turns) == pytest.approx(0.5)
    assert lengths_of(30.0, 300.0, 0.0) == ()
    assert len(lengths_of(1.0, 300.0, 1e6, max_number=50)) == 50


def test_weights_of_a_curve_share_a_value_between_its_knots() -> None:
    weights = hats(torch.tensor([0.0, 1.0, 1.5, 9.0]), (1.0, 2.0, 4.0))
    assert weights.tolist() == [[1, 0, 0], [1, 0, 0], [0.5, 0.5, 0], [0, 0, 1]]


def test_a_wave_is_reported_over_two_of_its_lengths() -> None:
    def nothing(state: object) -> torch.Tensor:
        raise AssertionError

    wave = Variable("waves of x", "m", nothing, (5.0, 99.0), nothing, "", (10.0, 20.0)).wave(1)
    assert wave.lengths == (20.0,)
    assert (wave.knots[0], wave.knots[-1]) == (5.0, 45.0)
    heights = wave.heights(np.array([0.0, 2.0]))
    assert heights == pytest.approx(2 * np.cos(2 * np.pi * np.array(wave.knots) / 20.0))
