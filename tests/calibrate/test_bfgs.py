"""Projected BFGS against analytic minima and SciPy's L-BFGS-B."""

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


def starts(number: int) -> Tensor:
    draw = torch.Generator().manual_seed(4)
    return 2.0 * torch.randn(number, 2, generator=draw, dtype=torch.float64)


def test_rosenbrock_is_minimised_from_random_starts() -> None:
    result = minimise(rosenbrock, starts(12), -FREE, FREE, iterations=200, tolerance=1e-14)
    np.testing.assert_allclose(result.rows, 1.0, atol=1e-5, rtol=0)
    assert result.evaluations < 201  # it stopped at the tolerance


def test_bounded_minima_as_scipy() -> None:
    rng = np.random.default_rng(1)
    root = rng.standard_normal((6, 6))
    matrix = torch.from_numpy(root @ root.T + 0.1 * np.eye(6))
    target = torch.from_numpy(3 * rng.standard_normal((5, 6)))
    low, high = -torch.ones(6, dtype=torch.float64), torch.ones(6, dtype=torch.float64)

    def cost(x: Tensor) -> tuple[Tensor, Tensor]:
        difference = x - target
        slope = difference @ matrix
        return 0.5 * (difference * slope).sum(1) + 1.0, slope

    result = minimise(cost, torch.zeros(5, 6, dtype=torch.float64), low, high, tolerance=1e-14)
    for r in range(5):

        def single_cost(x: np.ndarray, centre: np.ndarray) -> tuple[float, np.ndarray]:
            slope = matrix.numpy() @ (x - centre)
            return 0.5 * float((x - centre) @ slope) + 1.0, slope

        best = scipy.optimize.minimize(
            single_cost,
            np.zeros(6),
            args=(target[r].numpy(),),
            jac=True,
            method="L-BFGS-B",
            bounds=[(-1, 1)] * 6,
            options={"ftol": 1e-15, "gtol": 1e-10},
        )
        assert result.costs[r] == pytest.approx(best.fun, rel=1e-8)
        np.testing.assert_allclose(result.rows[r], best.x, atol=1e-4)
    residual = optimality_residual(result.rows, result.costs, result.gradients, low, high)
    assert (residual < 1e-5).all()
    origin = torch.zeros_like(result.rows)
    assert (optimality_residual(origin, *cost(origin), low, high) > 1e-2).all()


def test_runs_are_independent() -> None:
    rows = starts(3)
    together = minimise(rosenbrock, rows, -FREE, FREE, iterations=30)
    for r in range(3):
        alone = minimise(rosenbrock, rows[r : r + 1], -FREE, FREE, iterations=30)
        torch.testing.assert_close(alone.rows[0], together.rows[r], rtol=1e-9, atol=1e-12)


def test_points_without_finite_cost_are_rejected() -> None:
    def barrier(x: Tensor) -> tuple[Tensor, Tensor]:
        cost = x[:, 0] - torch.log(x[:, 0])  # NaN below 0, minimum at 1
        return cost, (1 - 1 / x[:, 0])[:, None]

    rows = torch.tensor([[5.0], [0.01], [-1.0]], dtype=torch.float64)
    result = minimise(barrier, rows, -FREE[:1], FREE[:1], tolerance=1e-15)
    np.testing.assert_allclose(result.rows[:2, 0], 1.0, atol=1e-6, rtol=0)
    assert math.isinf(result.costs[2])
    assert result.best in (0, 1)


def test_given_inverse_hessian_speeds_up_convergence() -> None:
    scale = torch.tensor([1.0, 1e4], dtype=torch.float64)

    def cost(x: Tensor) -> tuple[Tensor, Tensor]:
        return 0.5 * (scale * x**2).sum(1), scale * x

    start = torch.ones(1, 2, dtype=torch.float64)
    default = minimise(cost, start, -FREE, FREE, iterations=4)
    informed = minimise(cost, start, -FREE, FREE, iterations=4, inverse=torch.diag(1 / scale))
    assert informed.costs[0] < 1e-20 < default.costs[0]
