"""Standardised sums over clusters under sign flips."""

from __future__ import annotations

import numpy as np
import pytest

from nnode.diagnosis.statistics.standard import cluster_variance_of, joint, standardised


def scores(
    rng: np.random.Generator, clusters: int, columns: int, amount: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Scores ``(G, k)`` and information ``(G, k, k)`` of clusters of 20 residuals of variance 4.

    Args:
        amount: of every column, in the residuals.
    """
    x = rng.normal(size=(clusters, 20, columns))
    residual = 2.0 * rng.normal(size=(clusters, 20)) + amount * x.sum(2)
    return np.einsum("gnk,gn->gk", x, residual), x.transpose(0, 2, 1) @ x


def flips(rng: np.random.Generator, number: int, clusters: int) -> np.ndarray:
    return rng.choice([-1.0, 1.0], (number, clusters))


@pytest.mark.parametrize("columns", [1, 3])
def test_statistics_under_flips_are_normal(columns: int) -> None:
    rng = np.random.default_rng(columns)
    draws = [scores(rng, 60, columns) for _ in range(5)]
    values = np.concatenate([joint(*draw, flips(rng, 8000, 60), 4.0) for draw in draws])
    assert (values >= 0).all()
    # 0.317, 0.046 and 0.0124 of a standard normal variable are beyond 1, 2 and 2.5
    assert 0.30 < (values > 1).mean() < 0.34
    assert 0.04 < (values > 2).mean() < 0.055
    assert 0.009 < (values > 2.5).mean() < 0.017


def test_columns_are_standardised_separately() -> None:
    rng = np.random.default_rng(0)
    parts, information = scores(rng, 30, 2)
    sizes, signs = np.einsum("gkk->gk", information), flips(rng, 50, 30)
    variance = cluster_variance_of(parts, sizes, 4.0)
    standard = standardised(parts, sizes, signs, variance)
    for k in range(2):
        alone = standardised(parts[:, k : k + 1], sizes[:, k : k + 1], signs, variance)
        np.testing.assert_allclose(standard[:, k : k + 1], alone)
    assert not standardised(parts, np.zeros_like(sizes), signs, variance).any()
    first_only = np.array([1.0, 0.0])
    half_empty = standardised(parts * first_only, sizes * first_only, signs, variance)
    np.testing.assert_allclose(half_empty, standard * first_only)


@pytest.mark.parametrize("columns", [1, 3])
def test_effect_does_not_increase_its_standard_error(columns: int) -> None:
    """Otherwise no sum of thirty clusters could exceed 4.8."""
    rng = np.random.default_rng(1)
    parts, information = scores(rng, 30, columns, amount=20.0)
    all_positive = np.ones((1, 30))
    value = joint(parts, information, all_positive, 4.0)[0]
    assert value > 5.3
    halved = joint(parts / 2, information, all_positive, 1.0)[0]
    assert halved == pytest.approx(value, rel=1e-6)


def test_cluster_variance_is_robust_to_clusters_with_effect() -> None:
    rng = np.random.default_rng(2)
    sizes = rng.uniform(5, 50, 4001)
    parts = np.sqrt(sizes) * rng.normal(0.0, 3.0, 4001)
    parts[::5] *= 100
    assert cluster_variance_of(parts, sizes, 1.0) == pytest.approx(9.0, rel=0.75)
    assert cluster_variance_of(parts, sizes, 30.0) == 30.0
    assert cluster_variance_of(parts, np.zeros(4001), 2.0) == 2.0
