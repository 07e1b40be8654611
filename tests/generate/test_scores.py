"""Scores agree with closed forms; bands cover samples at their level."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import norm

from nnode.errors import ConfigError
from nnode.generate.scores import Scores, band, crps, mean_of, nearest


@pytest.mark.parametrize("value", [-1.3, 0.4, 2.5])
def test_crps_of_a_gaussian_has_the_closed_form(value: float) -> None:
    mean, sigma, repeats = 0.4, 1.7, 40_000
    samples = np.random.default_rng(3).normal(mean, sigma, (5, repeats))
    result = crps(samples, np.full(repeats, value))
    z = (value - mean) / sigma
    # Gneiting & Raftery 2007, equation (5), with the opposite sign
    closed = sigma * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / math.sqrt(math.pi))
    # the estimate is unbiased for five samples
    assert abs(result.mean() - closed) < 4 * result.std() / math.sqrt(repeats)


def test_crps_equals_the_double_sum_over_pairs() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(7, 3)), rng.normal(size=3)
    pairs = sum(abs(x[i] - x[j]) for i in range(7) for j in range(7)) / (7 * 6)
    np.testing.assert_allclose(crps(x, y), abs(x - y).mean(0) - pairs / 2)


def test_crps_of_one_sample_is_refused() -> None:
    with pytest.raises(ConfigError, match="at least 2"):
        crps(np.zeros((1, 3)), np.zeros(3))


@pytest.mark.parametrize(("level", "number"), [(0.5, 39), (0.95, 39), (0.95, 99)])
def test_bands_cover_at_their_level(level: float, number: int) -> None:
    repeats = 20_000
    samples = np.random.default_rng(1).exponential(size=(number + 1, repeats))
    low, high = band(samples[1:], level)
    covered = ((low <= samples[0]) & (samples[0] <= high)).sum()
    assert abs(covered - level * repeats) < 4 * math.sqrt(repeats * level * (1 - level))


def test_intervals_of_means_are_clustered() -> None:
    rng = np.random.default_rng(0)
    individual = rng.normal(size=40).repeat(25)
    label = np.arange(40).repeat(25)
    result = mean_of(individual, np.ones(1000), label)
    assert result.low is not None
    assert result.high is not None
    spread = (result.high - result.low) / (2 * 1.96)
    assert spread == pytest.approx(np.unique(individual).std() / math.sqrt(40), rel=0.1)
    assert mean_of(individual, np.ones(1000), np.zeros(1000, int)).low is None


def test_scores_of_known_samples() -> None:
    measured = np.stack([np.arange(4.0), np.arange(4.0) + 10], 1)
    samples = np.broadcast_to(measured + np.array([2.0, 0.0]), (39, 4, 2))
    scores = Scores(5.0)
    scores.add("a", samples[..., None], measured[..., None], np.zeros((39, 4, 2, 1)))
    means = scores.means(np.zeros(1, int))
    assert means["crps_position_m"].mean == pytest.approx(2.0)
    assert means["crps_gap_m"].mean == pytest.approx(2.0)
    assert means["crps_position_m@10s"].mean == pytest.approx(2.0)
    assert means["coverage_position_95"].mean == 0.0
    # after the end of the sequence
    assert "crps_position_m@20s" not in means


def test_scores_of_people() -> None:
    measured = np.zeros((4, 3, 2))
    measured[:, 1] = (3.0, 4.0)
    measured[:, 2] = (3.0, 5.0)
    # the first person is displaced by 1 m in one component
    displacement = np.zeros((39, 4, 3, 2))
    displacement[:, :, 0, 0] = 1.0
    scores = Scores(1.0)
    scores.add("a", measured + displacement, measured, np.zeros_like(displacement))
    means = scores.means(np.zeros(1, int))
    assert means["crps_position_m"].mean == pytest.approx(1 / 6)
    # one of three people has another distance to the nearest neighbour
    assert means["crps_nearest_m"].mean == pytest.approx((5 - np.hypot(2, 4)) / 3)
    assert means["coverage_position_95"].mean == pytest.approx(5 / 6)
    assert "crps_gap_m" not in means


def test_distance_to_the_nearest_neighbour() -> None:
    x = np.array([[[0.0, 0.0], [3.0, 4.0], [0.0, 1.0]]])
    np.testing.assert_allclose(nearest(x), [[1.0, np.hypot(3, 3), 1.0]])
    assert nearest(x[:, :1]).shape == (1, 0)
