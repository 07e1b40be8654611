"""The search for effects: acceptance, hints, and the ends of periods."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import nnode
from benchmarks import drivers
from benchmarks.people import crowds
from nnode.app.python.inputs import model_options
from nnode.calibrate.parameters import ParameterVector
from nnode.diagnosis import candidate, thresholds
from nnode.diagnosis import search as module
from nnode.diagnosis.crowds.engine import CrowdEngine
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.lanes.followers import FollowersEngine
from nnode.diagnosis.residuals.fit import Fit, evaluated, refine
from nnode.diagnosis.search import (
    _hinted,
    _with_best_ends,
    calibrated_without,
    converged_fit,
    search,
)
from nnode.diagnosis.statistics.score import Score, Screen, Trace
from nnode.errors import SimulationError
from nnode.model import System, Traffic, build_model, make_law
from nnode.model.effects import CATALOGUE
from nnode.model.effects.lane import SpeedPeriod
from nnode.model.extend import effects_of
from tests.diagnosis.agreement import residuals
from tests.diagnosis.platoons import lin, platoons, relative_speed

EFFECTS = [CATALOGUE.effects[name] for name in ("relative_speed", "inertia")]
ZONE = {"name": "speed_zone", "alpha": 0.5, "a": 10.0, "b": 90.0}
DELAY = {"name": "reaction_delay", "T": 0.7}


@cache
def fitted(strength: float) -> tuple[TrafficEngine, Fit]:
    engine = TrafficEngine(platoons(relative_speed(strength), number=16))
    return engine, converged_fit(engine, lin())


scores = Screen.scores


def insignificant(screen: Screen, columns: list[Trace]) -> list[Score]:
    """The scores of a screen, none of them significant."""
    return [replace(score, p_value=1.0) for score in scores(screen, columns)]


@pytest.mark.thorough
@pytest.mark.parametrize(("strength", "names"), [(0.5, ["relative_speed"]), (0.0, [])])
def test_effect_is_accepted_by_held_out_clusters_alone(
    monkeypatch: pytest.MonkeyPatch, strength: float, names: list[str]
) -> None:
    monkeypatch.setattr(Screen, "scores", insignificant)
    engine, fit = fitted(strength)
    result = search(engine, fit, EFFECTS)
    assert [step.chosen.name for step in result.steps] == names
    assert all(step.chosen.score.p_value <= thresholds.STRICT for step in result.steps)


def test_effect_is_removed_if_curve_predicts_better(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, fit = fitted(0.5)
    calls: list[bool] = []
    monkeypatch.setattr(module, "_curve_predicts_better", lambda *_: calls.append(True) or True)
    result = search(engine, fit, EFFECTS)
    assert calls
    assert not result.steps
    system = result.fit.system
    assert not effects_of(system)
    np.testing.assert_allclose(result.fit.residual, residuals(engine, system).numpy(), atol=1e-9)
    assert result.screen is not None
    assert result.screen.fit is result.fit
    assert {score.effect.name for score in result.scores} == {"relative_speed", "inertia"}


def law(*effects: dict[str, Any]) -> System:
    return build_model({**model_options("lin", "measured"), "effects": list(effects)}, 0)


@pytest.mark.parametrize(
    ("hints", "effects", "name", "expected"),
    [
        ([[ZONE, DELAY], [DELAY]], [], "speed_zone", [{"speed_zone"}]),
        ([[ZONE, DELAY]], [DELAY], "speed_zone", [{"speed_zone", "reaction_delay"}]),
        ([[ZONE, DELAY], [DELAY]], [], "reaction_delay", 2 * [{"reaction_delay"}]),
        ([[ZONE, DELAY]], [], "inertia", []),
        ([[ZONE, DELAY]], [{"name": "inertia", "tau_v": 0.5}], "speed_zone", []),
        ([], [], "speed_zone", []),
    ],
)
def test_hints_have_effects_of_model_and_one_more(
    hints: list[list[dict[str, Any]]],
    effects: list[dict[str, Any]],
    name: str,
    expected: list[set[str]],
) -> None:
    def names(models: list[System]) -> list[set[str]]:
        return [{effect.name for effect in effects_of(model)} for model in models]

    models = [law(*hint) for hint in hints]
    assert names(_hinted(models, law(*effects), name)) == expected
    assert names(models) == [{effect["name"] for effect in hint} for hint in hints]


@pytest.mark.parametrize(
    ("default", "hinted", "best"),
    [
        (9.0, 4.0, 4.0),
        (3.0, 4.0, 3.0),
        (None, 4.0, 4.0),
        (3.0, None, 3.0),
        (None, None, None),  # None: the simulation from this start diverges
    ],
)
def test_calibration_uses_better_start(
    monkeypatch: pytest.MonkeyPatch, default: float | None, hinted: float | None, best: float | None
) -> None:
    hint = law(DELAY)

    def refine(engine: Any, system: System, **options: Any) -> Any:
        cost = hinted if system is hint else default
        if cost is None:
            raise SimulationError("it blows up")
        return SimpleNamespace(cost=cost)

    def calibrated() -> Any:
        score: Any = SimpleNamespace(effect=CATALOGUE.effects["reaction_delay"], options={})
        before: Any = SimpleNamespace(system=law())
        engine: Any = None
        return candidate.calibrated(engine, before, score, 0.0, [hint])

    monkeypatch.setattr(candidate, "refine", refine)
    if best is None:
        with pytest.raises(SimulationError, match="reaction_delay blows up on these data"):
            calibrated()
    else:
        assert calibrated().cost == best


@pytest.mark.parametrize("seed", [5, 6, 7])
def test_end_of_period_moves_into_sequence(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.setattr(drivers, "PERIOD", (250.0, 518.0))
    monkeypatch.setitem(drivers.HIDDEN["lin"], "speed_period", 0.7)
    table = drivers.platoons("lin", "speed_period", 0.15, seed, number=9, vehicles=4)
    engine = FollowersEngine(list(nnode.sequences(table)))
    period = SpeedPeriod(alpha=0.7, a=250.0, b=465.0)
    system = Traffic([make_law("lin"), period], leader="measured").double()
    engine.fit_whitening(system, ParameterVector(system).row)
    fit = refine(engine, system)
    end = fit.names.index("terms.1.b")
    assert not 500 < fit.row[end] < 530  # drivers of the platoon at 500 s are estimated as slow
    best = _with_best_ends(engine, fit, SpeedPeriod)
    assert best.row[end] == pytest.approx(518, abs=1)
    assert best.row[fit.names.index("terms.1.alpha")] == pytest.approx(0.7, abs=0.03)


@pytest.mark.thorough
@pytest.mark.parametrize("hinted", [True, False])
def test_strong_effect_with_a_small_score_is_selected_if_hinted(
    monkeypatch: pytest.MonkeyPatch, hinted: bool
) -> None:
    table = crowds("alignment", 5, push=0.02, sequences=10)
    engine = CrowdEngine(list(nnode.sequences(table)), clusters=np.arange(10))
    options = {**model_options("esf"), "desired": "exit"}
    system, extension = (
        build_model({**options, "effects": effects}, 0).double()
        for effects in ([], [{"name": "alignment", "c": 0.15}])
    )
    monkeypatch.setattr(Screen, "scores", insignificant)
    engine.set_population(engine.population_of(engine.regression_start(extension)))
    result = search(
        engine,
        refine(engine, system),
        [CATALOGUE.effects["alignment"]],
        hints=[extension] if hinted else [],
    )
    assert [step.chosen.name for step in result.steps] == (["alignment"] if hinted else [])


class TwoMinima:
    """Residuals with a minimum of the cost near v0 = 20 m/s, and a deeper one at 30 m/s."""

    def residuals(self, system: System, rows: Tensor) -> Tensor:
        v0 = rows[:, 0]
        return torch.stack([(v0 - 20) * (v0 - 30) / 10, (v0 - 30) / 20], 1)

    def tangents(self, system: System, row: Tensor) -> Tensor:
        v0 = row[0]
        tangents = torch.zeros(len(row), 2, dtype=row.dtype)
        tangents[0] = torch.stack([(2 * v0 - 50) / 10, torch.ones_like(v0) / 20])
        return tangents


@pytest.mark.parametrize(("extended_v0", "v0"), [(32.0, 30.0), (17.0, 20.0)])
def test_model_without_effects_is_calibrated_from_both_starts(
    extended_v0: float, v0: float
) -> None:
    """The deeper minimum is used, which only the model with the effect has found."""
    engine: Any = TwoMinima()
    before = evaluated(engine, lin(v0=18.0))
    after = evaluated(engine, lin({"name": "relative_speed", "kappa": 0.3}, v0=extended_v0))
    fit = calibrated_without(engine, before, after, "relative_speed")
    assert fit.row[0] == pytest.approx(v0, abs=0.5)
