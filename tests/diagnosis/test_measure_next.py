"""The leader's profile that distinguishes two effects best."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy import stats

from nnode.diagnosis import measure_next
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.measure_next import (
    COMFORTABLE,
    POWER,
    best_profile,
    distance,
    evaluated_profiles,
)
from nnode.diagnosis.search import converged_fit
from tests.diagnosis.platoons import V0, lin, platoons

MEAN, PERIOD = 15.0, 8.0
DELAY = {"name": "reaction_delay", "T": 0.3}
INERTIA = {"name": "inertia", "tau_v": 0.3}


@pytest.fixture(scope="module")
def engine() -> TrafficEngine:
    engine = TrafficEngine(platoons(driver=0.8))
    converged_fit(engine, lin())
    return engine


def test_distance_excludes_changes_of_parameters(engine: TrafficEngine) -> None:
    other = distance(engine, lin(DELAY), lin(), MEAN, 2.0, PERIOD)
    assert distance(engine, lin(), lin(), MEAN, 2.0, PERIOD) < 1e-4 * other
    assert distance(engine, lin(), lin(v0=1.001 * V0), MEAN, 2.0, PERIOD) < 1e-2 * other


def test_distance_grows_with_swing_of_leader(engine: TrafficEngine) -> None:
    calm, lively = (
        distance(engine, lin(DELAY), lin(INERTIA), MEAN, swing, PERIOD) for swing in (0.2, 2.0)
    )
    assert lively > 50 * calm > 0


@pytest.mark.thorough
def test_number_of_platoons_has_required_power(
    engine: TrafficEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measure_next, "distance", cache(distance))  # it is the same for all levels
    first, second = lin(DELAY), lin(INERTIA)
    profiles = list(evaluated_profiles(engine, first, second, 0.05))
    best = best_profile(engine, first, second, 0.05)
    stricter = best_profile(engine, first, second, 0.01)
    assert best is not None
    assert stricter is not None
    assert stricter.platoons > best.platoons
    numbers = [profile.platoons for profile in profiles]
    assert best.platoons == min(numbers) < max(numbers)
    for profile in profiles:
        assert profile.swing * 2 * math.pi / profile.period <= COMFORTABLE * (1 + 1e-9)
    # sums of squares of clusters with independent residuals
    rng, size = np.random.default_rng(4), 0.3
    number = math.ceil(4 * (stats.norm.ppf(0.95) + stats.norm.ppf(POWER)) ** 2 / size**2)
    rise = size**2 + 2 * size * rng.normal(size=(4000, number))
    z = rise.mean(1) / (2 * size) * math.sqrt(number)
    assert (z > stats.norm.ppf(0.95)).mean() == pytest.approx(POWER, abs=0.02)
