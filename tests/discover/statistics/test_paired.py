"""Held-out comparisons by cluster, and how many clusters would tell two models apart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from nnode.discover.residuals.comparison import Comparison
from nnode.discover.statistics.paired import clusters_to_tell, compare


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


def test_no_number_of_clusters_tells_what_is_no_better() -> None:
    assert clusters_to_tell(seen(-0.01, 0.1, 10), 0.05) is None
    assert clusters_to_tell(compare(np.ones(1), np.zeros(1)), 0.05) is None
    same = np.ones(6)
    assert clusters_to_tell(compare(same, same), 0.05) is None


def test_never_fewer_than_did_not_tell() -> None:
    assert clusters_to_tell(seen(1.0, 0.1, 30), 0.05) == 30


def test_a_comparison_knows_its_clusters() -> None:
    found = compare(np.array([2.0, 3.0, 4.0]), np.array([1.0, 3.0, 2.0]))
    assert found.clusters == 3
    assert found.gain == pytest.approx((0.5 + 0 + 0.5) / 3)
