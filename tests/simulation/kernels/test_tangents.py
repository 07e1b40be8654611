"""Derivatives of simulated states by parameters, against closed forms."""

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
from tests.simulation.test_engines import platoons


def tangents(
    system: Traffic, batch: Batch, names: list[str], each: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Positions ``(K, B, N)`` and their derivatives ``(P, K, B, N)``."""
    formula = lanes.supports(system, batch)
    states, slopes = lanes.tangents(system, formula, batch, 2, names, each=each)
    return states[..., 0], slopes[..., 0]


def linear(*effects: dict[str, Any], leader: str = "measured") -> Traffic:
    law = {"term": "lin", "name": "lin", "v0": 25.0, "L": 6.0, "L_min": 2.0}
    return build_model({**law, "leader": leader, "effects": list(effects)})


@pytest.mark.usefixtures("without_compiler")
def test_leader_at_desired_speed() -> None:
    """The leader's position is x = x_0 + v0 t."""
    system = linear({"name": "relative_speed", "kappa": 0.4}, leader="constant")
    _, slopes = tangents(system, platoons(), ["lin__v0"])
    time = DT * torch.arange(6, dtype=torch.float64)
    torch.testing.assert_close(slopes[0, :, 0, 3], time, rtol=1e-13, atol=1e-14)


@pytest.mark.usefixtures("without_compiler")
def test_newell_distance() -> None:
    """Each follower of Newell's law is d behind the path of the vehicle ahead."""
    short = {**CAR_FOLLOWING_LAWS["newell"], "remembered": 4}
    system = set_(model(short), T=0.13, d=16.6, v0=50)  # steps are 0.05 s
    _, slopes = tangents(system, platoons((3,)), ["mine__d"])
    assert slopes[0, -1, 0].tolist() == pytest.approx([-2, -1, 0], rel=1e-9)


def test_parameters_of_each_sequence() -> None:
    batch, names = platoons(), ["idm__T", "idm__s0"]
    each = torch.tensor([[0.9, 2.0], [1.4, 3.0], [1.1, 1.5]], dtype=torch.float64)
    places, slopes = tangents(model("idm"), batch, names, each)
    for b, (T, s0) in enumerate(each.tolist()):
        x, expected = tangents(set_(model("idm"), T=T, s0=s0), batch, names)
        torch.testing.assert_close(places[:, b], x[:, b], rtol=1e-14, atol=0)
        torch.testing.assert_close(slopes[:, :, b], expected[:, :, b], rtol=1e-12, atol=1e-12)


def test_rates_of_tangents() -> None:
    """Of v0 (1 - L/gap): the derivative by the parameter plus v0 L/gap² times the gap's tangent."""
    formula = linear().formula
    extended = with_tangents(formula, ("lin__v0", "lin__L"))
    assert list(extended.rates) == ["x", "x__d0", "x__d1"]
    assert extended.rates["x"] is formula.rates["x"]
    inputs = {
        "x": 3.0,
        "x_1": 23.0,
        "lin__v0": 25.0,
        "lin__L": 6.0,
        "x__d0": 0.5,
        "x__d0_1": 2.0,
        "x__d1": -1.0,
        "x__d1_1": 0.0,
    }
    values = {k: torch.tensor(v, dtype=torch.float64) for k, v in inputs.items()}
    by_v0, by_L = Formulas([extended.rates["x__d0"], extended.rates["x__d1"]])(values)
    steep = 25 * 6 / 20**2
    assert float(by_v0) == pytest.approx(1 - 6 / 20 + steep * 1.5, rel=1e-14)
    assert float(by_L) == pytest.approx(-25 / 20 + steep * 1.0, rel=1e-14)
