"""Effects and terms of the user's own: the engines ask them, or refuse in words."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.app.python.inputs import model_options
from nnode.calibrate.parameters import ParameterVector
from nnode.diagnosis.compare import with_effects
from nnode.diagnosis.eligibility import check_effect, check_model, not_offered
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.options import DiscoverOptions, check_options
from nnode.diagnosis.search import converged_fit
from nnode.diagnosis.statistics.random_effects import estimate_individual
from nnode.diagnosis.statistics.score import traces
from nnode.errors import ConfigError
from nnode.model import Crowd, System, Traffic, make_law
from nnode.model.build import build_model
from nnode.model.effects import CATALOGUE, Effect, IndividualEffect, Strength
from nnode.model.effects.lane import DriverHeterogeneity, Inertia, SpeedZone, gaps
from nnode.model.extend import effects_of, extended
from nnode.model.term import Interval, State, Term
from nnode.model.terms import Rule
from tests.diagnosis.agreement import distance, residuals
from tests.diagnosis.platoons import V0, lin, platoons

ANY = Strength(0.0, 0.1, Interval(0.0, 5.0), "1")


def followers(state: State, change: Tensor) -> Tensor:
    return torch.where(state.scene.follower, change, 0.0)[..., None]


class Haste(IndividualEffect):
    """Every driver adds a speed of his own."""

    name = "haste"
    domain = "traffic"
    formula = "W + eta_i"
    source = "this test"
    strengths: ClassVar = {"sigma": ANY}

    def forward(self, state: State) -> Tensor:
        return followers(state, self.agent_numbers(state.scene, state.x)[0])


class Optimal(Term):
    """A law of the user's own, which is no law of the gap alone."""

    name = "optimal"
    formula = "v0 tanh(gap / d)"
    source = "this test"
    v0: Tensor
    d: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.declare("v0", V0, unit="m/s")
        self.declare("d", 25.0, unit="m", bounds=Interval(5.0, 80.0))

    def forward(self, state: State) -> Tensor:
        return followers(state, self.v0 * torch.tanh(gaps(state.x) / self.d))


@pytest.fixture(scope="module")
def platoon_engine() -> TrafficEngine:
    engine = TrafficEngine(platoons(number=4, driver=0.2))
    engine.fit_whitening(lin(), ParameterVector(lin()).row)
    return engine


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("base", "kind", "own"),
    [
        (lin, Haste, None),
        (lin, Haste, [0.05, -0.1, 0.02, 0.0, 0.0]),
        (lin, DriverHeterogeneity, None),
        (lin, DriverHeterogeneity, [0.05, -0.1, 0.02, 0.0, 0.0]),
        # a pace comes before the reaction to the speed ahead
        (partial(lin, {"name": "relative_speed", "kappa": 0.4}), DriverHeterogeneity, None),
        (partial(build_model, model_options("idm", "measured")), DriverHeterogeneity, None),
    ],
)
def test_a_lane_asks_an_individual_effect_what_it_does(
    platoon_engine: TrafficEngine,
    base: Callable[[], System],
    kind: type[IndividualEffect],
    own: list[float] | None,
) -> None:
    engine, start = platoon_engine, np.array(own or [0.0] * 5)
    step = 1e-3 if kind is DriverHeterogeneity else 0.02

    def model(numbers: np.ndarray) -> System:
        people = dict.fromkeys(engine.names, numbers.tolist())
        found, place = extended(base().double(), kind(people=people))
        found.terms[place].get_parameter("sigma").requires_grad_(False)  # it is in no equation
        return found

    system = model(start) if own else base().double()
    columns = engine.individual(system, ParameterVector(system).row, kind, {})
    before = residuals(engine, model(start))
    for place in range(4):  # the leader's place is the last
        after = residuals(engine, model(start + step * np.eye(5)[place]))
        assert distance(columns[place], (after - before) / step) < 0.06
    assert not columns[4].any()


@pytest.mark.thorough
def test_a_law_of_another_kind_is_diagnosed_in_a_lane() -> None:
    engine = TrafficEngine(platoons(number=4, driver=0.2))
    fit = converged_fit(engine, Traffic([Optimal()], leader="measured"), rounds=1)
    found = []
    for effect in CATALOGUE.of("traffic"):
        if issubclass(effect, IndividualEffect):
            found.append(estimate_individual(engine, fit, effect) is not None)
        else:
            found.append(bool(traces(engine, fit, effect)))
    looked_for = [e.name for e, there in zip(CATALOGUE.of("traffic"), found, strict=True) if there]
    assert {"speed_zone", "relative_speed", "driver_heterogeneity"} <= set(looked_for)
    # these modify a law of the gap, and there is none
    assert not {"reaction_delay", "inertia", "multi_anticipation", "time_gap"} & set(looked_for)


def test_an_effect_on_a_law_that_is_missing_says_so(platoon_engine: TrafficEngine) -> None:
    system = Traffic([Optimal(), Inertia()], leader="measured")
    with pytest.raises(ConfigError, match=r"needs a model with one; derive .*FollowTheLeader"):
        platoon_engine.residuals(system, ParameterVector(system).row[None])


class Moody(IndividualEffect):
    """Every driver reacts late, and by a number of his own."""

    name = "moody"
    domain = "traffic"
    source = "this test"
    rules: ClassVar = {
        1: Rule(
            rate="m",
            states={"m": ("m/s", "eta*(W - m)/unit", "W")},
            inputs={"eta": "1"},
            constants={"unit": (1.0, "s")},
        )
    }
    strengths: ClassVar = {"sigma": ANY}


class Fickle(Haste):
    """As Haste, with two amounts for everybody."""

    name = "fickle"

    @classmethod
    def directions(cls, options: dict[str, Any]) -> list[tuple[dict[str, Any], float]]:
        return [({}, 1.0), ({}, 2.0)]


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        (Moody, "lanes cannot look for moody: it has a memory"),
        (Fickle, "lanes cannot look for fickle: it has 2 amounts for every driver"),
    ],
    ids=["memory and numbers", "two numbers"],
)
def test_what_no_engine_can_look_for_is_refused_before_any_work(
    effect: type[Effect], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(CATALOGUE.effects, effect.name, effect)
    advice = rf"discover\.exclude=\[{effect.name}\]"
    with pytest.raises(ConfigError, match=f"{words}.*{advice}"):
        check_options(DiscoverOptions(), effect.domain)
    left = check_options(DiscoverOptions(exclude=[effect.name]), effect.domain)
    assert effect.name not in left


def test_every_effect_of_the_catalogue_can_be_looked_for() -> None:
    for effect in CATALOGUE.effects.values():
        check_effect(effect)


def test_models_that_no_engine_can_simulate_are_refused() -> None:
    with pytest.raises(ConfigError, match="effect speed_zone twice"):
        check_model(Traffic([Optimal(), SpeedZone(), SpeedZone(a=200.0, b=300.0)]))
    with pytest.raises(ConfigError, match="no parameter that is calibrated"):
        check_model(Crowd([make_law("relaxation", tau=0.5)]))


FORCES = ("anticipation", "field_of_view", "evasive_rotation")


@pytest.mark.parametrize(
    ("name", "model", "options", "reason"),
    [
        ("relative_speed", "idm", {}, ""),
        ("memory", "ovm", {}, "T"),
        ("free_flow_speed", "idm", {}, "acceleration"),
        ("free_flow_speed", "lin", {}, ""),
        ("preferred_speed", "sf", {"desired": "last"}, ""),
        ("preferred_speed", "sf", {"desired": "direction"}, "preferred speed"),
        ("drift", "sf", {"desired": "direction"}, ""),
        *[(name, "sf", {}, "") for name in FORCES],
        *[(name, "gcfm", {}, "no force between people") for name in FORCES],
    ],
)
def test_what_is_offered_depends_on_the_model(
    name: str, model: str, options: dict[str, str], reason: str
) -> None:
    system = build_model({**model_options(model, "measured"), **options})
    found = not_offered(CATALOGUE.effects[name], system)
    assert reason in found
    assert bool(found) == bool(reason)
    if name in FORCES:  # the comparison of laws leaves such an effect out
        (added,) = with_effects({model: system}, [CATALOGUE.effects[name]()]).values()
        assert len(effects_of(added)) == (not reason)


def test_what_is_offered_depends_on_drivers_and_on_the_law_s_order() -> None:
    leader_speed, law = CATALOGUE.effects["leader_speed"], Traffic([make_law("lin")])
    assert "leaders" in not_offered(leader_speed, law, differ=True)
    assert not not_offered(leader_speed, law)
    assert not not_offered(SpeedZone, law, differ=True)
    assert "memory" not in [one.name for one in CATALOGUE.of("traffic")]
    assert "memory" in [one.name for one in CATALOGUE.of("traffic", 2)]
