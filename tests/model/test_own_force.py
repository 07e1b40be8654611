"""A user's law of people, written as a formula."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from nnode.data.sequence import collate
from nnode.errors import ConfigError
from nnode.model import Crowd, build_model, make_law
from nnode.model.effects import CATALOGUE
from nnode.simulation import FusedSolver
from tests.model.following import rates
from tests.model.test_forces import people

LAW: dict[str, Any] = {
    "parameters": {"A": {"value": "2 m/s²", "low": "0 m/s²"}, "B": "40 cm", "tau": "0.7 s"},
    "where": {"push": "A*exp((2*r - d)/B)"},
    "others": {"push_x": "push*n_x", "push_y": "push*n_y"},
    "rate": {
        "vx": "(speed*way_x - vx)/tau + push_x",
        "vy": "(speed*way_y - vy)/tau + push_y",
    },
}


def formula(**changes: Any) -> Crowd:
    options = {"term": "formula", "name": "mine", "leader": "measured", "effects": []}
    return build_model({**options, "law": {**LAW, **changes}})


def test_formula_equals_built_in_terms() -> None:
    batch, model = collate([people(5, 1), people(3, 2)]), formula()
    repulsion = CATALOGUE.effects["pair_repulsion"](A_2=2.0, B_2=0.4)
    built_in = Crowd([make_law("relaxation", tau=0.7), repulsion])
    rate, expected = (rates(m, batch)[batch.agent] for m in (model, built_in))
    torch.testing.assert_close(rate, expected, rtol=1e-12, atol=1e-12)
    physical = {name: (float(value), unit) for name, (value, unit) in model.physical().items()}
    assert physical == {
        "mine.A": (2.0, "m/s²"),
        "mine.B": (pytest.approx(0.4), "m"),
        "mine.tau": (0.7, "s"),
    }
    with torch.no_grad():
        model.terms[0].A.fill_(-1.0)
    model.project_()
    assert float(model.physical()["mine.A"][0]) == 0.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rate": {"vx": "push_x"}}, "must have two entries, vx and vy"),
        ({"rate": {"vx": "push_x", "vy": "speed"}}, "has the unit m/s, expected m/s"),
        ({"rate": {"vx": "dx/tau**2", "vy": "push_y"}}, "names dx, which there is not in a rate"),
        ({"others": {"push_x": "normal_x", "push_y": "n_y"}}, "not in a sum over others"),
        ({"where": {"push": "A*exp(d)"}}, "the argument .* of exp has the unit m"),
        ({"where": {"push": "A*exp(gap)"}}, "gap is unknown; there are A, B, along_x"),
        ({"others": {"push_x": "A + B", "push_y": "n_y"}}, "which has the unit m/s², and mine.B"),
        ({"crowds": {}}, "unknown entries crowds; there are .*others, points, walls"),
    ],
)
def test_invalid_laws(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        formula(**changes)


def test_law_without_interaction() -> None:
    batch, bare = collate([people(5, 1), people(3, 2)]), Crowd([formula().terms[0].alone()])
    relaxation = Crowd([make_law("relaxation", tau=0.7)])
    rate, expected = (rates(m, batch)[batch.agent] for m in (bare, relaxation))
    torch.testing.assert_close(rate, expected, rtol=1e-12, atol=1e-12)
    with torch.no_grad():
        x, expected = (FusedSolver(0.02)(m, batch).x[batch.valid] for m in (bare, relaxation))
    torch.testing.assert_close(x, expected, rtol=1e-12, atol=1e-12)
