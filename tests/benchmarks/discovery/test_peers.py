"""Peers on the diagnosis's own library: from a regression's coefficients to a model."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.discovery.peers import _effect
from benchmarks.discovery.task import diagnose_case
from benchmarks.synthetic_cases import Case
from benchmarks.synthetic_cases.regression import PEERS
from nnode.discover.statistics.score import Trace
from nnode.model.effects import CATALOGUE, Probe


def test_neighbouring_cells_of_a_regression_become_one_interval():
    zone = CATALOGUE.effects["speed_zone"]
    probes = [Probe({"a": 10.0 * i, "b": 10.0 * (i + 1)}, {"alpha": -0.1}) for i in range(6)]
    trace = Trace(zone, probes, np.zeros((1, 6)))
    found = _effect(trace, np.array([0.05, 0.0, -0.2, -0.3, 0.1, -0.2])).options()
    assert found == pytest.approx({"alpha": 0.75, "a": 20.0, "b": 40.0})


def test_strengths_are_kept_in_their_plausible_range():
    drift = CATALOGUE.effects["drift"]
    trace = Trace(drift, [Probe({}, {"a_x": 0.02, "a_y": 0.02})], np.zeros((1, 2)))
    highest = drift.strengths["a_y"].range.high
    found = _effect(trace, np.array([0.1, 1e6])).options()
    assert found == pytest.approx({"a_x": 0.1, "a_y": highest})


@pytest.mark.slow
def test_peers_are_scored_beside_the_diagnosis():
    pytest.importorskip("pysindy")
    case = Case(domain="crowd", arm="single", effects=("drift",), strength="strong", n_sequences=8)
    row = diagnose_case(case.to_dict(), peers=True)
    assert not row["failure"]
    assert list(row["peers"]) == list(PEERS)
    nothing, ensemble = row["peers"]["recalibration"], row["peers"]["ensemble_sindy"]
    assert (nothing["named"], nothing["closure"], nothing["worse"]) == ("nothing", 0.0, False)
    assert "drift" in ensemble["named"]
    assert ensemble["closure"] > 0.5
