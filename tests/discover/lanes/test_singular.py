"""Linear responses of models that blow up: no number, and no error."""

from __future__ import annotations

import numpy as np
import torch

from nnode.discover.lanes.response import Dense
from nnode.discover.lanes.sweep import _inverse


def test_an_equation_without_a_solution_gives_no_number() -> None:
    # 1 - dt/2 A vanishes where A = 2/dt: a growth by which a step of the rule has no end
    matrix = torch.zeros(3, 2, 2, 2, dtype=torch.float64)
    matrix[1, 0] = 20.0 * torch.eye(2)
    source = np.ones((3, 1, 1, 1, 2))
    moved = Dense(matrix, 2, 0.1).moved(source)
    assert not np.isfinite(moved[1:, ..., 0]).any()
    np.testing.assert_allclose(moved[:, 0, 0, 1], [0.0, 0.1, 0.2])


def test_what_cannot_be_inverted_is_no_number_there_alone() -> None:
    slope = np.zeros((1, 2, 3))  # vehicles, times, sequences
    slope[0, 1, 2] = 20.0
    found = _inverse({(0, 0): slope, (1, 1): np.full((1, 2, 3), -20.0)}, 0.05, 2)
    bad = np.zeros((1, 2, 3), dtype=bool)
    bad[0, 1, 2] = True
    for block in found.values():
        assert (np.isnan(block) == bad).all()
    np.testing.assert_allclose(found[0, 0][~bad], 1.0)
    np.testing.assert_allclose(found[1, 1][~bad], 0.5)
