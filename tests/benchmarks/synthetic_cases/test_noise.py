"""Ornstein-Uhlenbeck noise."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.synthetic_cases.noise import ornstein_uhlenbeck


@pytest.mark.parametrize("heavy", [False, True])
def test_variance_and_autocorrelation(heavy):
    rng = np.random.default_rng(1)
    paths = ornstein_uhlenbeck(rng, (20_000, 41), step=0.1, correlation=2.0, heavy_tails=heavy)
    # the variance of t-distributed kicks is itself uncertain: their fourth moment is infinite
    assert paths.var(0) == pytest.approx(1.0, abs=0.25 if heavy else 0.06)
    correlation = (paths[:, 0] * paths[:, 20]).mean() / paths.var()
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.05)


def test_correlation_time_of_each_path():
    rng = np.random.default_rng(2)
    tau = np.array([0.5, 4.0])
    paths = ornstein_uhlenbeck(rng, (2, 200_000), step=0.1, correlation=tau)
    correlation = (paths[:, 5:] * paths[:, :-5]).mean(1)
    np.testing.assert_allclose(correlation, np.exp(-0.5 / tau), atol=0.05)


def test_heavy_tails_are_heavier():
    kicks = {}
    for heavy in (False, True):
        rng = np.random.default_rng(3)
        path = ornstein_uhlenbeck(rng, (1, 100_000), step=1.0, correlation=0.1, heavy_tails=heavy)
        kicks[heavy] = (np.abs(path) > 4).mean()
    assert kicks[True] > 20 * kicks[False]
