"""User-defined effects and terms: engines evaluate them or explain why they cannot."""

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

VALUES = [0.05, -0.1, 0.02, 0.0, 0.0]
ANY = Strength(0.0, 0.1, Interval(0.0, 5.0), "1")


def followers(state: State, change: Tensor) -> Tensor:
    return torch.where(state.scene.follower, change, 0.0)[..., None]


class Haste(IndividualEffect):
    """An offset of the speed for every driver."""

    name = "haste"
    domain = "traffic"
    formula = "W + eta_i"
    source = "this test"
    strengths: ClassVar = {"sigma": ANY}

    def forward(self, state: State) -> Tensor:
        return followers(state, self.agent_numbers(state.scene, state.x)[0])


class Optimal(Term):
    """A user-defined law that is no :class:`FollowTheLeader`."""

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
    ("base", "kind", "values"),
    [
        (lin, Haste, None),
        (lin, Haste, VALUES),
        (lin, DriverHeterogeneity, None),
        (lin, DriverHeterogeneity, VALUES),
        # the individual speed acts before the reaction to the speed ahead
        (partial(lin, {"name": "relative_speed", "kappa": 0.4}), DriverHeterogeneity, None),
        (partial(build_model, model_options("idm", "measured")), DriverHeterogeneity, None),
    ],
)
def test_individual_columns_are_finite_differences(
    platoon_engine: TrafficEngine,
    base: Callable[[], System],
    kind: type[IndividualEffect],
    values: list[float] | None,
) -> None:
    engine, start = platoon_engine, np.array(values or [0.0] * 5)
    step = 1e-3 if kind is DriverHeterogeneity else 0.02

    def model(values: np.ndarray) -> System:
        people = dict.fromkeys(engine.names, values.tolist())
        system, place = extended(base().double(), kind(people=people))
        system.terms[place].get_parameter("sigma").requires_grad_(False)  # it is in no equation
        return system

    system = model(start) if values else base().double()
    columns = engine.individual(system, ParameterVector(system).row, kind, {})
    before = residuals(engine, model(start))
    for place in range(4):  # the leader is the last
        after = residuals(engine, model(start + step * np.eye(5)[place]))
        assert distance(columns[place], (after - before) / step) < 0.06
    assert not columns[4].any()


@pytest.mark.thorough
def test_effects_of_user_defined_law() -> None:
    engine = TrafficEngine(platoons(number=4, driver=0.2))
    fit = converged_fit(engine, Traffic([Optimal()], leader="measured"), rounds=1)

    def has_estimate(effect: type[Effect]) -> bool:
        if issubclass(effect, IndividualEffect):
            return estimate_individual(engine, fit, effect) is not None
        return bool(traces(engine, fit, effect))

    names = {effect.name for effect in CATALOGUE.of("traffic") if has_estimate(effect)}
    assert names >= {"speed_zone", "relative_speed", "driver_heterogeneity"}
    # these modify a law of the gap
    assert not names & {"reaction_delay", "inertia", "multi_anticipation", "time_gap"}


def test_effect_without_its_law_is_an_error(platoon_engine: TrafficEngine) -> None:
    system = Traffic([Optimal(), Inertia()], leader="measured")
    with pytest.raises(ConfigError, match=r"needs a model with one; derive .*FollowTheLeader"):
        platoon_engine.residuals(system, ParameterVector(system).row[None])


class IndividualMemory(IndividualEffect):
    """Every driver reacts late, with an individual strength."""

    name = "individual_memory"
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


class TwoAmounts(Haste):
    """The same effect with two amounts for every driver."""

    name = "two_amounts"

    @classmethod
    def directions(cls, options: dict[str, Any]) -> list[tuple[dict[str, Any], float]]:
        return [({}, 1.0), ({}, 2.0)]


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (IndividualMemory, "lanes cannot look for individual_memory: it has a memory"),
        (TwoAmounts, "lanes cannot look for two_amounts: it has 2 amounts for every driver"),
    ],
)
def test_effects_that_no_engine_can_estimate(
    effect: type[Effect], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(CATALOGUE.effects, effect.name, effect)
    advice = rf"discover\.exclude=\[{effect.name}\]"
    with pytest.raises(ConfigError, match=f"{message}.*{advice}"):
        check_options(DiscoverOptions(), effect.domain)
    names = check_options(DiscoverOptions(exclude=[effect.name]), effect.domain)
    assert effect.name not in names


def test_all_effects_of_catalogue_can_be_estimated() -> None:
    for effect in CATALOGUE.effects.values():
        check_effect(effect)


def test_models_that_no_engine_can_simulate() -> None:
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
        ("preferred_speed", "sf", {"desired": "direction"}, "has a desired speed"),
        ("drift", "sf", {"desired": "direction"}, ""),
        *[(name, "sf", {}, "") for name in FORCES],
        *[(name, "gcfm", {}, "no force between people") for name in FORCES],
    ],
)
def test_offered_effects_depend_on_model(
    name: str, model: str, options: dict[str, str], reason: str
) -> None:
    system = build_model({**model_options(model, "measured"), **options})
    message = not_offered(CATALOGUE.effects[name], system)
    assert reason in message
    assert bool(message) == bool(reason)
    if name in FORCES:  # the comparison of laws does not add such an effect either
        (added,) = with_effects({model: system}, [CATALOGUE.effects[name]()]).values()
        assert len(effects_of(added)) == (not reason)


def test_offered_effects_depend_on_drivers_and_order() -> None:
    leader_speed, law = CATALOGUE.effects["leader_speed"], Traffic([make_law("lin")])
    assert "leaders" in not_offered(leader_speed, law, differ=True)
    assert not not_offered(leader_speed, law)
    assert not not_offered(SpeedZone, law, differ=True)
    names = [{effect.name for effect in CATALOGUE.of("traffic", order)} for order in (1, 2)]
    assert ["memory" in offered for offered in names] == [False, True]
