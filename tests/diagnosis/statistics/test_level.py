"""The level of the first screen, end to end: simulated drivers whose disturbances last."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from scipy import stats

from nnode.data.clusters import clusters, index_of
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.search import converged_fit
from nnode.diagnosis.statistics.score import Screen, Trace, traces
from nnode.model.effects import Probe
from nnode.model.effects.lane import RelativeSpeed, TimeGap, VehicleClass
from tests.builders import regression
from tests.diagnosis.platoons import lin, streams

CASES, ALPHA = 20, 0.05


class Truck(VehicleClass):
    """No size of it is taken for none: its p-values are those of the flips alone."""

    strengths: ClassVar = {"phi": replace(VehicleClass.strengths["phi"], min_effect_size=None)}


@pytest.mark.thorough
def test_clusters_keep_the_level_where_windows_do_not() -> None:
    """Nothing is hidden; every driver is in a mood that outlasts his ten windows of 5 s."""
    alarms = {"clusters": 0, "windows": 0}
    for seed in range(CASES):
        sequences = streams(
            vehicles=3, seconds=50.0, window=5.0, driver=0.5, lasts=120.0, seed=seed
        )
        label = clusters(index_of(sequences))
        assert (len(sequences), label.max() + 1) == (80, 8)
        engine = TrafficEngine(sequences, clusters=label)
        fit = converged_fit(engine, lin(), rounds=1)
        looked = traces(engine, fit, Truck)
        for name, own in (("clusters", engine.cluster), ("windows", engine.sequence)):
            (score,) = Screen(fit, own, seed).scores(looked)
            alarms[name] += score.p_value <= ALPHA
    # the most that clusters may have at 2.5 %, and what windows never had at the level
    assert alarms["clusters"] <= stats.binom.ppf(0.975, CASES, ALPHA)
    assert stats.binom.sf(alarms["windows"] - 1, CASES, ALPHA) < 1e-4


@pytest.mark.parametrize("number", [3, 6])
def test_no_adjusted_p_is_below_its_floor_however_strong_an_effect_is(number: int) -> None:
    rng = np.random.default_rng(number)
    label = np.repeat(np.arange(number), 30)
    column = rng.normal(size=(3, len(label)))
    residual = 1e-3 * rng.normal(size=len(label)) - 0.3 * column[0]
    fit = regression(np.zeros((len(label), 0)), residual)
    effects = (RelativeSpeed, VehicleClass, TimeGap)
    looked = [
        Trace(effect, [Probe({}, dict.fromkeys(effect.strengths, 0.1))], own[:, None])
        for effect, own in zip(effects, column, strict=True)
    ]
    best, *others = Screen(fit, label).scores(looked)
    assert best.effect is RelativeSpeed
    # but for the sign of everything there are 2^(G - 1) outcomes
    assert min(one.p_value for one in (best, *others)) >= 2.0 ** (1 - number)
    (alone,) = Screen(fit, label).scores(looked[:1])
    assert alone.p_value == 2.0 ** (1 - number)
