"""A search that goes back keeps nothing of the filter of a model that it gave up."""

from __future__ import annotations

import numpy as np
import pytest

from nnode.discover.lanes.engine import TrafficEngine
from nnode.discover.name import search as searching
from nnode.discover.name.search import search, settled
from nnode.discover.residuals.engine import row_of
from nnode.models import build_model
from nnode.models.effects import CATALOGUE
from nnode.models.extend import effects_of
from tests.discover.platoons import LENGTH, V0, platoons, relative_speed


def test_what_a_curve_outdoes_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    options = {"term": "lin", "name": "lin", "leader": "measured", "v0": V0, "L": LENGTH}
    engine = TrafficEngine(platoons(effect=relative_speed(0.5), number=16))
    fit = settled(engine, build_model({**options, "L_min": 1.0}))
    asked: list[bool] = []
    monkeypatch.setattr(searching, "_outdone", lambda *_: asked.append(True) or True)
    found = search(engine, fit, [CATALOGUE.effects[n] for n in ("relative_speed", "inertia")])
    assert asked  # an effect passed, and was doubted
    assert not found.steps
    assert not effects_of(found.fit.system)
    system = found.fit.system
    now = engine.residuals(system, row_of(system)[None])[0].numpy()
    np.testing.assert_allclose(found.fit.residual, now, atol=1e-9)
    assert found.screen is not None
    assert found.screen.fit is found.fit
    assert {score.effect.name for score in found.scores} == {"relative_speed", "inertia"}
