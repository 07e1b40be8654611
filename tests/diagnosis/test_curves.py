"""Free curves and waves in the residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from nnode.diagnosis.curves import columns_of, curves, significant_curves, with_curve
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.residuals.engine import square_of
from nnode.diagnosis.residuals.fit import Fit
from nnode.diagnosis.residuals.variables import Variable, hats, lengths_of
from nnode.diagnosis.search import converged_fit, search
from nnode.model.effects import CATALOGUE
from tests.diagnosis.agreement import residuals
from tests.diagnosis.platoons import lin, platoons

WAVE = 70.0


def _wavy(x: np.ndarray, law: np.ndarray, lead: np.ndarray) -> np.ndarray:
    return law * (1 + 0.08 * np.sin(2 * np.pi * x[:, :-1] / WAVE + 1.0))


@pytest.fixture(scope="module")
def wavy() -> tuple[TrafficEngine, Fit]:
    # enough clusters for the significance of one curve among many
    engine = TrafficEngine(platoons(_wavy, number=16, driver=0.1))
    return engine, converged_fit(engine, lin())


@pytest.mark.thorough
def test_wave_along_road_is_recovered(wavy: tuple[TrafficEngine, Fit]) -> None:
    engine, fit = wavy
    best = significant_curves(engine, fit, curves(engine, fit, engine.variables()), 0.01)[0]
    assert best.variable.name == "waves of position"
    assert best.variable.lengths[0] == pytest.approx(WAVE, rel=0.05)
    assert best.removed > 0.5
    # the curve is the hidden wave, in m/s
    place = np.array(best.variable.knots)
    shape = np.sin(2 * np.pi * place / best.variable.lengths[0] + 1.0)
    assert np.ptp(best.heights) == pytest.approx(2 * 0.08 * 17, rel=0.4)
    assert abs(np.corrcoef(best.heights, shape)[0, 1]) > 0.5


def test_search_adds_no_effect_if_curve_predicts_better(wavy: tuple[TrafficEngine, Fit]) -> None:
    engine, fit = wavy
    effects = [CATALOGUE.effects[name] for name in ("speed_zone", "relative_speed")]
    assert not search(engine, fit, effects, variables=engine.variables()).steps


def test_curve_columns_are_finite_differences(wavy: tuple[TrafficEngine, Fit]) -> None:
    engine, fit = wavy
    by_variable = curves(engine, fit, engine.variables())
    (curve,) = (curve for curve in by_variable if curve.variable.name == "gap")
    curve = replace(curve, amounts=1e-3 * curve.amounts, shift=0 * curve.shift)
    change = residuals(engine, with_curve(fit, curve)).numpy() - fit.residual
    expected = columns_of(engine, fit, curve.variable) @ curve.amounts
    assert np.corrcoef(change, expected)[0, 1] > 0.999
    assert np.std(change) == pytest.approx(np.std(expected), rel=0.05)


def test_scale_of_curve_is_calibrated(wavy: tuple[TrafficEngine, Fit]) -> None:
    engine, fit = wavy
    best = significant_curves(engine, fit, curves(engine, fit, engine.variables()), 0.01)[0]
    before, after = (square_of(engine, s) for s in (fit.system, with_curve(fit, best)))
    assert 0.5 < 1 - after / before <= best.removed < 1


def test_wavelengths_are_distinguishable() -> None:
    lengths = lengths_of(30.0, 300.0, 600.0)
    assert max(lengths) == pytest.approx(300.0)
    assert 30.0 < min(lengths) < 31.0
    # phases of neighbouring waves differ by half a turn over the span
    turns = 600.0 / np.array(lengths)
    assert np.diff(turns) == pytest.approx(0.5)
    assert lengths_of(30.0, 300.0, 0.0) == ()
    assert len(lengths_of(1.0, 300.0, 1e6, max_number=50)) == 50


def test_weights_of_knots() -> None:
    weights = hats(torch.tensor([0.0, 1.0, 1.5, 9.0]), (1.0, 2.0, 4.0))
    assert weights.tolist() == [[1, 0, 0], [1, 0, 0], [0.5, 0.5, 0], [0, 0, 1]]


def test_wave_is_reported_over_two_lengths() -> None:
    def unused(state: object) -> torch.Tensor:
        raise AssertionError

    wave = Variable("waves of x", "m", unused, (5.0, 99.0), unused, "", (10.0, 20.0)).wave(1)
    assert wave.lengths == (20.0,)
    assert (wave.knots[0], wave.knots[-1]) == (5.0, 45.0)
    heights = wave.heights(np.array([0.0, 2.0]))
    assert heights == pytest.approx(2 * np.cos(2 * np.pi * np.array(wave.knots) / 20.0))
