"""Regression baselines on the diagnosis' library of effects."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.discovery.baselines import _effect
from benchmarks.discovery.regression import BASELINES
from benchmarks.discovery.synthetic import evaluate
from benchmarks.synthetic_cases import Case
from nnode.diagnosis.statistics.score import Trace
from nnode.model.effects import CATALOGUE, Probe

CELLS = [Probe({"a": 10.0 * i, "b": 10.0 * (i + 1)}, {"alpha": -0.1}) for i in range(6)]
DRIFT = [Probe({}, {"a_x": 0.02, "a_y": 0.02})]
HIGHEST = CATALOGUE.effects["drift"].strengths["a_y"].range.high


@pytest.mark.parametrize(
    ("name", "probes", "theta", "options"),
    [
        # neighbouring cells are merged
        ("speed_zone", CELLS, [0.05, 0, -0.2, -0.3, 0.1, -0.2], {"alpha": 0.75, "a": 20, "b": 40}),
        ("speed_zone", CELLS, [-0.2] * 6, {"alpha": 0.8, "a": 0, "b": 60}),
        # strengths are limited to their range
        ("drift", DRIFT, [0.1, 1e6], {"a_x": 0.1, "a_y": HIGHEST}),
    ],
)
def test_effect_of_coefficients(name, probes, theta, options):
    trace = Trace(CATALOGUE.effects[name], probes, np.zeros((1, len(theta))))
    assert _effect(trace, np.array(theta)).options() == pytest.approx(options)


@pytest.mark.slow
def test_baselines_are_scored_like_the_diagnosis():
    pytest.importorskip("pysindy")
    case = Case(domain="crowd", arm="single", effects=("drift",), strength="strong", n_sequences=8)
    rows = {row["method"]: row for row in evaluate(case.to_dict(), baselines=True)["synthetic"]}
    assert not rows["diagnosis"]["failure"]
    assert list(rows) == ["diagnosis", *BASELINES]
    recalibration, ensemble = rows["recalibration"], rows["ensemble_sindy"]
    assert [recalibration[key] for key in ("named", "closed", "worse")] == ["", 0.0, False]
    assert "drift" in ensemble["named"]
    assert ensemble["closed"] > 0.5
