"""A law of people of one's own, written as a formula."""

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


def own(**changes: Any) -> Crowd:
    options = {"term": "formula", "name": "mine", "leader": "measured", "effects": []}
    model = build_model({**options, "law": {**LAW, **changes}})
    assert isinstance(model, Crowd)
    return model


def same() -> Crowd:
    """The same of terms of the package."""
    more = CATALOGUE.effects["pair_repulsion"](A_2=2.0, B_2=0.4)
    return Crowd([make_law("relaxation", tau=0.7), more])


def test_it_computes_what_it_says() -> None:
    batch, model = collate([people(5, 1), people(3, 2)]), own()
    found, wanted = (rates(m, batch)[batch.agent] for m in (model, same()))
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12)
    physical = {name: (float(value), unit) for name, (value, unit) in model.physical().items()}
    assert physical == {
        "mine.A": (2.0, "m/s²"),
        "mine.B": (pytest.approx(0.4), "m"),
        "mine.tau": (0.7, "s"),
    }
    with torch.no_grad():
        model.terms[0].A.fill_(-1.0)  # type: ignore[union-attr, operator]
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
def test_what_is_wrong_is_told(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        own(**changes)


def test_without_interaction_it_is_its_drive() -> None:
    batch, model = collate([people(5, 1), people(3, 2)]), own()
    bare = Crowd([model.terms[0].alone()])  # type: ignore[union-attr, operator]
    drive = Crowd([make_law("relaxation", tau=0.7)])
    found, wanted = (rates(m, batch)[batch.agent] for m in (bare, drive))
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12)
    with torch.no_grad():
        found, wanted = (FusedSolver(0.02)(m, batch).x[batch.valid] for m in (bare, drive))
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12)
