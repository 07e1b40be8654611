"""How the parameters of a model's terms are addressed."""

from __future__ import annotations

import pytest

from nnode.model import System, build_model
from nnode.model.build import add_effects
from nnode.model.effects.lane import SpeedZone
from nnode.model.laws import make_law
from nnode.model.term import short_names

LAW = {"term": "lin", "name": "lin", "leader": "constant", "v0": 30.0, "L": 5.0, "L_min": 2.0}


def model(*effects: str) -> System:
    found = build_model(LAW)
    for name in effects:
        add_effects(found, [{"name": name, "alpha": 0.7}])
    return found


@pytest.mark.parametrize("others", [(), ("speed_zone",)])
def test_an_address_does_not_depend_on_other_terms(others: tuple[str, ...]) -> None:
    physical = model(*others, "speed_period").physical()
    assert float(physical["speed_period.alpha"][0]) == 0.7
    assert physical["lin.v0"][1] == "m/s"
    assert len(physical) == 2 + 3 * (1 + len(others))


def test_two_terms_of_one_name_are_told_apart() -> None:
    two = System([make_law("lin", v0=30.0), SpeedZone(alpha=0.7), SpeedZone(alpha=0.9)])
    physical = {name: float(value) for name, (value, _) in two.physical().items()}
    assert (physical["speed_zone.alpha"], physical["speed_zone_2.alpha"]) == (0.7, 0.9)


def test_printed_names_are_short_where_one_term_alone_has_them() -> None:
    two = model("speed_zone", "speed_period").physical()
    assert short_names(two) == {
        "lin.v0": "v0",
        "lin.L": "L",
        **{name: name for name in list(two)[2:]},
    }
    assert "v0=30 m/s" in repr(model())
    assert "speed_zone.alpha=0.7 1" in repr(model("speed_zone", "speed_period"))
