"""Intervals of calibrated parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from tests.builders import regression


def test_intervals_are_those_of_clusters() -> None:
    rng = np.random.default_rng(3)
    cluster = np.repeat(np.arange(6), 40)
    jacobian, residual = rng.normal(size=(240, 2)), rng.normal(size=240)
    jacobian[cluster == 0] *= 4  # one sequence tells most
    free = np.array([True, False, True])
    fit = replace(regression(np.insert(jacobian, 1, 0.0, axis=1), residual), free=free)
    residual = fit.residual
    half = fit.influence(cluster).half_widths()
    low, high = fit.intervals(cluster).T
    np.testing.assert_allclose((high - low)[free] / 2, half)
    np.testing.assert_allclose((high + low)[free] / 2, fit.row[free])
    assert np.isnan([low[1], high[1]]).all()
    assert np.isnan(fit.intervals(np.repeat([0, 1], 120))).all()  # too few clusters
    without = np.stack(
        [
            np.linalg.lstsq(jacobian[cluster != k], -residual[cluster != k], rcond=None)[0]
            for k in range(6)
        ]
    )
    spread = np.sqrt(5 / 6 * (without**2).sum(0))
    np.testing.assert_allclose(fit.errors(cluster)[free], spread, rtol=1e-9)
    low, high = fit.jackknife_intervals(cluster)[free].T
    np.testing.assert_allclose((high - low) / 2, stats.t.ppf(0.975, 5) * spread, rtol=1e-9)
    simulated = replace(fit, simulated=np.array([0.3, 0.0, 0.4]))
    wanted = np.hypot(fit.errors(cluster), simulated.simulated)
    np.testing.assert_allclose(simulated.errors(cluster), wanted)


def test_what_one_sequence_alone_tells_of_has_no_interval() -> None:
    rng = np.random.default_rng(5)
    sequence = np.repeat(np.arange(5), 30)
    jacobian = rng.normal(size=(150, 3))
    jacobian[sequence != 2, 1] = 0.0
    residual = rng.normal(size=150)
    fit = regression(jacobian, residual)
    low, high = fit.intervals(sequence).T
    assert np.isnan([low[1], high[1]]).all()
    assert (low < fit.row)[[0, 2]].all()
    assert (fit.row < high)[[0, 2]].all()
