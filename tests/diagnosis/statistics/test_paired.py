"""Held-out comparisons by cluster, and how many clusters would tell two models apart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from nnode.diagnosis.residuals.comparison import Comparison
from nnode.diagnosis.residuals.fit import Fit
from nnode.diagnosis.statistics.paired import clusters_to_tell, compare, heldout, j_test
from tests.builders import regression


def seen(mean: float, spread: float, clusters: int) -> Comparison:
    half = stats.t.ppf(0.975, clusters - 1) * spread / np.sqrt(clusters)
    return Comparison(mean, mean - half, mean + half, 0.2, clusters)


@pytest.mark.parametrize(("mean", "spread"), [(0.05, 0.2), (0.2, 0.3)])
@pytest.mark.parametrize("level", [0.05, 0.01])
def test_so_many_clusters_tell_with_nine_in_ten(mean: float, spread: float, level: float) -> None:
    number = clusters_to_tell(seen(mean, spread, 10), level)
    assert number is not None
    rng = np.random.default_rng(1)

    def found(clusters: int) -> float:
        drawn = rng.normal(mean, spread, (4000, clusters))
        p = stats.ttest_1samp(drawn, 0.0, axis=1, alternative="greater").pvalue
        return float((p <= level).mean())

    # 0.90 within four standard errors of 4,000 draws and one cluster more or less
    assert found(number) > 0.88
    assert found(round(0.8 * number)) < 0.88


ALIKE = np.ones(6)


@pytest.mark.parametrize(
    ("comparison", "number"),
    [
        (seen(-0.01, 0.1, 10), None),
        (compare(np.ones(1), np.zeros(1)), None),
        (compare(ALIKE, ALIKE), None),
        (seen(1.0, 0.1, 30), 30),  # never fewer than did not tell
    ],
)
def test_the_number_of_clusters_that_tell(comparison: Comparison, number: int | None) -> None:
    assert clusters_to_tell(comparison, 0.05) == number


def test_a_comparison_knows_its_clusters() -> None:
    found = compare(np.array([2.0, 3.0, 4.0]), np.array([1.0, 3.0, 2.0]))
    assert found.clusters == 3
    assert found.gain == pytest.approx((0.5 + 0 + 0.5) / 3)


def test_one_cluster_cannot_decide_a_comparison() -> None:
    first, second = np.array([2.0, 2.0, 2.0, 1e9]), np.ones(4)
    found = compare(first, second)
    assert found.gain == pytest.approx((3 * 0.5 + 1) / 4)
    assert compare(second, first).gain == pytest.approx(-found.gain)
    assert found.p_value < 0.05 < compare(second, first).p_value


def rivals(rng: np.random.Generator, true: int, clusters: int = 24) -> list[Fit]:
    """Two regressions, neither of which extends the other, on data that one of them made."""
    cluster = np.repeat(np.arange(clusters), 20)
    first = rng.normal(size=len(cluster))
    columns = [first, 0.8 * first + 0.6 * rng.normal(size=len(cluster))]
    made = 0.25 * columns[true] + rng.normal(size=len(cluster))
    return [regression(-one[:, None], made) for one in columns]


@pytest.mark.thorough
def test_a_wrong_rival_is_outdone_and_a_true_one_is_not() -> None:
    rng = np.random.default_rng(5)
    cluster = np.repeat(np.arange(24), 20)
    rejected: dict[str, list[bool]] = {"true": [], "wrong": [], "costs": []}
    for _ in range(400):
        one, other = rivals(rng, true=1)
        rejected["wrong"].append(j_test(one, other, cluster).p_value <= 0.05)
        rejected["true"].append(j_test(other, one, cluster).p_value <= 0.05)
        costs = compare(heldout(one, cluster), heldout(other, cluster))
        rejected["costs"].append(costs.p_value <= 0.05)
    share = {name: float(np.mean(one)) for name, one in rejected.items()}
    assert share["true"] < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 400)
    # twice the standardized distance of a comparison of costs
    assert share["wrong"] > 0.85 > 0.6 > share["costs"]
