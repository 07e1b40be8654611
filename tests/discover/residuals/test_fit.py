"""Intervals of calibrated parameters."""

from __future__ import annotations

import numpy as np
from scipy import stats

from nnode.discover.residuals.fit import Fit
from nnode.model import System


def test_intervals_are_those_of_the_jackknife() -> None:
    rng = np.random.default_rng(3)
    sequence = np.repeat(np.arange(6), 40)
    jacobian = rng.normal(size=(240, 2))
    jacobian[sequence == 0] *= 4  # one sequence tells most
    truth = np.array([2.0, -1.0])
    noise = rng.normal(size=240)

    def least(kept: np.ndarray) -> np.ndarray:
        target = jacobian[kept] @ truth + noise[kept]
        return np.linalg.lstsq(jacobian[kept], target, rcond=None)[0]

    row = least(np.ones(240, dtype=bool))
    residual = jacobian @ (row - truth) - noise
    fit = Fit(System([]), ["a", "b"], row, residual, jacobian, np.ones(2, dtype=bool))
    without = np.stack([least(sequence != k) for k in range(6)])
    spread = np.sqrt(5 / 6 * ((without - row) ** 2).sum(0))
    half = stats.t.ppf(0.975, 5) * spread
    np.testing.assert_allclose(
        fit.intervals(sequence), np.stack([row - half, row + half], 1), rtol=1e-9
    )


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
