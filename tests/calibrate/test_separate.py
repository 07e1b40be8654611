"""Separate calibration of each sequence."""

from __future__ import annotations

import numpy as np
import pytest

from nnode.app.drivers import separate_parameters
from nnode.calibrate.cost import Convention
from nnode.calibrate.problem import ResidualProblem
from nnode.data.sequence import collate
from nnode.simulation import FusedSolver
from tests.calibrate.test_start_speeds import helly_model
from tests.studies.following.test_fit import helly_pairs

TIME_GAPS = np.array([1.0, 1.2, 1.4, 1.6, 1.8, 2.0])


@pytest.mark.thorough
def test_parameters_of_each_sequence_are_recovered() -> None:
    sequences = helly_pairs(time_gaps=TIME_GAPS)
    problem = ResidualProblem(helly_model(), collate(sequences), FusedSolver(), Convention.spacing)
    table = separate_parameters(problem, sequences, seed=0)
    assert table["T"].to_numpy() == pytest.approx(TIME_GAPS, rel=1e-3)
    assert table["cluster"].tolist() == [0, 0, 1, 1, 2, 2]
    assert table["cost"].mean() < 1e-3 < 0.1 < table["cost_pooled"].mean()
    assert table["at_bound"].tolist() == [""] * 6
