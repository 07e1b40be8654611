"""Derivatives of simulated states by parameters, against closed forms.

``test_engines.py`` compares those of every law and effect with autograd."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.model import Traffic, build_model
from nnode.model.arrays import Formulas
from nnode.model.laws import CAR_FOLLOWING_LAWS
from nnode.model.tangent import with_tangents
from nnode.simulation.kernels import lanes
from tests.model.following import DT, model, set_
from tests.simulation.kernels.interpreted import interpreted
from tests.simulation.test_engines import platoons


@pytest.fixture
def without_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lanes, "compiled", interpreted)


def tangents(
    system: Traffic, batch: Batch, names: list[str], each: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Places ``(K, B, N)`` and their derivatives ``(P, K, B, N)``."""
    formula = lanes.supports(system, batch)
    assert formula is not None
    states, slopes = lanes.tangents(system, formula, batch, 2, names, each=each)
    return states[..., 0], slopes[..., 0]


def linear(*effects: dict[str, Any], leader: str = "measured") -> Traffic:
    law = {"term": "lin", "name": "lin", "v0": 25.0, "L": 6.0, "L_min": 2.0}
    system = build_model({**law, "leader": leader, "effects": list(effects)})
    assert isinstance(system, Traffic)
    return system


@pytest.mark.usefixtures("without_compiler")
def test_of_a_leader_that_drives_by_the_law() -> None:
    """The first one of a platoon drives at v0: x = x_0 + v0 t."""
    system = linear({"name": "relative_speed", "kappa": 0.4}, leader="constant")
    _, slopes = tangents(system, platoons(), ["lin__v0"])
    time = DT * torch.arange(6, dtype=torch.float64)
    torch.testing.assert_close(slopes[0, :, 0, 3], time, rtol=1e-13, atol=1e-14)


@pytest.mark.usefixtures("without_compiler")
def test_of_a_delay_between_two_steps() -> None:
    """Newell's law: d and T are all that places depend on, once its leader's path has come."""
    short = {**CAR_FOLLOWING_LAWS["newell"], "remembered": 4}
    system = set_(model(short), T=0.13, d=16.6, v0=50)  # steps are 0.05 s
    _, slopes = tangents(system, platoons((3,)), ["mine__d"])
    # each follower is d further back than the one ahead
    assert slopes[0, -1, 0].tolist() == pytest.approx([-2, -1, 0], rel=1e-9)


def test_every_sequence_with_parameters_of_its_own() -> None:
    batch, names = platoons(), ["idm__T", "idm__s0"]
    each = torch.tensor([[0.9, 2.0], [1.4, 3.0], [1.1, 1.5]], dtype=torch.float64)
    places, slopes = tangents(model("idm"), batch, names, each)
    for b, (T, s0) in enumerate(each.tolist()):
        x, wanted = tangents(set_(model("idm"), T=T, s0=s0), batch, names)
        torch.testing.assert_close(places[:, b], x[:, b], rtol=1e-14, atol=0)
        torch.testing.assert_close(slopes[:, :, b], wanted[:, :, b], rtol=1e-12, atol=1e-12)


def test_their_formulas_are_the_slopes_of_the_rate() -> None:
    """Of v0 (1 - L/gap): by v0 the rate 1 - L/gap and v0 L/gap² times the gap's own tangent."""
    once = linear().formula
    assert once is not None
    twice = with_tangents(once, ("lin__v0", "lin__L"))
    assert list(twice.rates) == ["x", "x__d0", "x__d1"]
    assert twice.rates["x"] is once.rates["x"]
    given = {
        "x": 3.0,
        "x_1": 23.0,
        "lin__v0": 25.0,
        "lin__L": 6.0,
        "x__d0": 0.5,
        "x__d0_1": 2.0,
        "x__d1": -1.0,
        "x__d1_1": 0.0,
    }
    values = {k: torch.tensor(v, dtype=torch.float64) for k, v in given.items()}
    by_v0, by_L = Formulas([twice.rates["x__d0"], twice.rates["x__d1"]])(values)
    steep = 25 * 6 / 20**2
    assert float(by_v0) == pytest.approx(1 - 6 / 20 + steep * 1.5, rel=1e-14)
    assert float(by_L) == pytest.approx(-25 / 20 + steep * 1.0, rel=1e-14)
