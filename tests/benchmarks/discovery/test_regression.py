"""Each baseline chooses the right columns from the data that it is given."""

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
    """Two of eight columns explain the target, beside what the base model can do."""
    rng = np.random.default_rng(seed)
    columns, base = rng.normal(size=(2000, 8)), rng.normal(size=(2000, 2))
    columns[:, 7] = base @ [1.0, 2.0]  # not to be told from the base model
    theta = np.array([0, 0.5, 0, 0, -0.3, 0, 0, 0])
    target = columns @ theta + base @ [3.0, -1.0] + 0.3 * rng.normal(size=2000)
    return Library(columns, target, base, np.repeat(np.arange(10), 200)), theta


@pytest.mark.parametrize("name", ["lasso_bic", "ensemble_sindy"])
def test_sparse_methods_find_the_columns_and_no_other(name):
    some, theta = library()
    found = choose(name, some)
    assert ((found != 0) == (theta != 0)).all()
    np.testing.assert_allclose(found, theta, atol=0.05)


def test_cross_validated_lasso_keeps_what_is_there():
    some, theta = library()
    found = choose("lasso", some)
    assert (found[theta != 0] != 0).all()
    np.testing.assert_allclose(found, theta, atol=0.05)
    assert found[7] == 0


def test_recalibration_names_nothing():
    assert not BASELINES["recalibration"](library()[0], 0).any()


@pytest.mark.parametrize("name", CHOOSING)
def test_units_and_the_base_model_do_not_matter(name):
    some, _ = library()
    units = np.geomspace(1e-3, 1e3, 8)
    shift = np.random.default_rng(1).normal(size=(2, 8))
    columns = (some.columns[:, :7] + some.base @ shift[:, :7]) * units[:7]
    target = 50 * (some.target + some.base @ [7.0, 7.0])
    other = Library(columns, target, some.base, some.cluster)
    np.testing.assert_allclose(
        choose(name, other) * units[:7] / 50, choose(name, some)[:7], rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("name", CHOOSING)
def test_a_column_that_is_there_twice_is_found(name):
    some, theta = library()
    twice = np.hstack([some.columns, some.columns])
    found = choose(name, Library(twice, some.target, some.base, some.cluster))
    np.testing.assert_allclose(found[:8] + found[8:], theta, atol=0.05)


def test_bic_takes_little_from_noise():
    taken = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        columns, target = rng.normal(size=(2000, 5)), rng.normal(size=2000)
        base = rng.normal(size=(2000, 1))
        empty = Library(columns, target, base, np.repeat(np.arange(10), 200))
        taken += bool(choose("lasso_bic", empty).any())
    # each of five columns passes where its z² exceeds log n: with 0.6 %
    assert taken <= 5


@pytest.mark.thorough
@pytest.mark.parametrize("name", CROSS_VALIDATED)
def test_clusters_are_predicted_as_a_whole(name):
    """What clusters have by chance is learnt where their rows are on both sides of a fold."""
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


def test_a_fold_predicts_clusters_that_it_was_not_fitted_to():
    pytest.importorskip("sklearn")
    some, _ = library()
    folds = some.folds(0)
    assert len(folds) == 5
    for fitted, predicted in folds:
        assert not set(some.cluster[fitted]) & set(some.cluster[predicted])
    assert sorted(np.concatenate([predicted for _, predicted in folds])) == list(range(2000))
    few = Library(some.columns, some.target, some.base, some.cluster % 3)
    assert len(few.folds(0)) == 3


def test_the_ensemble_follows_its_seed_and_leaves_numpys_alone():
    some, _ = library()
    np.random.seed(5)
    expected = np.random.random(3)
    np.random.seed(5)
    first = choose("ensemble_sindy", some, 1)
    np.testing.assert_array_equal(np.random.random(3), expected)
    np.testing.assert_array_equal(choose("ensemble_sindy", some, 1), first)
    assert (choose("ensemble_sindy", some, 2) != first).any()
