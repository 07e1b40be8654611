"""Models with effects of the catalogue: the same states and gradient from both solvers."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from nnode.model import System, build_model
from nnode.simulate import FusedSolver, TorchdiffeqSolver
from tests.discover import stand_in  # noqa: F401 - registers an effect of crowds
from tests.simulate.fused.compare import difference, gradient, single

DT = 0.02

LAW = {"name": "lin", "term": "lin", "v0": 18.0, "L": 4.0, "L_min": 2.0}
FORCE = {
    "name": "sf", "term": "social_force", "A": 2.0, "k": 30.0, "kappa": 9.0, "r": 0.25, "B": 0.1,
    "mass": 1.0, "walls": True, "wall_spacing": 0.25, "tau": 0.5, "opposing_wall_friction": False,
}  # fmt: skip

EFFECTS: dict[str, list[dict[str, Any]]] = {
    "one": [{"name": "relative_speed", "kappa": 0.3}],
    "zone": [{"name": "speed_zone", "alpha": 0.7, "a": 10.0, "b": 40.0}],
    "several": [
        {"name": "reaction_delay", "T": 0.4},
        {"name": "relative_speed", "kappa": 0.3},
        {"name": "speed_zone", "alpha": 0.7, "a": 10.0, "b": 40.0},
    ],
    "memory": [{"name": "reaction_delay", "T": 0.4}, {"name": "inertia", "tau_v": 0.5}],
}


def check(model: System, batch: Any) -> None:
    exact, wanted = gradient(model, TorchdiffeqSolver("euler", "discrete", DT), batch)
    found, own = gradient(model, FusedSolver(DT), batch)
    torch.testing.assert_close(found.x, exact.x, rtol=1e-12, atol=1e-11)
    assert wanted.abs().max() > 0
    assert difference(own, wanted) < 1e-10


@pytest.mark.parametrize("leader", ["constant", "measured"])
@pytest.mark.parametrize(
    "effects",
    [
        *(pytest.param(name, marks=pytest.mark.thorough) for name in ("one", "zone")),
        "several",
        "memory",
    ],
)
def test_traffic_with_effects(effects: str, leader: str, ragged: Any) -> None:
    model = build_model({**LAW, "leader": leader, "effects": EFFECTS[effects]})
    check(model, single(ragged))


def test_a_crowd_with_an_effect(crowd: Any) -> None:
    model = build_model({**FORCE, "effects": [{"name": "made_up_wind", "w_x": 0.2, "w_y": 0.1}]})
    check(model, single([crowd(3, samples=4, name="a"), crowd(2, samples=3, name="b")]))


def test_no_compiled_law_ignores_an_effect(ragged: Any) -> None:
    batch = single(ragged)
    plain = FusedSolver(DT)(build_model({**LAW, "leader": "constant"}), batch)
    slow = build_model({**LAW, "leader": "constant", "effects": EFFECTS["several"]})
    assert (FusedSolver(DT)(slow, batch).x - plain.x).abs().max() > 0.01
