"""Which effects a law of people has a place for."""

from __future__ import annotations

import pytest

from nnode.app.python.inputs import model_options
from nnode.discover.compare.laws import with_effects
from nnode.discover.eligibility import not_offered
from nnode.model import Crowd, build_model, make_law
from nnode.model.effects import CATALOGUE
from nnode.model.extend import effects_of


@pytest.mark.parametrize(("desired", "why"), [("last", ""), ("direction", "preferred speed")])
def test_one_preferred_speed_for_all_where_nobody_has_one(desired: str, why: str) -> None:
    model = Crowd([make_law("relaxation", preferred=desired != "last")], desired=desired)
    found = not_offered(CATALOGUE.effects["preferred_speed"], model)
    assert bool(found) == bool(why)
    assert why in found
    assert not not_offered(CATALOGUE.effects["drift"], model)


@pytest.mark.parametrize("name", ["anticipation", "field_of_view", "evasive_rotation"])
def test_what_changes_a_force_needs_one(name: str) -> None:
    """Laws that are one formula have none of their own: the comparison of laws leaves such effects
    out, and does not end in an error."""
    effect = CATALOGUE.effects[name]
    assert not not_offered(effect, build_model(model_options("sf"), 0))
    gcfm = build_model(model_options("gcfm"), 0)
    assert "no force between people" in not_offered(effect, gcfm)
    assert effects_of(with_effects({"gcfm": gcfm}, [effect()])["gcfm"]) == []
