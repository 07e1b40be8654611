"""Differences between agents, transient deviations, and common changes."""

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


def paced(pace: np.ndarray) -> list[Sequence]:
    """Sequences whose drivers have relative deviations ``(S, 4)`` of their speeds."""
    return platoons(lambda x, law, lead: law * (1 + pace), number=len(pace))


def estimated(sequences: list[Sequence]) -> tuple[TrafficEngine, Fit, IndividualEstimate]:
    engine = TrafficEngine(sequences, clusters=clusters(index_of(sequences)))
    fit = converged_fit(engine, lin(), rounds=1)
    estimate = estimate_individual(engine, fit, DriverHeterogeneity)
    assert estimate is not None
    return engine, fit, estimate


def test_different_drivers_are_detected() -> None:
    pace = np.random.default_rng(5).normal(0, 0.1, (12, 4))
    engine, fit, estimate = estimated(paced(pace))
    assert estimate.p_value < 0.01
    low, high = estimate.interval()
    assert 0.04 < low < pace.std(ddof=1) < high
    individual = agent_parameters(engine, fit.system, estimate)
    values = np.array([individual[f"r/{s}"][:4] for s in range(12)])
    assert np.corrcoef(values.ravel(), pace.ravel())[0, 1] > 0.95
    # agents of a sequence share one value
    shared = agent_parameters(engine, fit.system, estimate, common=True)
    assert all(len(set(shared[f"r/{s}"][:4])) == 1 for s in range(12))


@pytest.mark.parametrize("shape", [(8, 1), (1, 4)], ids=["sequence", "place in the platoon"])
@pytest.mark.thorough
def test_common_changes_are_no_difference_between_drivers(shape: tuple[int, int]) -> None:
    alarms = 0
    for seed in range(6, 12):
        common = np.random.default_rng(seed).normal(0, 0.1, shape)
        *_, estimate = estimated(paced(np.broadcast_to(common, (8, 4))))
        alarms += estimate.p_value <= 0.05
    # one of twenty is expected; two of six have a probability of 3 %
    assert alarms <= 1


CASES = 6


@pytest.mark.thorough
def test_transient_deviations_are_no_difference_between_drivers() -> None:
    """Disturbances of 6 s in windows of 10 s: both halves of a window have the same deviation, but
    distant windows of an agent do not."""
    alarms = 0
    for seed in range(CASES):
        *_, estimate = estimated(streams(seconds=60.0, driver=0.3, lasts=6.0, seed=seed))
        alarms += estimate.p_value <= 0.05
        assert estimate.transient[0] > max(estimate.variance, 0.0)
        assert (estimate.share["transient"] or 0.0) > 0.5
    assert alarms <= stats.binom.ppf(0.975, CASES, 0.05)


@pytest.mark.thorough
def test_different_drivers_are_detected_despite_transient_deviations() -> None:
    pace, inside = 0.05, 0
    for seed in range(CASES):
        sequences = streams(seconds=60.0, pace=pace, driver=0.3, lasts=6.0, seed=seed)
        *_, estimate = estimated(sequences)
        assert estimate.p_value < 0.05
        low, high = estimate.interval()
        inside += low <= pace <= high
        # lags reach up to the whole minute
        assert estimate.lags[-1] > 45.0
        assert estimate.lasts == pytest.approx(estimate.lags[-1] / 3)
    # an interval of 95 % covers fewer with a probability of 2.5 %
    assert inside >= stats.binom.ppf(0.025, CASES, 0.95)


@cache
def held_out(pace: float, variance: float | None = None) -> tuple[HeldOutErrors, list[Sequence]]:
    """Errors in the last part of eight sequences, with a variance estimated on eight others.

    Args:
        variance: replaces the estimate.
    """
    sequences = streams(number=16, seconds=40.0, window=40.0, pace=pace, driver=0.3, seed=3)
    _, fit, estimate = estimated(sequences[:8])
    if variance is not None:
        estimate = replace(estimate, variance=variance)
    errors = held_out_errors("traffic", lin(), fit.system, estimate, sequences[8:], np.arange(8))
    assert errors is not None
    return errors, sequences[8:]


def test_parameters_of_first_part_predict_the_last() -> None:
    errors, _ = held_out(0.05)
    plain, individual, shared = (errors.costs[name].mean() for name in MODELS)
    assert individual < 0.6 * plain
    assert individual < 0.7 * shared
    assert max(better(errors.score_toward[name]) for name in (MODELS[0], MODELS[2])) <= 0.05
    # noise and transient deviations are unpredictable
    assert errors.floor < individual < 0.1 * errors.costs["constant velocity"].mean()


def test_transient_deviations_of_first_part_predict_nothing() -> None:
    errors, _ = held_out(0.0, variance=0.05**2)
    assert errors.costs[MODELS[1]].mean() > 0.9 * errors.costs[MODELS[0]].mean()
    assert better(errors.score_toward[MODELS[0]]) > 0.05


def test_predictions_without_law() -> None:
    errors, sequences = held_out(0.05)
    assert set(errors.costs) == {*MODELS, "base", "own mean velocity", "constant velocity"}
    assert errors.used == list(range(8))
    for i, s in enumerate(sequences):
        x = s.x[:, :-1, 0]
        # 40 s in samples of 0.2 s: the first part ends at 16 s, the last begins at 24 s
        time = DT * np.arange(1, 81)[:, None]
        for name, first in (("own mean velocity", 0), ("constant velocity", 75)):
            speed = (x[80] - x[first]) / (DT * (80 - first))
            error = x[121:] - x[120] - speed * time
            assert errors.costs[name][i] == pytest.approx((error**2).mean(), rel=1e-6)
