"""Damped least squares for problems with known solutions."""

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
    """The minima of several problems.

    Args:
        problems: functions of ``(P,)`` parameters that return residuals and their derivatives.
    """

    def quadratic(rows: np.ndarray) -> Quadratic:
        parts = [problem(row) for problem, row in zip(problems, rows, strict=True)]
        return Quadratic(
            np.array([r @ r for r, _ in parts]),
            np.stack([2 * x.T @ r for r, x in parts]),
            np.stack([2 * x.T @ x for _, x in parts]),
        )

    def costs(trials: np.ndarray) -> np.ndarray:
        residuals = np.array(
            [
                [problem(row)[0] for problem, row in zip(problems, rows, strict=True)]
                for rows in trials
            ]
        )
        return np.nan_to_num((residuals**2).sum(-1), nan=np.inf)

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
    """NaN above 3.5."""
    value = np.exp(row) if row[0] <= 3.5 else np.array([np.nan])
    return value - 20.0, value[:, None]


@pytest.mark.parametrize("dampings", [(), (1e-6, 1e-2, 1.0, 30.0)])
def test_rosenbrock_minimum(dampings: tuple[float, ...]) -> None:
    minimum = solved([rosenbrock(2.0)], np.array([[-1.2, 1.0]]), dampings=dampings)
    assert minimum.row[0] == pytest.approx([1.0, 1.0], abs=1e-6)
    assert minimum.before == pytest.approx([5.6144])


def test_joint_problems_have_their_separate_minima() -> None:
    problems = [rosenbrock(scale) for scale in (1.0, 10.0, 30.0)]
    starts = np.array([[-1.2, 1.0], [3.0, -2.0], [0.0, 5.0]])
    together = solved(problems, starts)
    for b, problem in enumerate(problems):
        alone = solved([problem], starts[[b]])
        assert together.row[b] == pytest.approx(alone.row[0], abs=1e-6)
        assert together.steps >= alone.steps


@pytest.mark.parametrize("seed", range(5))
def test_bounded_linear_problem_as_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix, target = rng.normal(size=(30, 6)), rng.normal(size=30)
    expected = lsq_linear(matrix, target, (-0.05, 0.08), tol=1e-14)
    minimum = solved([linear(matrix, target)], np.full((1, 6), 0.01), -0.05, 0.08)
    assert (expected.active_mask != 0).any()
    assert minimum.cost[0] == pytest.approx(2 * expected.cost, rel=1e-8)
    assert minimum.row[0] == pytest.approx(expected.x, abs=1e-5)


def test_penalty_equals_additional_rows() -> None:
    rng = np.random.default_rng(7)
    matrix, target = rng.normal(size=(30, 4)), rng.normal(size=30)
    centre, weight = rng.normal(size=4), rng.uniform(1, 9, 4)
    minimum = solved([linear(matrix, target)], np.zeros((1, 4)), penalty=(centre, weight))
    rows = np.concatenate([matrix, np.diag(np.sqrt(weight))])
    targets = np.concatenate([target, np.sqrt(weight) * centre])
    row, cost, *_ = np.linalg.lstsq(rows, targets, rcond=None)
    assert minimum.row[0] == pytest.approx(row, abs=1e-9)
    assert minimum.cost[0] == pytest.approx(float(cost[0]), rel=1e-12)


def test_points_without_finite_cost_are_avoided() -> None:
    minimum = solved([exponential], np.zeros((1, 1)))
    assert minimum.row[0, 0] == pytest.approx(np.log(20.0), rel=1e-9)


def test_hopeless_search_stops_early() -> None:
    start, options = np.array([[-1.2, 1.0]]), {"dampings": (30.0,)}
    full = solved([rosenbrock(10.0)], start, **options)
    early = solved([rosenbrock(10.0)], start, hopeless=1e-3, **options)
    assert early.steps < full.steps
    assert early.cost[0] > 1e-3


def test_profile_minimises_over_the_other_parameters() -> None:
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
