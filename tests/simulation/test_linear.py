"""Linear responses by each solver, and divergent models."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from nnode.simulation.linear import (
    Blocks,
    DenseSolver,
    FrontToBackSolver,
    RungeKuttaSolver,
    dense_jacobian,
    subdivided,
)


def test_singular_step_of_the_dense_solver() -> None:
    # 1 - dt/2 A is singular at A = 2/dt
    matrix = np.zeros((3, 2, 2, 2))
    matrix[1, 0] = 20.0 * np.eye(2)
    moved = DenseSolver(matrix, 2, 0.1).response(np.ones((3, 1, 1, 1, 2)))
    assert not np.isfinite(moved[1:, ..., 0]).any()
    np.testing.assert_allclose(moved[:, 0, 0, 1], [0.0, 0.1, 0.2])


def test_singular_step_of_one_vehicle_in_one_sequence() -> None:
    slope = np.zeros((1, 3, 3))  # vehicles, times, sequences
    slope[0, 1, 2] = 20.0
    blocks = {(0, 0, 0): slope, (1, 0, 1): np.full((1, 3, 3), -20.0)}
    source = np.zeros((3, 2, 2, 1, 3))  # times, states, vehicles, changes, sequences
    source[:, :, 0] = 1.0
    moved = FrontToBackSolver(blocks, 2, 0.1).response(source)
    assert np.isnan(moved[1:, 0, 0, 2]).all()
    np.testing.assert_allclose(moved[:, 0, 0, :2], [[0.0, 0.0], [0.1, 0.1], [0.2, 0.2]])
    assert not moved[:, 1].any()


@pytest.mark.parametrize("reads_speed", [False, True])
def test_front_to_back_solver_equals_dense_solver(reads_speed: bool) -> None:
    """Two states, four vehicles, five times, three changes and two sequences."""
    rng = np.random.default_rng(4)
    m, n, k, c, b, dt = 2, 4, 5, 3, 2, 0.2
    keys = [(p, ahead, q) for p in range(m) for ahead in range(3) for q in range(m)]
    keys += [(1, 1, m)] if reads_speed else []  # acceleration by speed ahead
    blocks: Blocks = {key: rng.normal(size=(n - 1, k, b)) for key in keys}
    source, start = rng.normal(size=(k, m, n, c, b)), rng.normal(size=(m, n, c, b))
    matrix = dense_jacobian(blocks, (m, n, k, b)).reshape(m * n, m * n, k, b).transpose(2, 3, 0, 1)
    dense = DenseSolver(matrix.copy(), m, dt)
    by_vehicle = FrontToBackSolver(blocks, m, dt)
    for first in (None, start):
        expected = dense.response(source, first)
        np.testing.assert_allclose(by_vehicle.response(source, first), expected, atol=1e-12)
    assert not np.allclose(expected, dense.response(source), atol=0.1)


def test_subdivided_steps() -> None:
    """States with rates up to 20 per second, against the matrix exponential."""
    dt, rng = 0.2, np.random.default_rng(6)
    matrix = np.array([[0.0, 1.0, 0.0], [-3.0, -2.0, 0.5], [12.0, 0.0, -20.0]])
    push = rng.normal(size=3)
    augmented = np.zeros((4, 4))
    augmented[:3, :3], augmented[:3, 3] = matrix, push
    exact = expm(dt * augmented)
    errors = []
    for doublings in (0, 4):
        step, after = subdivided(np.stack([matrix, matrix])[:, None], dt, doublings)
        forced = after[0, 0].numpy() @ (dt / 2 * (push + push))
        moved = np.abs(step[0, 0].numpy() - exact[:3, :3]).max()
        errors.append((moved, np.abs(forced - exact[:3, 3]).max()))
    assert min(errors[0]) > 0.01
    assert max(errors[1]) < 5e-3


def test_runge_kutta_solver() -> None:
    """Two people with coupled accelerations that depend on time, and pushes at 1 Hz."""
    rng = np.random.default_rng(5)
    n, dt, times = 2, 0.1, 0.1 * np.arange(31)
    to_velocity = np.block([[np.zeros((n, n)), np.eye(n)]])
    constant, growing = rng.normal(size=(2, n, 2 * n))

    def matrix(t: float) -> np.ndarray:
        return np.concatenate([to_velocity, constant + t * growing / 3])

    def push(t: float | np.ndarray) -> np.ndarray:
        return np.stack([np.sin(2 * np.pi * np.asarray(t)), np.cos(2 * np.pi * np.asarray(t))])

    first = rng.normal(size=2 * n)
    exact = solve_ivp(
        lambda t, y: matrix(t) @ y + np.concatenate([np.zeros(n), push(t)]),
        (0.0, times[-1]),
        first,
        t_eval=times,
        rtol=1e-10,
        atol=1e-12,
    ).y[:n]
    solver = RungeKuttaSolver(np.stack([matrix(t) for t in times])[:, None], dt)
    source = np.zeros((len(times), 2, n, 1, 1))
    source[:, 1, :, 0, 0] = push(times).T
    moved = solver.response(source, first.reshape(2, n, 1, 1))[..., 0, 0].T
    # the first step has an error of dt^3 / 12 times the push's second derivative, 0.0033 m/s
    np.testing.assert_allclose(moved, exact, atol=0.004)
