"""Effects and terms of the user's own: the engines ask them, or refuse in words."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.discover.crowds.engine import CrowdEngine
from nnode.discover.eligibility import check_effect, check_model, not_offered
from nnode.discover.lanes.engine import TrafficEngine
from nnode.discover.name.search import converged_fit
from nnode.discover.options import DiscoverOptions, check_options
from nnode.discover.residuals.fit import evaluated
from nnode.discover.statistics.random_effects import estimate_individual
from nnode.discover.statistics.score import traces
from nnode.errors import ConfigError
from nnode.model import Crowd, System, Traffic, make_law
from nnode.model.build import build_model
from nnode.model.crowd import norm
from nnode.model.effects import CATALOGUE, Effect, IndividualEffect, Probe, Setting, Strength
from nnode.model.effects.crowd import GaitSway, heading
from nnode.model.effects.lane import DriverHeterogeneity, Inertia, SpeedZone, gaps
from nnode.model.extend import extended
from nnode.model.term import Interval, State, Term
from nnode.model.terms import Rule
from tests.discover import walkers
from tests.discover.platoons import LENGTH, V0, platoons

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


class Stride(IndividualEffect):
    """People speed up and slow down as they step."""

    name = "stride"
    domain = "crowd"
    formula = "a sin(2 pi t + phase_i) along the way"
    source = "this test"
    strengths: ClassVar = {"a": ANY}
    a: Tensor

    @classmethod
    def directions(cls, options: dict[str, Any]) -> list[tuple[dict[str, Any], float]]:
        return [({"a": 1.0}, 0.0), ({"a": 1.0}, math.pi / 2)]

    def forward(self, state: State) -> Tensor:
        phase, there = self.agent_numbers(state.scene, state.x)
        clock = (state.scene.start + state.t)[:, None]
        size = self.a * torch.sin(2 * torch.pi * clock + phase) * there
        return size[..., None] * heading(state.velocity)


class Limit(Effect):
    """Nobody likes to walk faster than this."""

    name = "limit"
    domain = "crowd"
    formula = "-(|v| - v_max)+ e / s"
    source = "this test"
    strengths: ClassVar = {}
    settings: ClassVar = {"v_max": Setting(1.2, Interval(0.5, 3.0), "m/s")}
    v_max: Tensor

    def forward(self, state: State) -> Tensor:
        v = state.velocity
        return -(norm(v) - self.v_max).clamp(min=0)[..., None] * heading(v)


class Faint(Limit):
    """A hundredth of it: as weak as linear response asks for."""

    def forward(self, state: State) -> Tensor:
        return 0.01 * super().forward(state)


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


def lane() -> System:
    options = {"leader": "measured", "v0": V0, "L": LENGTH, "L_min": 1.0}
    return build_model({"term": "lin", "name": "lin", **options})


def crowd(*more: Term) -> Crowd:
    force = make_law("social_force", A=walkers.A, k=0.0, kappa=0.0, B=walkers.B)
    return Crowd([make_law("relaxation", tau=walkers.TAU), force, *more])


@pytest.fixture(scope="module")
def platoon_engine() -> TrafficEngine:
    engine = TrafficEngine(platoons(number=4, driver=0.2))
    engine.fit_whitening(lane(), ParameterVector(lane()).row)
    return engine


@pytest.fixture(scope="module")
def crowd_engine() -> CrowdEngine:
    engine = CrowdEngine(walkers.crowd(sequences=3))
    engine.fit_whitening(crowd(), ParameterVector(crowd()).row)
    return engine


def apart(found: Tensor, expected: Tensor) -> float:
    """Distance relative to what is expected."""
    return float((found - expected).norm() / expected.norm())


@pytest.mark.parametrize("own", [{}, {"people": [0.05, -0.1, 0.02, 0.0, 0.0]}])
@pytest.mark.parametrize("kind", [Haste, DriverHeterogeneity])
def test_a_lane_asks_an_individual_effect_what_it_does(
    platoon_engine: TrafficEngine, kind: type[IndividualEffect], own: dict[str, list[float]]
) -> None:
    engine, start = platoon_engine, own.get("people", [0.0] * 5)
    step = 1e-3 if kind is DriverHeterogeneity else 0.02

    def model(numbers: np.ndarray) -> System:
        people = dict.fromkeys(engine.names, numbers.tolist())
        found, _ = extended(lane(), kind(people=people))
        found.terms[-1].get_parameter("sigma").requires_grad_(False)  # it is in no equation
        return found

    system = model(np.array(start)) if own else lane()
    row = ParameterVector(lane()).row
    found = engine.individual(system, row, kind, {})
    before = engine.residuals(model(np.array(start)), row[None])[0]
    for place in range(4):  # the leader's place is the last
        numbers = np.array(start)
        numbers[place] += step
        after = engine.residuals(model(numbers), row[None])[0]
        assert apart(found[place], (after - before) / step) < 0.06
    assert not found[4].any()


def test_two_individual_effects_have_different_columns(platoon_engine: TrafficEngine) -> None:
    row = ParameterVector(lane()).row
    ours, theirs = (
        platoon_engine.individual(lane(), row, kind, {}) for kind in (Haste, DriverHeterogeneity)
    )
    assert apart(ours, theirs) > 0.5


def test_a_crowd_asks_an_individual_effect_for_its_amounts(crowd_engine: CrowdEngine) -> None:
    engine, row = crowd_engine, ParameterVector(crowd()).row
    sine, cosine = engine.individual(crowd(), row, Stride, {})
    people = dict.fromkeys(engine.names, [0.9] * 6)
    system = crowd(Stride(people=people, a=0.05))
    change = engine.residuals(system, ParameterVector(system).row[None])[0]
    change = change - engine.residuals(crowd(), row[None])[0]
    expected = 0.05 * (math.cos(0.9) * sine + math.sin(0.9) * cosine)
    assert apart(change, expected) < 0.1
    assert len(GaitSway.directions({"f": 0.9})) == 2


def test_a_crowd_looks_for_an_effect_without_strengths(crowd_engine: CrowdEngine) -> None:
    engine, row = crowd_engine, ParameterVector(crowd()).row
    assert Limit.probes(engine.batch, crowd()) == [Probe({}, {})]
    (trace,) = traces(engine, evaluated(engine, crowd()), Limit)
    system = crowd(Faint())
    change = engine.residuals(system, ParameterVector(system).row[None])[0]
    change = change - engine.residuals(crowd(), row[None])[0]
    assert trace.columns.shape == (len(change), 1)
    assert apart(torch.from_numpy(trace.columns[:, 0]), change / 0.01) < 0.02


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


def test_leaders_that_move_as_measured_are_not_tested() -> None:
    leader_speed, law = CATALOGUE.effects["leader_speed"], Traffic([make_law("lin")])
    assert "leaders" in not_offered(leader_speed, law, differ=True)
    assert not not_offered(leader_speed, law)
    assert not not_offered(SpeedZone, law, differ=True)
