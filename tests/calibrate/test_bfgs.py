"""Projected BFGS against minima that are known, and against SciPy's L-BFGS-B."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.optimize
import torch
from torch import Tensor

from nnode.calibrate.bfgs import minimise, optimality_residual

FREE = torch.full((2,), math.inf, dtype=torch.float64)


def rosenbrock(x: Tensor) -> tuple[Tensor, Tensor]:
    x = x.clone().requires_grad_()
    cost = 100 * (x[:, 1] - x[:, 0] ** 2) ** 2 + (1 - x[:, 0]) ** 2
    (gradient,) = torch.autograd.grad(cost.sum(), x)
    return cost.detach(), gradient


def starts(number: int, size: int, spread: float = 2.0) -> Tensor:
    draw = torch.Generator().manual_seed(4)
    return spread * torch.randn(number, size, generator=draw, dtype=torch.float64)


def test_all_runs_find_the_minimum_of_a_curved_valley() -> None:
    found = minimise(rosenbrock, starts(12, 2), -FREE, FREE, iterations=200, tolerance=1e-14)
    torch.testing.assert_close(
        found.rows, torch.ones(12, 2, dtype=torch.float64), atol=1e-5, rtol=0
    )
    assert found.evaluations < 201  # it noticed


def test_within_a_box_as_scipy() -> None:
    rng = np.random.default_rng(1)
    root = rng.standard_normal((6, 6))
    matrix = torch.from_numpy(root @ root.T + 0.1 * np.eye(6))
    target = torch.from_numpy(3 * rng.standard_normal((5, 6)))
    low, high = -torch.ones(6, dtype=torch.float64), torch.ones(6, dtype=torch.float64)

    def cost(x: Tensor) -> tuple[Tensor, Tensor]:
        away = x - target
        return 0.5 * torch.einsum("ri,ij,rj->r", away, matrix, away) + 1.0, away @ matrix

    found = minimise(cost, torch.zeros(5, 6, dtype=torch.float64), low, high, tolerance=1e-14)
    for r in range(5):
        away = target[r].numpy()

        def one(x: np.ndarray, away: np.ndarray = away) -> tuple[float, np.ndarray]:
            slope = matrix.numpy() @ (x - away)
            return 0.5 * float((x - away) @ slope) + 1.0, slope

        best = scipy.optimize.minimize(
            one,
            np.zeros(6),
            jac=True,
            method="L-BFGS-B",
            bounds=[(-1, 1)] * 6,
            options={"ftol": 1e-15, "gtol": 1e-10},
        )
        assert found.costs[r] == pytest.approx(best.fun, rel=1e-8)
        np.testing.assert_allclose(found.rows[r], best.x, atol=1e-4)
    residual = optimality_residual(found.rows, found.costs, found.gradients, low, high)
    assert (residual < 1e-5).all()
    inside = optimality_residual(*(found.rows * 0, *cost(found.rows * 0)), low, high)
    assert (inside > 1e-2).all()


def test_runs_do_not_disturb_each_other() -> None:
    rows = starts(3, 2)
    together = minimise(rosenbrock, rows, -FREE, FREE, iterations=30)
    for r in range(3):
        alone = minimise(rosenbrock, rows[r : r + 1], -FREE, FREE, iterations=30)
        torch.testing.assert_close(alone.rows[0], together.rows[r], rtol=1e-9, atol=1e-12)


def test_points_without_a_cost_are_refused() -> None:
    def barrier(x: Tensor) -> tuple[Tensor, Tensor]:
        cost = x[:, 0] - torch.log(x[:, 0])  # not a number below 0, least at 1
        return cost, (1 - 1 / x[:, 0])[:, None]

    rows = torch.tensor([[5.0], [0.01], [-1.0]], dtype=torch.float64)
    found = minimise(barrier, rows, -FREE[:1], FREE[:1], tolerance=1e-15)
    torch.testing.assert_close(
        found.rows[:2, 0], torch.ones(2, dtype=torch.float64), atol=1e-6, rtol=0
    )
    assert math.isinf(found.costs[2])
    assert found.best in (0, 1)


def test_a_known_curvature_saves_evaluations() -> None:
    scale = torch.tensor([1.0, 1e4], dtype=torch.float64)

    def cost(x: Tensor) -> tuple[Tensor, Tensor]:
        return 0.5 * (scale * x**2).sum(1), scale * x

    start = torch.ones(1, 2, dtype=torch.float64)
    blind = minimise(cost, start, -FREE, FREE, iterations=4)
    told = minimise(cost, start, -FREE, FREE, iterations=4, inverse=torch.diag(1 / scale))
    assert told.costs[0] < 1e-20 < blind.costs[0]
