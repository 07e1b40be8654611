"""Where the calibration of an effect begins, when another law has shown that it is missing."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from nnode.app.python.inputs import model_options
from nnode.diagnosis import candidate
from nnode.diagnosis.search import _hinted
from nnode.errors import SimulationError
from nnode.model import System, build_model
from nnode.model.effects import CATALOGUE
from nnode.model.extend import effects_of

ZONE = {"name": "speed_zone", "alpha": 0.5, "a": 10.0, "b": 90.0}
LATE = {"name": "reaction_delay", "T": 0.7}


def lin(*effects: dict[str, Any]) -> System:
    return build_model({**model_options("lin", "measured"), "effects": list(effects)}, 0)


def names(*hints: System) -> list[set[str]]:
    return [{effect.name for effect in effects_of(hint)} for hint in hints]


def test_a_hint_has_the_model_s_effects_and_one_more() -> None:
    hint = lin(ZONE, LATE)
    assert names(*_hinted([hint, lin(LATE)], lin(), "speed_zone")) == [{"speed_zone"}]
    assert names(*_hinted([hint], lin(LATE), "speed_zone")) == [{"speed_zone", "reaction_delay"}]
    assert names(*_hinted([hint, lin(LATE)], lin(), "reaction_delay")) == 2 * [{"reaction_delay"}]
    assert not _hinted([hint], lin(), "inertia")
    assert not _hinted([hint], lin({"name": "inertia", "tau_v": 0.5}), "speed_zone")
    assert not _hinted([], lin(), "speed_zone")
    assert names(hint) == [{"speed_zone", "reaction_delay"}]


@pytest.mark.parametrize(
    ("own", "hinted", "best"),
    [
        (9.0, 4.0, 4.0),
        (3.0, 4.0, 3.0),
        (None, 4.0, 4.0),
        (3.0, None, 3.0),
        (None, None, None),  # None: the calibration from this start blows up
    ],
)
def test_the_better_of_two_starts_counts(
    monkeypatch: pytest.MonkeyPatch, own: float | None, hinted: float | None, best: float | None
) -> None:
    hint = lin(LATE)

    def refine(engine: Any, system: System, **how: Any) -> Any:
        cost = hinted if system is hint else own
        if cost is None:
            raise SimulationError("it blows up")
        return SimpleNamespace(cost=cost)

    def calibrated() -> Any:
        score: Any = SimpleNamespace(effect=CATALOGUE.effects["reaction_delay"], options={})
        before: Any = SimpleNamespace(system=lin())
        engine: Any = None
        return candidate.calibrated(engine, before, score, 0.0, [hint])

    monkeypatch.setattr(candidate, "refine", refine)
    if best is None:
        with pytest.raises(SimulationError, match="reaction_delay blows up on these data"):
            calibrated()
    else:
        assert calibrated().cost == best
