"""The traces of neighbouring cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import nnode
from benchmarks.drivers import platoons
from nnode.app.python.inputs import model_options
from nnode.diagnosis.lanes.followers import FollowersEngine
from nnode.diagnosis.search import converged_fit
from nnode.diagnosis.statistics.score import PARTS, Screen, traces
from nnode.model.build import build_model
from nnode.model.effects import CATALOGUE

ZONE = CATALOGUE.effects["speed_zone"]


@pytest.mark.thorough
def test_cells_add_up_to_an_interval_with_ends_as_wide_as_a_cell() -> None:
    engine = FollowersEngine(list(nnode.sequences(platoons("lin", "speed_zone", 0.0, 6, number=8))))
    model = build_model(model_options("lin", "measured", effects=[])).double()
    fit = converged_fit(engine, model, rounds=1)
    (trace,) = traces(engine, fit, ZONE)
    first, last = 14, 18
    low, high = trace.probes[first].options["a"], trace.probes[last].options["b"]
    width = trace.probes[first].options["b"] - low
    shifts = width * (np.arange(PARTS + 1) / PARTS - 0.5)
    weights = np.full(PARTS + 1, 1 / PARTS)
    weights[[0, -1]] /= 2
    sharp = [
        replace(trace.probes[first], options={"a": low + shift, "b": high + shift})
        for shift in shifts
    ]
    row = torch.from_numpy(fit.row)
    expected = weights @ np.stack(
        [engine.screen_columns(fit.system, row, ZONE, probe).numpy()[0] for probe in sharp]
    )
    cells = trace.columns[:, first : last + 1].sum(1)
    # within an end, a strength of finite size acts in proportion to the time per metre, not to
    # the share of the zone
    np.testing.assert_allclose(cells, expected, atol=0.03 * np.abs(expected).max())
    assert abs(cells @ expected / (expected @ expected) - 1) < 0.01
    whole = replace(trace.probes[0], options={"a": -1e4, "b": 1e4})
    everywhere = engine.screen_columns(fit.system, row, ZONE, whole).numpy()[0]
    largest = np.abs(everywhere).max()
    np.testing.assert_allclose(trace.columns.sum(1), everywhere, atol=0.03 * largest)
    (score,) = Screen(fit, engine.cluster).scores([trace])
    assert score.options["a"] < 260.0 < 410.0 < score.options["b"]
    assert abs(score.options["alpha"] - 0.9) < 0.03
