"""Column selection by the regression baselines."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.discovery.regression import BASELINES, Library

CHOOSING = ["lasso", "lasso_bic", "ensemble_sindy"]
CROSS_VALIDATED = ["lasso", "ensemble_sindy"]


def choose(name: str, library: Library, seed: int = 0) -> np.ndarray:
    pytest.importorskip("pysindy" if name == "ensemble_sindy" else "sklearn")
    return BASELINES[name](library, seed)


def library(seed: int = 0) -> tuple[Library, np.ndarray]:
    """A library in which the base model and two of eight columns explain the target."""
    rng = np.random.default_rng(seed)
    columns, base = rng.normal(size=(2000, 8)), rng.normal(size=(2000, 2))
    columns[:, 7] = base @ [1.0, 2.0]  # collinear with the base model
    theta = np.array([0, 0.5, 0, 0, -0.3, 0, 0, 0])
    target = columns @ theta + base @ [3.0, -1.0] + 0.3 * rng.normal(size=2000)
    return Library(columns, target, base, np.repeat(np.arange(10), 200)), theta


@pytest.mark.parametrize("name", ["lasso_bic", "ensemble_sindy"])
def test_sparse_methods_select_the_true_columns(name):
    data, theta = library()
    estimate = choose(name, data)
    assert ((estimate != 0) == (theta != 0)).all()
    np.testing.assert_allclose(estimate, theta, atol=0.05)


def test_cross_validated_lasso_keeps_the_true_columns():
    data, theta = library()
    estimate = choose("lasso", data)
    assert (estimate[theta != 0] != 0).all()
    np.testing.assert_allclose(estimate, theta, atol=0.05)
    assert estimate[7] == 0


def test_recalibration_selects_nothing():
    assert not BASELINES["recalibration"](library()[0], 0).any()


@pytest.mark.parametrize("name", CHOOSING)
def test_selection_is_invariant_to_units_and_the_base_model(name):
    data, _ = library()
    units = np.geomspace(1e-3, 1e3, 8)
    shift = np.random.default_rng(1).normal(size=(2, 8))
    columns = (data.columns[:, :7] + data.base @ shift[:, :7]) * units[:7]
    target = 50 * (data.target + data.base @ [7.0, 7.0])
    other = Library(columns, target, data.base, data.cluster)
    np.testing.assert_allclose(
        choose(name, other) * units[:7] / 50, choose(name, data)[:7], rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("name", CHOOSING)
def test_duplicate_columns_share_the_coefficient(name):
    data, theta = library()
    columns = np.hstack([data.columns, data.columns])
    estimate = choose(name, Library(columns, data.target, data.base, data.cluster))
    np.testing.assert_allclose(estimate[:8] + estimate[8:], theta, atol=0.05)


def test_bic_rarely_selects_noise():
    selected = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        columns, target = rng.normal(size=(2000, 5)), rng.normal(size=2000)
        base = rng.normal(size=(2000, 1))
        noise = Library(columns, target, base, np.repeat(np.arange(10), 200))
        selected += bool(choose("lasso_bic", noise).any())
    # each of five columns is selected if z² exceeds log n, with a probability of 0.6 %
    assert selected <= 5


@pytest.mark.thorough
@pytest.mark.parametrize("name", CROSS_VALIDATED)
def test_cross_validation_splits_by_clusters(name):
    """Random cluster means are selected if the rows of a cluster are on both sides of a fold."""
    by_cluster = by_row = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        cluster = np.repeat(np.arange(10), 20)
        columns = rng.normal(size=(10, 2))[cluster]
        target = rng.normal(size=10)[cluster] + 0.1 * rng.normal(size=200)
        base = rng.normal(size=(200, 1))
        by_cluster += choose(name, Library(columns, target, base, cluster)).any()
        by_row += choose(name, Library(columns, target, base, np.arange(200))).any()
    assert by_row > 9
    assert by_cluster < 0.7 * by_row


def test_folds_share_no_clusters():
    pytest.importorskip("sklearn")
    data, _ = library()
    folds = data.folds(0)
    assert len(folds) == 5
    for fitted, predicted in folds:
        assert not set(data.cluster[fitted]) & set(data.cluster[predicted])
    assert sorted(np.concatenate([predicted for _, predicted in folds])) == list(range(2000))
    few = Library(data.columns, data.target, data.base, data.cluster % 3)
    assert len(few.folds(0)) == 3


def test_ensemble_depends_on_its_seed_only():
    data, _ = library()
    np.random.seed(5)
    expected = np.random.random(3)
    np.random.seed(5)
    first = choose("ensemble_sindy", data, 1)
    np.testing.assert_array_equal(np.random.random(3), expected)
    np.testing.assert_array_equal(choose("ensemble_sindy", data, 1), first)
    assert (choose("ensemble_sindy", data, 2) != first).any()
