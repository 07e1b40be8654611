"""Damped least squares against problems with known solutions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from nnode.calibrate.least_squares import Minimum, Quadratic, least_squares

Residuals = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def solved(
    problems: list[Residuals],
    start: np.ndarray,
    low: Any = -np.inf,
    high: Any = np.inf,
    **options: Any,
) -> Minimum:
    """The minima of problems side by side, each a function of ``(P,)`` parameters to residuals
    and their derivatives."""

    def quadratic(rows: np.ndarray) -> Quadratic:
        parts = [problem(row) for problem, row in zip(problems, rows, strict=True)]
        return Quadratic(
            np.array([r @ r for r, _ in parts]),
            np.stack([2 * x.T @ r for r, x in parts]),
            np.stack([2 * x.T @ x for _, x in parts]),
        )

    def costs(trials: np.ndarray) -> np.ndarray:
        found = [
            [r @ r for r in (problem(row)[0] for problem, row in zip(problems, rows, strict=True))]
            for rows in trials
        ]
        return np.nan_to_num(np.array(found), nan=np.inf)

    box = (np.full(start.shape[1], end) for end in (low, high))
    return least_squares(quadratic, costs, start, *box, **options)


def rosenbrock(scale: float) -> Residuals:
    def residuals(row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = row
        return (
            np.array([scale * (y - x**2), 1 - x]),
            np.array([[-2 * scale * x, scale], [-1.0, 0.0]]),
        )

    return residuals


def linear(matrix: np.ndarray, target: np.ndarray) -> Residuals:
    return lambda row: (matrix @ row - target, matrix)


def exponential(row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Blows up above 3.5."""
    value = np.exp(row) if row[0] <= 3.5 else np.array([np.nan])
    return value - 20.0, value[:, None]


@pytest.mark.parametrize("dampings", [(), (1e-6, 1e-2, 1.0, 30.0)])
def test_rosenbrock_s_valley_is_followed_to_its_end(dampings: tuple[float, ...]) -> None:
    found = solved([rosenbrock(2.0)], np.array([[-1.2, 1.0]]), dampings=dampings)
    assert found.row[0] == pytest.approx([1.0, 1.0], abs=1e-6)
    assert found.before == pytest.approx([5.6144])


def test_problems_side_by_side_end_where_each_ends_alone() -> None:
    problems = [rosenbrock(scale) for scale in (1.0, 10.0, 30.0)]
    starts = np.array([[-1.2, 1.0], [3.0, -2.0], [0.0, 5.0]])
    together = solved(problems, starts)
    for b, problem in enumerate(problems):
        alone = solved([problem], starts[[b]])
        assert together.row[b] == pytest.approx(alone.row[0], abs=1e-6)
        assert together.steps >= alone.steps


@pytest.mark.parametrize("seed", range(5))
def test_bounds_of_a_linear_problem_are_obeyed_as_scipy_obeys_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix, target = rng.normal(size=(30, 6)), rng.normal(size=30)
    known = lsq_linear(matrix, target, (-0.05, 0.08), tol=1e-14)
    found = solved([linear(matrix, target)], np.full((1, 6), 0.01), -0.05, 0.08)
    assert (known.active_mask != 0).any()
    assert found.cost[0] == pytest.approx(2 * known.cost, rel=1e-8)
    assert found.row[0] == pytest.approx(known.x, abs=1e-5)


def test_a_penalty_is_that_of_further_rows() -> None:
    rng = np.random.default_rng(7)
    matrix, target = rng.normal(size=(30, 4)), rng.normal(size=30)
    centre, weight = rng.normal(size=4), rng.uniform(1, 9, 4)
    found = solved([linear(matrix, target)], np.zeros((1, 4)), penalty=(centre, weight))
    rows = np.concatenate([matrix, np.diag(np.sqrt(weight))])
    known = np.linalg.lstsq(rows, np.concatenate([target, np.sqrt(weight) * centre]), rcond=None)
    assert found.row[0] == pytest.approx(known[0], abs=1e-9)
    assert found.cost[0] == pytest.approx(float(known[1][0]), rel=1e-12)


def test_points_that_cannot_be_simulated_are_stepped_around() -> None:
    found = solved([exponential], np.zeros((1, 1)))
    assert found.row[0, 0] == pytest.approx(np.log(20.0), rel=1e-9)


def test_a_search_without_hope_ends_early() -> None:
    start, options = np.array([[-1.2, 1.0]]), {"dampings": (30.0,)}
    whole = solved([rosenbrock(10.0)], start, **options)
    early = solved([rosenbrock(10.0)], start, hopeless=1e-3, **options)
    assert early.steps < whole.steps
    assert early.cost[0] > 1e-3


def test_a_profile_is_the_cost_with_the_others_at_their_best() -> None:
    rng = np.random.default_rng(3)
    matrix, target = rng.normal(size=(20, 5)), rng.normal(size=20)
    residual, matrix = linear(matrix, target)(np.zeros(5))
    model = Quadratic(
        np.array([residual @ residual]),
        2 * (matrix.T @ residual)[None],
        2 * (matrix.T @ matrix)[None],
    ).profiled(2)
    step = -np.linalg.solve(model.hessian[0], model.gradient[0])
    assert step == pytest.approx(np.linalg.lstsq(matrix, target, rcond=None)[0][:2], rel=1e-9)
