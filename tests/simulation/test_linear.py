"""Linear responses of models that blow up: no number, and no error."""

from __future__ import annotations

import numpy as np

from nnode.simulation.linear import DenseSolver, FrontToBackSolver


def test_an_equation_without_a_solution_gives_no_number() -> None:
    # 1 - dt/2 A vanishes where A = 2/dt: a growth by which a step of the rule has no end
    matrix = np.zeros((3, 2, 2, 2))
    matrix[1, 0] = 20.0 * np.eye(2)
    moved = DenseSolver(matrix, 2, 0.1).response(np.ones((3, 1, 1, 1, 2)))
    assert not np.isfinite(moved[1:, ..., 0]).any()
    np.testing.assert_allclose(moved[:, 0, 0, 1], [0.0, 0.1, 0.2])


def test_what_cannot_be_inverted_is_no_number_there_alone() -> None:
    slope = np.zeros((1, 3, 3))  # vehicles, times, sequences
    slope[0, 1, 2] = 20.0
    blocks = {(0, 0, 0): slope, (1, 0, 1): np.full((1, 3, 3), -20.0)}
    source = np.zeros((3, 2, 2, 1, 3))  # times, states, vehicles, changes, sequences
    source[:, :, 0] = 1.0
    moved = FrontToBackSolver(blocks, 2, 0.1).response(source)
    assert np.isnan(moved[1:, 0, 0, 2]).all()
    np.testing.assert_allclose(moved[:, 0, 0, :2], [[0.0, 0.0], [0.1, 0.1], [0.2, 0.2]])
    assert not moved[:, 1].any()
