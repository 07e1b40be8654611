"""Cluster-robust standard errors against clubSandwich, and unidentified parameters."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nnode.calibrate.intervals import ClusterInfluence

STORED = json.loads(Path(__file__).with_name("club_sandwich.json").read_text())["cases"]


def of_regression(x: np.ndarray, y: np.ndarray, cluster: np.ndarray) -> ClusterInfluence:
    residual = x @ np.linalg.lstsq(x, y, rcond=None)[0] - y
    parts = [(x[cluster == g], residual[cluster == g]) for g in np.unique(cluster)]
    return ClusterInfluence(
        np.stack([part.T @ part for part, _ in parts]), np.stack([part.T @ r for part, r in parts])
    )


@pytest.mark.parametrize("case", STORED)
def test_covariances_and_degrees_of_freedom_as_club_sandwich(case: str) -> None:
    stored = STORED[case]
    data = {name: np.array(values) for name, values in stored["data"].items()}
    columns = [data[name] for name in ("x1", "x2") if name in data]
    x = np.stack([np.ones(len(data["y"])), *columns], 1)
    result = of_regression(x, data["y"], data["cluster"])
    np.testing.assert_allclose(result.covariance(), stored["covariance"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(result.degrees(), stored["df"], rtol=1e-9)


def test_cluster_influence_is_leave_one_out() -> None:
    rng = np.random.default_rng(3)
    x, y, cluster = rng.normal(size=(60, 3)), rng.normal(size=60), np.repeat(np.arange(6), 10)
    estimate = np.linalg.lstsq(x, y, rcond=None)[0]
    influence = of_regression(x, y, cluster).moved(1.0)
    for g in range(6):
        kept = cluster != g
        expected = np.linalg.lstsq(x[kept], y[kept], rcond=None)[0] - estimate
        np.testing.assert_allclose(influence[g], expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("case", "unidentified"),
    [("collinear", [True, True, False]), ("one cluster", [False, True, False])],
)
def test_unidentified_parameters_have_infinite_intervals(
    case: str, unidentified: list[bool]
) -> None:
    rng = np.random.default_rng(5)
    x, y, cluster = rng.normal(size=(50, 3)), rng.normal(size=50), np.repeat(np.arange(5), 10)
    if case == "collinear":
        x[:, 1] = x[:, 0]
    else:
        x[cluster != 2, 1] = 0.0
    result = of_regression(x, y, cluster)
    assert np.isinf(result.half_widths()).tolist() == unidentified
    assert result.flat.tolist() == (unidentified if case == "collinear" else [False] * 3)


@pytest.mark.thorough
@pytest.mark.parametrize("clusters", [4, 8, 20])
def test_coverage_with_few_clusters(clusters: int) -> None:
    """Regressors and errors are correlated within clusters."""
    rng, inside = np.random.default_rng(clusters), []
    for _ in range(1500):
        cluster = np.repeat(np.arange(clusters), rng.integers(3, 12, clusters))
        x = np.stack([np.ones(len(cluster)), rng.normal(size=len(cluster))], 1)
        x[:, 1] += rng.normal(size=clusters)[cluster]
        y = rng.normal(size=len(cluster)) + 0.3 * rng.normal(size=clusters)[cluster]
        half = of_regression(x, y, cluster).half_widths()
        inside.append(np.abs(np.linalg.lstsq(x, y, rcond=None)[0]) < half)
    share = np.mean(inside, 0)
    assert (share > 0.93).all(), share
    assert (share < 0.985).all(), share
