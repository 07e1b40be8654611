"""Bootstrap intervals and tests on data with known means."""

from __future__ import annotations

import numpy as np
import pytest

from nnode.calibrate import resampling
from nnode.calibrate.resampling import average_interval, group_weights, holm, paired


@pytest.fixture
def few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer draws, enough for frequencies over hundreds of data sets."""
    monkeypatch.setattr(resampling, "DRAWS", 500)


def clustered(
    rng: np.random.Generator, groups: int = 30, size: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Values of mean 0 whose variance is mostly common to a group."""
    group = np.repeat(np.arange(groups), size)
    values = rng.standard_normal(groups)[group] + 0.3 * rng.standard_normal(groups * size)
    return values, group


def test_weights_are_equal_within_groups() -> None:
    group = np.array([0, 0, 1, 2, 2, 2])
    weights = group_weights(group, 50, np.random.default_rng(0))
    assert weights.shape == (50, 6)
    np.testing.assert_allclose(weights.sum(1), 1)
    for members in ([0, 1], [3, 4, 5]):
        assert (np.ptp(weights[:, members], axis=1) == 0).all()


@pytest.mark.usefixtures("few_draws")
def test_coverage_of_intervals() -> None:
    rng = np.random.default_rng(3)
    covered = naive = 0
    for seed in range(200):
        values, group = clustered(rng)
        low, high = average_interval([values], [group], seed)
        covered += low <= 0 <= high
        if seed < 80:
            low, high = average_interval([values], [np.arange(len(values))], seed)
            naive += low <= 0 <= high
    assert 0.89 <= covered / 200 <= 0.99
    assert naive / 80 < 0.8  # without regard to groups


def test_paired_differences() -> None:
    rng = np.random.default_rng(5)
    values, group = clustered(rng)
    comparison = paired(values, values + 1.0, group, 0)
    assert comparison.difference == pytest.approx(-1.0)
    assert comparison.better == 1.0
    assert comparison.p < 0.001
    assert comparison.low == pytest.approx(-1.0)


@pytest.mark.usefixtures("few_draws")
def test_false_positive_rate() -> None:
    rng = np.random.default_rng(6)
    significant = []
    for seed in range(200):
        values, group = clustered(rng)
        significant.append(paired(values, np.zeros_like(values), group, seed).p < 0.05)
    assert 0.01 <= np.mean(significant) <= 0.10


def test_holm() -> None:
    # by hand: 3 x 0.01, then max(0.03, 2 x 0.03), then max(0.06, 0.04)
    assert holm({"a": 0.01, "b": 0.04, "c": 0.03}) == pytest.approx(
        {"a": 0.03, "b": 0.06, "c": 0.06}
    )
