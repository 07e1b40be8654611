"""Where the edges of a period may lie, when nothing was measured for a while."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.residuals.fit import Fit, refine
from nnode.diagnosis.search import converged_fit
from nnode.diagnosis.statistics.profile import Profile, intervals, profiles, refined_edges
from tests.diagnosis.platoons import lin, platoons

#: Sequences start every 100 s of the clock and last 20 s; those from 300 s and 400 s are slow.
SLOW = 0.9


@pytest.fixture(scope="module")
def engine() -> TrafficEngine:
    plain = platoons(number=8, driver=0.1)
    slow = platoons(lambda every, law, speed: SLOW * law, number=8, driver=0.1)
    return TrafficEngine([slow[i] if i in (3, 4) else plain[i] for i in range(8)])


def fitted(engine: TrafficEngine, a: float, b: float) -> Fit:
    system = lin({"name": "speed_period", "alpha": 0.95, "a": a, "b": b})
    return converged_fit(engine, system)


def test_an_edge_may_lie_anywhere_between_two_sequences(engine: TrafficEngine) -> None:
    fit = fitted(engine, 250.0, 450.0)
    (low, high), (first, last) = intervals(engine, fit, "speed_period").values()
    # 220 to 300 and 420 to 500 s were not measured
    assert 215 < low <= 222
    assert 299 <= high < 305
    assert 415 < first <= 421
    assert 498 <= last < 505


def test_an_edge_within_a_sequence_is_known_better(engine: TrafficEngine) -> None:
    fit = fitted(engine, 250.0, 450.0)
    for one in profiles(engine, fit, "speed_period").values():
        assert one.bounds == (0.0, 720.0)
        inside = np.abs(one.at % 100 - 10) < 9
        between = (one.at % 100 > 25) & (np.abs(one.at - one.value) < 29)
        assert one.rise[inside].min() > 20
        assert np.abs(one.rise[between]).max() < 1e-6


def test_an_edge_leaves_a_wrong_place(engine: TrafficEngine) -> None:
    wrong = fitted(engine, 307.0, 560.0)
    found = refined_edges(engine, wrong, "speed_period")
    assert found.cost < wrong.cost
    names = [name.rsplit(".", 1)[1] for name in found.names]
    row = dict(zip(names, found.row, strict=True))
    assert row["alpha"] == pytest.approx(SLOW, abs=0.02)
    assert 219 < row["a"] < 302
    assert 419 < row["b"] < 502


def test_the_ends_are_where_the_cost_has_risen() -> None:
    at, rise = np.array([1.0, 2.0, 4.0, 6.0]), np.array([np.inf, 0.0, 1.0, 3.0])
    one = Profile(0, 3.0, at, rise, (0.0, 9.0))
    assert one.interval(2.0) == (1.0, 5.0)
    assert one.interval(4.0) == (1.0, 9.0)


def test_a_fit_in_the_best_place_stays(engine: TrafficEngine) -> None:
    fit = fitted(engine, 250.0, 450.0)
    assert refined_edges(engine, fit, "speed_period").cost <= fit.cost
    again = refine(engine, copy.deepcopy(fit.system))
    assert again.cost == pytest.approx(fit.cost, rel=1e-3)
