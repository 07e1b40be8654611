"""Intervals of the edges of a period."""

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


def test_interval_of_edge_covers_time_between_sequences(engine: TrafficEngine) -> None:
    fit = fitted(engine, 250.0, 450.0)
    (low, high), (first, last) = intervals(engine, fit, "speed_period").values()
    # nothing was measured from 220 to 300 s and from 420 to 500 s
    assert 215 < low <= 222
    assert 299 <= high < 305
    assert 415 < first <= 421
    assert 498 <= last < 505


def test_profile_is_flat_between_sequences_only(engine: TrafficEngine) -> None:
    fit = fitted(engine, 250.0, 450.0)
    for profile in profiles(engine, fit, "speed_period").values():
        assert profile.bounds == (0.0, 720.0)
        inside = np.abs(profile.at % 100 - 10) < 9
        between = (profile.at % 100 > 25) & (np.abs(profile.at - profile.value) < 29)
        assert profile.rise[inside].min() > 20
        assert np.abs(profile.rise[between]).max() < 1e-6


def test_refined_edges_leave_wrong_place(engine: TrafficEngine) -> None:
    wrong = fitted(engine, 307.0, 560.0)
    refined = refined_edges(engine, wrong, "speed_period")
    assert refined.cost < wrong.cost
    names = [name.rsplit(".", 1)[1] for name in refined.names]
    row = dict(zip(names, refined.row, strict=True))
    assert row["alpha"] == pytest.approx(SLOW, abs=0.02)
    assert 219 < row["a"] < 302
    assert 419 < row["b"] < 502


def test_interval_ends_at_rise_of_cost() -> None:
    at, rise = np.array([1.0, 2.0, 4.0, 6.0]), np.array([np.inf, 0.0, 1.0, 3.0])
    profile = Profile(0, 3.0, at, rise, (0.0, 9.0))
    assert profile.interval(2.0) == (1.0, 5.0)
    assert profile.interval(4.0) == (1.0, 9.0)


def test_refined_edges_keep_best_place(engine: TrafficEngine) -> None:
    fit = fitted(engine, 250.0, 450.0)
    assert refined_edges(engine, fit, "speed_period").cost <= fit.cost
    refitted = refine(engine, copy.deepcopy(fit.system))
    assert refitted.cost == pytest.approx(fit.cost, rel=1e-3)
