"""Levenberg and Marquardt's method against problems with known solutions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear
from torch import Tensor

from nnode.calibrate.ensemble import EnsembleCost
from nnode.calibrate.least_squares import least_squares, trajectory_residuals
from nnode.calibrate.parameters import ParameterVector
from nnode.errors import SimulationError
from nnode.simulate.fused import FusedSolver
from nnode.study.crowd.fit import new_system
from tests.study.crowd.corridor import corridor

FREE = np.array([np.inf, np.inf])


def rosenbrock(row: np.ndarray) -> Tensor:
    x, y = row
    return torch.tensor([10 * (y - x**2), 1 - x], dtype=torch.float64)


def test_rosenbrocks_valley_is_followed_to_its_end():
    found = least_squares(rosenbrock, np.array([-1.2, 1.0]), -FREE, FREE, steps=100)
    assert found.row == pytest.approx([1.0, 1.0], abs=1e-4)
    assert found.cost < 1e-8


@pytest.mark.parametrize("seed", range(5))
def test_bounds_of_a_linear_problem_are_obeyed_as_scipy_obeys_them(seed):
    rng = np.random.default_rng(seed)
    matrix, target = rng.normal(size=(30, 6)), rng.normal(size=30)
    low, high = np.full(6, -0.05), np.full(6, 0.08)
    known = lsq_linear(matrix, target, (low, high), tol=1e-14)
    found = least_squares(
        lambda row: torch.from_numpy(matrix @ row - target), np.full(6, 0.01), low, high,
        steps=200, tolerance=1e-14,
    )  # fmt: skip
    assert (known.active_mask != 0).any()
    assert found.cost == pytest.approx(2 * known.cost, rel=1e-8)
    assert found.row == pytest.approx(known.x, abs=1e-5)


def test_points_that_cannot_be_simulated_are_stepped_around():
    def broken(row: np.ndarray) -> Tensor | None:
        return None if row[0] > 3.5 else torch.tensor([np.exp(row[0]) - 20.0])

    one = np.array([np.inf])
    found = least_squares(broken, np.zeros(1), -one, one, steps=100)
    assert found.row[0] == pytest.approx(np.log(20.0), rel=1e-4)


def test_a_start_that_cannot_be_simulated_is_said():
    with pytest.raises(SimulationError, match="start"):
        least_squares(lambda row: None, np.zeros(2), -FREE, FREE)


@pytest.mark.parametrize("weighted", [False, True])
def test_residuals_square_to_the_cost(weighted):
    system, batch = new_system("nn", 1), corridor(seed=2)
    cost = EnsembleCost(system, batch, FusedSolver())
    row = ParameterVector(new_system("nn", 3)).row
    weights = np.array([0.7, 0.1, 0.2]) if weighted else None
    each = cost.costs(row[None])[0].numpy()
    expected = each.mean() if weights is None else weights @ each
    found = trajectory_residuals(cost, weights)(row.numpy())
    assert found is not None
    assert float(found.square().sum()) == pytest.approx(expected, rel=1e-10)
