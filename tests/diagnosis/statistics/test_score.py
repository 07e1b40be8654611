"""Columns of effects, and p-values of the screen."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from scipy import stats

import nnode
from benchmarks.drivers import platoons
from nnode.app.python.inputs import model_options
from nnode.data.clusters import clusters, index_of
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.lanes.followers import FollowersEngine
from nnode.diagnosis.search import converged_fit
from nnode.diagnosis.statistics.score import PARTS, Screen, Trace, traces
from nnode.model.build import build_model
from nnode.model.effects import Probe
from nnode.model.effects.lane import RelativeSpeed, SpeedZone, TimeGap, VehicleClass
from tests.builders import regression
from tests.diagnosis.platoons import lin, streams

CASES, ALPHA = 20, 0.05


class Truck(VehicleClass):
    """The p-values are those of the flips alone, because no size is negligible."""

    strengths: ClassVar = {"phi": replace(VehicleClass.strengths["phi"], min_effect_size=None)}


@pytest.mark.thorough
def test_cells_add_up_to_interval() -> None:
    engine = FollowersEngine(list(nnode.sequences(platoons("lin", "speed_zone", 0.0, 6, number=8))))
    model = build_model(model_options("lin", "measured", effects=[])).double()
    fit = converged_fit(engine, model, rounds=1)
    (trace,) = traces(engine, fit, SpeedZone)
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
        [engine.screen_columns(fit.system, row, SpeedZone, probe).numpy()[0] for probe in sharp]
    )
    cells = trace.columns[:, first : last + 1].sum(1)
    # at the ends, which are as wide as a cell, a finite strength acts in proportion to the time per
    # metre, not to the share of the zone
    np.testing.assert_allclose(cells, expected, atol=0.03 * np.abs(expected).max())
    assert abs(cells @ expected / (expected @ expected) - 1) < 0.01
    whole = replace(trace.probes[0], options={"a": -1e4, "b": 1e4})
    everywhere = engine.screen_columns(fit.system, row, SpeedZone, whole).numpy()[0]
    largest = np.abs(everywhere).max()
    np.testing.assert_allclose(trace.columns.sum(1), everywhere, atol=0.03 * largest)
    (score,) = Screen(fit, engine.cluster).scores([trace])
    assert score.options["a"] < 260.0 < 410.0 < score.options["b"]
    assert abs(score.options["alpha"] - 0.9) < 0.03


@pytest.mark.thorough
def test_level_with_transient_deviations_of_drivers() -> None:
    """Clusters keep the level, windows do not: deviations outlast a driver's ten windows of 5 s."""
    alarms = {"clusters": 0, "windows": 0}
    for seed in range(CASES):
        sequences = streams(
            vehicles=3, seconds=50.0, window=5.0, driver=0.5, lasts=120.0, seed=seed
        )
        label = clusters(index_of(sequences))
        assert (len(sequences), label.max() + 1) == (80, 8)
        engine = TrafficEngine(sequences, clusters=label)
        fit = converged_fit(engine, lin(), rounds=1)
        columns = traces(engine, fit, Truck)
        for name, unit in (("clusters", engine.cluster), ("windows", engine.sequence)):
            (score,) = Screen(fit, unit, seed).scores(columns)
            alarms[name] += score.p_value <= ALPHA
    # the quantile of 97.5 % for clusters, and a number that is impossible at the level for windows
    assert alarms["clusters"] <= stats.binom.ppf(0.975, CASES, ALPHA)
    assert stats.binom.sf(alarms["windows"] - 1, CASES, ALPHA) < 1e-4


@pytest.mark.parametrize("number", [3, 6])
def test_smallest_p_value(number: int) -> None:
    rng = np.random.default_rng(number)
    label = np.repeat(np.arange(number), 30)
    columns = rng.normal(size=(3, len(label)))
    residual = 1e-3 * rng.normal(size=len(label)) - 0.3 * columns[0]
    screen = Screen(regression(np.zeros((len(label), 0)), residual), label)
    effects = (RelativeSpeed, VehicleClass, TimeGap)
    candidates = [
        Trace(effect, [Probe({}, dict.fromkeys(effect.strengths, 0.1))], column[:, None])
        for effect, column in zip(effects, columns, strict=True)
    ]
    scores = screen.scores(candidates)
    assert scores[0].effect is RelativeSpeed
    # up to a common sign there are 2^(G - 1) outcomes
    assert min(score.p_value for score in scores) >= 2.0 ** (1 - number)
    (alone,) = screen.scores(candidates[:1])
    assert alone.p_value == 2.0 ** (1 - number)
