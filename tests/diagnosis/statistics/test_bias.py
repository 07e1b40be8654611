"""Bias correction of calibrated parameters."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

import nnode
from benchmarks.drivers import platoons
from nnode.app.python.inputs import model_options
from nnode.diagnosis.lanes.followers import FollowersEngine
from nnode.diagnosis.residuals.fit import refine
from nnode.diagnosis.search import converged_fit
from nnode.diagnosis.statistics.bias import corrected_for_bias
from nnode.model.build import build_model
from nnode.population.followers import PAIRS

#: Pairs of simulations; with :data:`PAIRS`, the random error is as large as the tolerance.
DRAWS = 4 * PAIRS


@pytest.mark.thorough
def test_bias_is_that_of_calibrations_to_simulated_paths() -> None:
    table = platoons("lin", "multi_anticipation", 0.15, 4, number=20)
    engine = FollowersEngine(list(nnode.sequences(table)))
    effects = [{"name": "multi_anticipation", "c": 0.2}]
    model = build_model(model_options("lin", "measured", effects=effects)).double()
    fit = converged_fit(engine, model, rounds=1)
    corrections = [corrected_for_bias(engine, fit, seed) for seed in range(0, DRAWS, PAIRS)]
    corrected = corrections[0]
    assert corrected.simulated is not None
    row = torch.from_numpy(fit.row)
    shifts = [
        refine(simulated, copy.deepcopy(fit.system)).row - fit.row
        for seed in range(DRAWS)
        for simulated in engine.simulated_engines(fit.system, row, seed)
    ]
    bias = fit.row - np.mean([correction.row for correction in corrections], 0)
    c = fit.names.index("terms.1.c")
    error = fit.errors(engine.cluster)
    assert bias[c] > 0.2 * error[c]
    assert (np.abs(bias - np.mean(shifts, 0)) < 0.1 * error).all()
    assert (corrected.simulated < 0.4 * error).all()
    assert (corrected.errors(engine.cluster) > error).all()
