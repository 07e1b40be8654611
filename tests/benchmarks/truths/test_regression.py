"""The peers choose columns as their definitions say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from benchmarks.truths.regression import PEERS, Library, lasso_path


def library(noise: float = 0.3, seed: int = 0) -> tuple[Library, np.ndarray]:
    """Two of eight columns explain the target, beside what the base model can do."""
    rng = np.random.default_rng(seed)
    columns, base = rng.normal(size=(2000, 8)), rng.normal(size=(2000, 2))
    columns[:, 7] = base @ [1.0, 2.0]  # not to be told from the base model
    theta = np.array([0, 0.5, 0, 0, -0.3, 0, 0, 0])
    target = columns @ theta + base @ [3.0, -1.0] + noise * rng.normal(size=2000)
    return Library(columns, target, base, np.repeat(np.arange(10), 200)), theta


@pytest.mark.parametrize("name", ["forward_bic", "ensemble_stlsq"])
def test_sparse_peers_find_the_columns_and_their_coefficients(name):
    some, theta = library()
    found = PEERS[name](some, 0)
    assert ((found != 0) == (theta != 0)).all()
    np.testing.assert_allclose(found, theta, atol=0.03)


@pytest.mark.parametrize("name", ["lasso", "ridge"])
def test_peers_that_keep_more_keep_what_is_there(name):
    some, theta = library()
    found = PEERS[name](some, 0)
    assert (found[theta != 0] != 0).all()
    np.testing.assert_allclose(found, theta, atol=0.05)
    assert found[7] == 0


def test_recalibration_names_nothing():
    assert not PEERS["recalibration"](library()[0], 0).any()


def test_forward_selection_takes_little_from_noise():
    taken = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        columns, target = rng.normal(size=(2000, 5)), rng.normal(size=2000)
        base = rng.normal(size=(2000, 1))
        empty = Library(columns, target, base, np.repeat(np.arange(10), 200))
        taken += bool(PEERS["forward_bic"](empty, 0).any())
    # each of five columns passes where its z² exceeds log n: with 0.6 %
    assert taken <= 5


def test_lasso_minimises_its_function():
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(50, 4)), rng.normal(size=50)
    x[:, 1] += x[:, 0]
    found = lasso_path(x.T @ x, x.T @ y, np.array([3.0]))[0]

    # split into positive and negative parts, the function is smooth
    def value(parts: np.ndarray) -> float:
        rest = y - x @ (parts[:4] - parts[4:])
        return 0.5 * float(rest @ rest) + 3.0 * float(parts.sum())

    best = minimize(value, np.full(8, 0.1), bounds=[(0, None)] * 8, options={"ftol": 1e-15})
    np.testing.assert_allclose(found, best.x[:4] - best.x[4:], atol=1e-4)


def test_weights_of_sequences_are_repetitions():
    some, _ = library()
    weight = np.array([2.0, 0, 1, 1, 1, 1, 1, 1, 1, 1])
    again = np.concatenate([np.flatnonzero(some.sequence == s) for s in (0, 0, *range(2, 10))])
    columns = some.columns / some.scale
    basis = np.linalg.svd(some.base, full_matrices=False)[0]
    columns = columns - basis @ (basis.T @ columns)
    gram = columns[again].T @ columns[again]
    np.testing.assert_allclose(some.sums(weight)[0][:7, :7], gram[:7, :7], atol=1e-8)
