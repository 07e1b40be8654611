"""Options of the diagnosis."""

from __future__ import annotations

from typing import Any

import pytest

from nnode.diagnosis.options import DiscoverOptions, check_options
from nnode.errors import ConfigError
from nnode.model.effects import CATALOGUE
from tests.diagnosis import stand_in


def test_selection_of_effects() -> None:
    names = [effect.name for effect in CATALOGUE.of("traffic")]
    assert check_options(DiscoverOptions(), "traffic") == names
    names.remove("speed_zone")
    assert check_options(DiscoverOptions(exclude=["speed_zone"]), "traffic") == names
    options = DiscoverOptions(effects=["inertia", "speed_zone"], exclude=["inertia"])
    assert check_options(options, "traffic") == ["speed_zone"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"effects": ["speed_zon"]}, r"discover\.effects: .*did you mean speed_zone\?"),
        ({"exclude": ["inertias"]}, r"discover\.exclude: .*did you mean inertia\?"),
        ({"effects": [stand_in.Wind.name]}, "an effect of crowd models"),
        ({"confirmation": 1.0}, r"discover\.confirmation=1\.0 must lie between 0 and 1"),
        ({"alpha": 0.0}, r"discover\.alpha=0\.0 must lie between 0 and 1"),
        ({"max_effects": -1}, r"discover\.max_effects=-1 must be at least 0"),
        ({"step": 0.0}, r"discover\.step=0\.0 must be a positive number"),
    ],
)
def test_invalid_options(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_options(DiscoverOptions(**change), "traffic")
