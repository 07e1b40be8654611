"""Intervals of calibrated parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nnode.discover.residuals.fit import Fit
from nnode.model import System


def test_intervals_are_those_of_clusters() -> None:
    rng = np.random.default_rng(3)
    cluster = np.repeat(np.arange(6), 40)
    jacobian, residual = rng.normal(size=(240, 2)), rng.normal(size=240)
    jacobian[cluster == 0] *= 4  # one sequence tells most
    residual -= jacobian @ np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    free = np.array([True, False, True])
    wide = np.insert(jacobian, 1, 0.0, axis=1)
    fit = Fit(System([]), ["a", "b", "c"], np.array([2.0, 7.0, -1.0]), residual, wide, free)
    half = fit.influence(cluster).half_widths()
    low, high = fit.intervals(cluster).T
    np.testing.assert_allclose((high - low)[free] / 2, half)
    np.testing.assert_allclose((high + low)[free] / 2, fit.row[free])
    assert np.isnan([low[1], high[1]]).all()
    assert np.isnan(fit.intervals(np.repeat([0, 1], 120))).all()  # too few clusters
    simulated = replace(fit, simulated=np.array([0.3, 0.0, 0.4]))
    wanted = np.hypot(fit.errors(cluster), simulated.simulated)
    np.testing.assert_allclose(simulated.errors(cluster), wanted)


def test_what_one_sequence_alone_tells_of_has_no_interval() -> None:
    rng = np.random.default_rng(5)
    sequence = np.repeat(np.arange(5), 30)
    jacobian = rng.normal(size=(150, 3))
    jacobian[sequence != 2, 1] = 0.0
    residual = rng.normal(size=150)
    residual -= jacobian @ np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    fit = Fit(System([]), ["a", "b", "c"], np.ones(3), residual, jacobian, np.ones(3, dtype=bool))
    low, high = fit.intervals(sequence).T
    assert np.isnan([low[1], high[1]]).all()
    assert (low[[0, 2]] < 1).all()
    assert (high[[0, 2]] > 1).all()
