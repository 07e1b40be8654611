"""Intervals of calibrated parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from tests.builders import regression


def test_intervals_by_cluster() -> None:
    rng = np.random.default_rng(3)
    cluster = np.repeat(np.arange(6), 40)
    jacobian, residual = rng.normal(size=(240, 2)), rng.normal(size=240)
    jacobian[cluster == 0] *= 4  # one cluster has most of the information
    free = np.array([True, False, True])
    fit = replace(regression(np.insert(jacobian, 1, 0.0, axis=1), residual), free=free)
    residual = fit.residual
    half = fit.influence(cluster).half_widths()
    low, high = fit.intervals(cluster).T
    np.testing.assert_allclose((high - low)[free] / 2, half)
    np.testing.assert_allclose((high + low)[free] / 2, fit.row[free])
    assert np.isnan([low[1], high[1]]).all()
    assert np.isnan(fit.intervals(np.repeat([0, 1], 120))).all()  # too few clusters
    others = [cluster != k for k in range(6)]
    refits = [np.linalg.lstsq(jacobian[o], -residual[o], rcond=None)[0] for o in others]
    spread = np.sqrt(5 / 6 * np.square(refits).sum(0))
    np.testing.assert_allclose(fit.errors(cluster)[free], spread, rtol=1e-9)
    low, high = fit.jackknife_intervals(cluster)[free].T
    np.testing.assert_allclose((high - low) / 2, stats.t.ppf(0.975, 5) * spread, rtol=1e-9)
    simulated = replace(fit, simulated=np.array([0.3, 0.0, 0.4]))
    expected = np.hypot(fit.errors(cluster), simulated.simulated)
    np.testing.assert_allclose(simulated.errors(cluster), expected)


def test_no_interval_for_parameter_of_one_cluster() -> None:
    rng = np.random.default_rng(5)
    sequence = np.repeat(np.arange(5), 30)
    jacobian = rng.normal(size=(150, 3))
    jacobian[sequence != 2, 1] = 0.0
    fit = regression(jacobian, rng.normal(size=150))
    low, high = fit.intervals(sequence).T
    assert np.isnan([low[1], high[1]]).all()
    assert (low < fit.row)[[0, 2]].all()
    assert (fit.row < high)[[0, 2]].all()
