"""Which effects a law of people has a place for."""

from __future__ import annotations

import pytest

from nnode.discover.able import not_offered
from nnode.models import Crowd, Relaxation
from nnode.models.effects import CATALOGUE


@pytest.mark.parametrize(("desired", "why"), [("last", ""), ("direction", "preferred speed")])
def test_one_preferred_speed_for_all_where_nobody_has_one(desired: str, why: str) -> None:
    model = Crowd([Relaxation(preferred=desired != "last")], desired=desired)
    found = not_offered(CATALOGUE.effects["preferred_speed"], model)
    assert bool(found) == bool(why)
    assert why in found
    assert not not_offered(CATALOGUE.effects["anticipation"], model)
