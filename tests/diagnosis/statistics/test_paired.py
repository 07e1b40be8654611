"""Comparisons of models by cluster and the number of clusters that they need."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from nnode.diagnosis.residuals.comparison import Comparison
from nnode.diagnosis.statistics.paired import clusters_to_tell, compare, heldout, j_test
from tests.builders import regression


def comparison(mean: float, spread: float, clusters: int) -> Comparison:
    half = stats.t.ppf(0.975, clusters - 1) * spread / np.sqrt(clusters)
    return Comparison(mean, mean - half, mean + half, 0.2, clusters)


@pytest.mark.parametrize(("mean", "spread"), [(0.05, 0.2), (0.2, 0.3)])
@pytest.mark.parametrize("level", [0.05, 0.01])
def test_power_of_required_clusters(mean: float, spread: float, level: float) -> None:
    number = clusters_to_tell(comparison(mean, spread, 10), level)
    assert number is not None
    rng = np.random.default_rng(1)

    def power(clusters: int) -> float:
        sample = rng.normal(mean, spread, (4000, clusters))
        p = stats.ttest_1samp(sample, 0.0, axis=1, alternative="greater").pvalue
        return float((p <= level).mean())

    # 0.90 within four standard errors of 4,000 draws and one cluster more or less
    assert power(number) > 0.88
    assert power(round(0.8 * number)) < 0.88


@pytest.mark.parametrize(
    ("compared", "number"),
    [
        (comparison(-0.01, 0.1, 10), None),
        (compare(np.ones(1), np.zeros(1)), None),
        (compare(np.ones(6), np.ones(6)), None),
        (comparison(1.0, 0.1, 30), 30),  # at least the clusters that were not enough
    ],
)
def test_required_clusters(compared: Comparison, number: int | None) -> None:
    assert clusters_to_tell(compared, 0.05) == number


def test_gain_is_mean_over_clusters() -> None:
    compared = compare(np.array([2.0, 3.0, 4.0]), np.array([1.0, 3.0, 2.0]))
    assert compared.clusters == 3
    assert compared.gain == pytest.approx((0.5 + 0 + 0.5) / 3)


def test_one_cluster_cannot_decide_comparison() -> None:
    first, second = np.array([2.0, 2.0, 2.0, 1e9]), np.ones(4)
    forward, backward = compare(first, second), compare(second, first)
    assert forward.gain == pytest.approx((3 * 0.5 + 1) / 4)
    assert backward.gain == pytest.approx(-forward.gain)
    assert forward.p_value < 0.05 < backward.p_value


@pytest.mark.thorough
def test_level_and_power_of_j_test() -> None:
    """Neither of two regressions extends the other; the data follow the second."""
    rng = np.random.default_rng(5)
    cluster = np.repeat(np.arange(24), 20)
    rejected: dict[str, list[bool]] = {"true": [], "wrong": [], "costs": []}
    for _ in range(400):
        column = rng.normal(size=len(cluster))
        true_column = 0.8 * column + 0.6 * rng.normal(size=len(cluster))
        data = 0.25 * true_column + rng.normal(size=len(cluster))
        wrong, true = (regression(-c[:, None], data) for c in (column, true_column))
        rejected["wrong"].append(j_test(wrong, true, cluster).p_value <= 0.05)
        rejected["true"].append(j_test(true, wrong, cluster).p_value <= 0.05)
        costs = compare(heldout(wrong, cluster), heldout(true, cluster))
        rejected["costs"].append(costs.p_value <= 0.05)
    share = {name: float(np.mean(cases)) for name, cases in rejected.items()}
    assert share["true"] < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 400)
    # the standardized distance is twice that of a comparison of costs
    assert share["wrong"] > 0.85 > 0.6 > share["costs"]
