"""Agents who differ: what of a number is one's own, what is a mood, and what all have in common."""

from __future__ import annotations

import numpy as np
import pytest

from nnode.data.sequence import Sequence
from nnode.discover.fit import Fit
from nnode.discover.individual import Individuals, individuals, numbers
from nnode.discover.search import settled
from nnode.discover.traffic import TrafficEngine
from nnode.models.effects.traffic import DriverHeterogeneity
from tests.discover.platoons import platoons
from tests.discover.test_traffic_engine import model


def paced(own: np.ndarray, **options: float) -> list[Sequence]:
    """Sequences whose drivers have the paces ``(S, 4)``."""
    made = []
    for s, pace in enumerate(own):
        (one,) = platoons(
            lambda x, law, lead, pace=pace: law * (1 + pace), number=1, seed=s, **options
        )
        made.append(Sequence(name=f"r/{s}", recording="r", time=one.time + 100 * s, x=one.x))
    return made


def who_differs(sequences: list[Sequence]) -> tuple[TrafficEngine, Fit, Individuals]:
    """What is found of different drivers."""
    engine = TrafficEngine(sequences)
    fit = settled(engine, model())
    found = individuals(engine, fit, DriverHeterogeneity)
    assert found is not None
    return engine, fit, found


def test_drivers_who_differ_are_recognised() -> None:
    pace = np.random.default_rng(5).normal(0, 0.1, (12, 4))
    engine, fit, found = who_differs(paced(pace))
    assert found.p_value < 0.01
    low, high = found.interval()
    assert 0.04 < low < 0.1 < high
    own = numbers(engine, fit.system, found)
    got = np.array([own[f"r/{s}"][:4] for s in range(12)])
    assert np.corrcoef(got.ravel(), pace.ravel())[0, 1] > 0.95


@pytest.mark.parametrize(
    "what",
    [
        "the hour",
        pytest.param(
            "the place in the platoon",
            marks=[
                pytest.mark.thorough,
                pytest.mark.xfail(strict=True, reason="a place is taken for the drivers in it"),
            ],
        ),
    ],
)
def test_what_all_have_in_common_is_no_difference_between_drivers(what: str) -> None:
    alarms = 0
    for seed in range(6, 12):
        rng = np.random.default_rng(seed)
        common = rng.normal(0, 0.1, (12, 1) if what == "the hour" else (1, 4))
        *_, found = who_differs(paced(np.broadcast_to(common, (12, 4))))
        alarms += found.p_value <= 0.05
    # one of twenty is expected; two of six would be a chance of 3 %
    assert alarms <= 1
