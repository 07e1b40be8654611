"""Bias correction of calibrated crowds by simulation."""

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


def hurried(seed: int, sequences: int, people: int = 6) -> walkers.Extra:
    """A preferred speed and disturbances that last for some tenths of a second."""
    draw = np.random.default_rng(100 + seed)
    size = draw.normal(0, 0.12, (8, 2, sequences, people, 2))
    rates = draw.uniform(0.5, 4.0, (8, 1, 1, 1))

    def extra(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        speed = walkers.length(v)[..., None]
        waves = size[:, 0] * np.sin(rates * t) + size[:, 1] * np.cos(rates * t)
        return C * (SPEED - speed) * v / speed + waves.sum(0)

    return extra


def calibrated(seed: int, sequences: int = 12) -> tuple[Fit, list[Sequence], CrowdEngine]:
    data = walkers.crowd(hurried(seed, sequences), seed=seed, sequences=sequences, noise=0.01)
    system = walkers.model(PreferredSpeed(c=C, v_pref=SPEED))
    engine = CrowdEngine(data)
    engine.fit_whitening(system, ParameterVector(system).row)
    return refine(engine, system), data, engine


@pytest.mark.thorough
def test_bias_by_disturbances_is_removed() -> None:
    before, after = [], []
    for seed in range(3):
        fit, data, engine = calibrated(seed)
        corrected = bias_corrected(fit, data)
        place = fit.names.index("terms.2.c")
        before.append(abs(fit.row[place] - C))
        after.append(abs(corrected.row[place] - C))
        for result in (corrected, fit):
            assert np.array_equal(ParameterVector(result.system).row.numpy(), result.row)
        # the error of the simulations is part of the standard errors
        errors, original = (f.errors(engine.sequence)[fit.free] for f in (corrected, fit))
        assert (errors >= original).all()
    assert sum(after) < 0.5 * sum(before)


@pytest.mark.thorough
def test_correction_depends_on_seed_and_keeps_parameters_at_bounds() -> None:
    fit, data, _ = calibrated(1, sequences=5)
    at_bound = np.array([name == "terms.1.A" for name in fit.names])
    assert at_bound.sum() == 1
    fit = replace(fit, free=fit.free & ~at_bound)
    first, second, other = (bias_corrected(fit, data, seed=seed).row for seed in (7, 7, 8))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)
    assert np.array_equal(first[at_bound], fit.row[at_bound])
    assert (first[fit.free] != fit.row[fit.free]).any()


@pytest.mark.thorough
def test_failed_calibrations_leave_fit_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*arguments: Any, **options: Any) -> Fit:
        raise SimulationError("it blows up")

    fit, data, _ = calibrated(1, sequences=5)
    monkeypatch.setattr(module, "refine", fails)
    assert bias_corrected(fit, data) is fit
