"""Calibrations without what simulations of the calibrated crowd are off by."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence
from nnode.diagnosis.crowds import indirect_inference as module
from nnode.diagnosis.crowds.engine import CrowdEngine
from nnode.diagnosis.crowds.indirect_inference import bias_corrected
from nnode.diagnosis.residuals.fit import Fit, refine
from nnode.errors import SimulationError
from nnode.model.effects.crowd import PreferredSpeed
from tests.diagnosis import walkers

C, SPEED = 0.8, 1.3


def hurried(seed: int, sequences: int = 12, people: int = 6) -> walkers.Extra:
    """A preferred speed, and disturbances that last for some tenths of a second."""
    draw = np.random.default_rng(100 + seed)
    size = draw.normal(0, 0.12, (8, 2, sequences, people, 2))
    rates = draw.uniform(0.5, 4.0, (8, 1, 1, 1))

    def extra(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        speed = walkers.length(v)[..., None]
        waves = size[:, 0] * np.sin(rates * t) + size[:, 1] * np.cos(rates * t)
        return C * (SPEED - speed) * v / speed + waves.sum(0)

    return extra


def calibrated(
    seed: int, noise: float, sequences: int = 12
) -> tuple[Fit, list[Sequence], CrowdEngine]:
    extra = hurried(seed, sequences)
    data = walkers.crowd(extra, seed=seed, sequences=sequences, noise=noise)
    system = walkers.model(PreferredSpeed(c=C, v_pref=SPEED))
    engine = CrowdEngine(data)
    engine.fit_whitening(system, ParameterVector(system).row)
    return refine(engine, system), data, engine


@pytest.mark.thorough
def test_a_bias_by_disturbances_is_taken_out() -> None:
    before, after = [], []
    for seed in range(3):
        fit, data, engine = calibrated(seed, 0.01)
        found = bias_corrected(fit, data)
        place = fit.names.index("terms.2.c")
        before.append(abs(fit.row[place] - C))
        after.append(abs(found.row[place] - C))
        assert np.array_equal(ParameterVector(found.system).row.numpy(), found.row)
        assert np.array_equal(ParameterVector(fit.system).row.numpy(), fit.row)
        # what the simulations leave uncertain is part of the errors
        wider = found.errors(engine.sequence)[fit.free] >= fit.errors(engine.sequence)[fit.free]
        assert wider.all()
    assert sum(after) < 0.5 * sum(before)


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_numbers_and_bounds_hold() -> None:
    fit, data, _ = calibrated(1, 0.01, sequences=5)
    held = np.array([name == "terms.1.A" for name in fit.names])
    assert held.sum() == 1
    fit = replace(fit, free=fit.free & ~held)  # as at a bound
    found = bias_corrected(fit, data, seed=7)
    assert np.array_equal(found.row, bias_corrected(fit, data, seed=7).row)
    assert not np.array_equal(found.row, bias_corrected(fit, data, seed=8).row)
    assert np.array_equal(found.row[held], fit.row[held])
    assert (found.row[fit.free] != fit.row[fit.free]).any()


@pytest.mark.thorough
def test_crowds_that_cannot_be_calibrated_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*given: Any, **more: Any) -> Fit:
        raise SimulationError("it blows up")

    fit, data, _ = calibrated(1, 0.01, sequences=5)
    monkeypatch.setattr(module, "refine", fails)
    assert bias_corrected(fit, data) is fit
