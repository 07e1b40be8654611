"""Agents who differ: what of a number is one's own, what is a mood, and what all have in common."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

from nnode.data.clusters import better, clusters, index_of
from nnode.data.sequence import Sequence
from nnode.diagnosis.held_out import MODELS, HeldOutErrors, held_out_errors
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.residuals.fit import Fit
from nnode.diagnosis.search import converged_fit
from nnode.diagnosis.statistics.random_effects import (
    IndividualEstimate,
    agent_parameters,
    estimate_individual,
)
from nnode.model.effects.lane import DriverHeterogeneity
from tests.diagnosis.platoons import DT, lin, platoons, streams


def paced(own: np.ndarray) -> list[Sequence]:
    """Sequences whose drivers have the paces ``(S, 4)``."""
    return platoons(lambda x, law, lead: law * (1 + own), number=len(own))


def who_differs(sequences: list[Sequence]) -> tuple[TrafficEngine, Fit, IndividualEstimate]:
    """What is found of different drivers."""
    engine = TrafficEngine(sequences, clusters=clusters(index_of(sequences)))
    fit = converged_fit(engine, lin(), rounds=1)
    found = estimate_individual(engine, fit, DriverHeterogeneity)
    assert found is not None
    return engine, fit, found


def test_drivers_who_differ_are_recognised() -> None:
    pace = np.random.default_rng(5).normal(0, 0.1, (12, 4))
    engine, fit, found = who_differs(paced(pace))
    assert found.p_value < 0.01
    low, high = found.interval()
    assert 0.04 < low < pace.std(ddof=1) < high
    own = agent_parameters(engine, fit.system, found)
    got = np.array([own[f"r/{s}"][:4] for s in range(12)])
    assert np.corrcoef(got.ravel(), pace.ravel())[0, 1] > 0.95
    # one number for all of a sequence is the mean of theirs
    shared = agent_parameters(engine, fit.system, found, common=True)
    assert all(len(set(shared[f"r/{s}"][:4])) == 1 for s in range(12))


@pytest.mark.parametrize("what", ["the hour", "the place in the platoon"])
@pytest.mark.thorough
def test_what_all_have_in_common_is_no_difference_between_drivers(what: str) -> None:
    alarms = 0
    for seed in range(6, 12):
        rng = np.random.default_rng(seed)
        common = rng.normal(0, 0.1, (8, 1) if what == "the hour" else (1, 4))
        *_, found = who_differs(paced(np.broadcast_to(common, (8, 4))))
        alarms += found.p_value <= 0.05
    # one of twenty is expected; two of six would be a chance of 3 %
    assert alarms <= 1


CASES = 6


@pytest.mark.thorough
def test_a_mood_is_no_number_of_one_s_own() -> None:
    """Disturbances of 6 s in windows of 10 s that keep names: both halves of a window are in one
    mood, but windows of an agent that are far from each other are not."""
    alarms = 0
    for seed in range(CASES):
        *_, found = who_differs(streams(seconds=60.0, driver=0.3, lasts=6.0, seed=seed))
        alarms += found.p_value <= 0.05
        assert found.transient[0] > max(found.variance, 0.0)
        assert (found.share["mood"] or 0.0) > 0.5
    assert alarms <= stats.binom.ppf(0.975, CASES, 0.05)


@pytest.mark.thorough
def test_true_paces_are_found_among_moods() -> None:
    pace, inside = 0.05, 0
    for seed in range(CASES):
        *_, found = who_differs(streams(seconds=60.0, pace=pace, driver=0.3, lasts=6.0, seed=seed))
        assert found.p_value < 0.05
        low, high = found.interval()
        inside += low <= pace <= high
        # what parts at every lag have in common, up to the whole minute
        assert found.lags[-1] > 45.0
        assert found.lasts == pytest.approx(found.lags[-1] / 3)
    # the least number that an interval of 95 % leaves to chance at 2.5 %
    assert inside >= stats.binom.ppf(0.025, CASES, 0.95)


@cache
def held_out(pace: float, variance: float | None = None) -> tuple[HeldOutErrors, list[Sequence]]:
    """Half of the streams are open, the others are divided in time; ``variance`` is taken in
    place of the one that was found."""
    sequences = streams(number=16, seconds=40.0, window=40.0, pace=pace, driver=0.3, seed=3)
    _, fit, one = who_differs(sequences[:8])
    if variance is not None:
        one = replace(one, variance=variance)
    found = held_out_errors("traffic", lin(), fit.system, one, sequences[8:], np.arange(8))
    assert found is not None
    return found, sequences[8:]


def test_numbers_of_the_first_part_predict_the_last() -> None:
    found, _ = held_out(0.05)
    plain, own, shared = (found.costs[name].mean() for name in MODELS)
    assert own < 0.6 * plain
    assert own < 0.7 * shared
    assert max(better(found.score_toward[name]) for name in (MODELS[0], MODELS[2])) <= 0.05
    # near the noise and the moods that nobody can know; by far nearer than without any law
    assert found.floor < own < 0.1 * found.costs["constant velocity"].mean()


def test_moods_of_the_first_part_predict_nothing() -> None:
    found, _ = held_out(0.0, variance=0.05**2)
    assert found.costs[MODELS[1]].mean() > 0.9 * found.costs[MODELS[0]].mean()
    assert better(found.score_toward[MODELS[0]]) > 0.05


def test_who_knows_no_law_gets_the_same_first_part() -> None:
    found, sequences = held_out(0.05)
    assert set(found.costs) == {*MODELS, "base", "own mean velocity", "constant velocity"}
    assert found.used == list(range(8))
    for i, s in enumerate(sequences):
        x = s.x[:, :-1, 0]
        # 40 s in samples of 0.2 s: the first part ends at 16 s, the last begins at 24 s
        time = DT * np.arange(1, 81)[:, None]
        for name, first in (("own mean velocity", 0), ("constant velocity", 75)):
            speed = (x[80] - x[first]) / (DT * (80 - first))
            away = x[121:] - x[120] - speed * time
            assert found.costs[name][i] == pytest.approx((away**2).mean(), rel=1e-6)
