"""What is added without a score that shows it, and what is given up again."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from nnode.calibrate.parameters import ParameterVector
from nnode.diagnosis import search as searching
from nnode.diagnosis import thresholds
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.residuals.fit import Fit
from nnode.diagnosis.search import converged_fit, search
from nnode.diagnosis.statistics.score import Score, Screen, Trace
from nnode.model.effects import CATALOGUE
from nnode.model.extend import effects_of
from tests.diagnosis.platoons import lin, platoons, relative_speed

EFFECTS = [CATALOGUE.effects[name] for name in ("relative_speed", "inertia")]


@cache
def fitted(strength: float) -> tuple[TrafficEngine, Fit]:
    engine = TrafficEngine(platoons(relative_speed(strength), number=16))
    return engine, converged_fit(engine, lin())


@pytest.mark.thorough
@pytest.mark.parametrize(("strength", "names"), [(0.5, ["relative_speed"]), (0.0, [])])
def test_held_out_clusters_may_be_sure_of_what_no_score_shows(
    monkeypatch: pytest.MonkeyPatch, strength: float, names: list[str]
) -> None:
    scored = Screen.scores

    def blind(screen: Screen, look: list[Trace]) -> list[Score]:
        return [replace(score, p_value=1.0) for score in scored(screen, look)]

    monkeypatch.setattr(Screen, "scores", blind)
    engine, fit = fitted(strength)
    found = search(engine, fit, EFFECTS)
    assert [step.chosen.name for step in found.steps] == names
    assert all(step.chosen.score.p_value <= thresholds.STRICT for step in found.steps)


def test_what_a_curve_outdoes_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, fit = fitted(0.5)
    asked: list[bool] = []
    monkeypatch.setattr(searching, "_curve_predicts_better", lambda *_: asked.append(True) or True)
    found = search(engine, fit, EFFECTS)
    assert asked  # an effect passed, and was doubted
    assert not found.steps
    assert not effects_of(found.fit.system)
    system = found.fit.system
    now = engine.residuals(system, ParameterVector(system).row[None])[0].numpy()
    np.testing.assert_allclose(found.fit.residual, now, atol=1e-9)
    assert found.screen is not None
    assert found.screen.fit is found.fit
    assert {score.effect.name for score in found.scores} == {"relative_speed", "inertia"}
