"""Base laws are ranked on clusters that their calibration left out."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import nnode
from benchmarks import drivers
from benchmarks.synthetic_cases.laws import measured
from nnode.app.compared_laws import LAWS, compared_laws
from nnode.app.python.inputs import model_options
from nnode.calibrate.parameters import ParameterVector
from nnode.diagnosis.compare import BetterLaw, compare_laws, explained_by_law, with_effects
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.lanes.followers import FollowersEngine
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.residuals.fit import Fit, refine
from nnode.diagnosis.search import Selection, Step, converged_fit, initial_fit, without_steps
from nnode.errors import ConfigError
from nnode.model import System, build_model
from nnode.model.effects import CATALOGUE
from nnode.model.extend import effects_of, extended
from tests.diagnosis import walkers
from tests.diagnosis.platoons import platoons


def law(name: str) -> System:
    return build_model(model_options(name, "measured"), 0)


def selection(fit: Fit, effect: str) -> Selection:
    """Of a search that added one effect."""
    kind = CATALOGUE.effects[effect]
    chosen = SimpleNamespace(name=effect, score=SimpleNamespace(effect=kind))
    return Selection(fit, [Step(chosen, [])])


@pytest.mark.thorough
@pytest.mark.parametrize("true", ["idm", "lin"])
def test_the_true_law_comes_first(true: str) -> None:
    table, parameters = measured(true, 5, sequences=24, vehicles=4, seconds=20.0)
    sequences = list(nnode.sequences(table))
    laws = {n: law(n) for n in ("lin", "idm", "helly")}
    found, calibrated = compare_laws(laws, true, sequences, DiscoverOptions())
    assert set(calibrated) == set(laws)
    assert found.ranking[0].name == found.best == true
    assert found.ranking[0].behind == 0.0 < found.ranking[1].behind
    assert found.ranking[1].p_value < 0.01
    first = {name.partition(".")[2]: value for name, (value, _) in found.ranking[0].values.items()}
    name = "T" if true == "idm" else "L"
    assert first[name] == pytest.approx(parameters[name], rel=0.15)


@pytest.mark.thorough
def test_laws_are_compared_with_drivers_who_differ() -> None:
    """With one parameter for all drivers, laws that imitate differences came first."""
    sequences = list(nnode.sequences(drivers.platoons("idm", "none", 0.15, 6011, number=10)))
    laws = {n: law(n) for n in ("fvdm", "idm")}
    laws["other"] = extended(law("idm"), CATALOGUE.effects["leader_speed"]())[0]
    found, calibrated = compare_laws(laws, "idm", sequences, DiscoverOptions())
    assert found.likelihood
    assert found.best == "idm"
    assert found.ranking[1].p_value < 0.01
    assert found.ranking[0].values["idm.T"][0] == pytest.approx(drivers.T, rel=0.1)
    assert min(found.ranking, key=lambda one: one.error).name != "idm"
    assert "no formula" in found.refused["other"]
    engine = FollowersEngine(sequences)
    nearer = BetterLaw("idm", calibrated["idm"])
    kind = CATALOGUE.effects["multi_anticipation"]
    fit = initial_fit(engine, extended(law("fvdm").double(), kind())[0])
    chosen = selection(fit, "multi_anticipation")
    steps, p_value = explained_by_law(engine, chosen, np.arange(len(sequences)), nearer)
    assert len(steps) == 1
    assert p_value < 0.01


@pytest.mark.thorough
def test_the_search_of_a_law_begins_at_its_most_likely_start() -> None:
    sequences = list(nnode.sequences(drivers.platoons("lin", "none", 0.15, 6013, number=6)))
    engine, good = FollowersEngine(sequences), law("lin").double()
    distant = ParameterVector(law("lin").double()).fill_(np.array([8.0, 2.0]))
    alone, calibrated = engine.log_likelihoods(good)
    best, _ = engine.log_likelihoods(distant, good)
    np.testing.assert_array_equal(best, alone)
    assert not np.array_equal(best, engine.log_likelihoods(distant)[0])  # of another start
    assert float(calibrated.physical()["lin.L"][0]) == pytest.approx(drivers.LENGTH, rel=0.05)


def test_what_cannot_be_simulated_is_told() -> None:
    models = {"lin": law("lin"), "newell": law("newell")}
    before = ParameterVector(models["lin"]).row
    made = platoons(number=6, seconds=12.0, driver=0.2)
    found, _ = compare_laws(models, "lin", made, DiscoverOptions())
    assert [one.name for one in found.ranking] == ["lin"]
    assert "step by step" in found.refused["newell"]
    assert ParameterVector(models["lin"]).row.tolist() == before.tolist()


def test_people_are_compared_too() -> None:
    sequences = walkers.crowd()
    laws = {n: law(n) for n in ("sf", "ttc", "cfsm")}
    found, _ = compare_laws(laws, "sf", sequences, DiscoverOptions())
    assert {one.name for one in found.ranking} == {"sf", "ttc"}
    assert "first order" in found.refused["cfsm"]


def test_which_laws_are_compared() -> None:
    asked = law("lin")
    lin = {"name": "lin"}
    every = compared_laws(lin, asked, DiscoverOptions())
    assert set(every) == set(LAWS["traffic"])
    assert every["lin"] is not asked
    few = compared_laws({"name": "own"}, asked, DiscoverOptions(compare=["idm"]))
    assert list(few) == ["idm", "own"]
    assert compared_laws(lin, asked, DiscoverOptions(compare=[])) == {}
    with pytest.raises(ConfigError, match=r"no model idn.*expected some of lin"):
        compared_laws(lin, asked, DiscoverOptions(compare=["idn"]))
    with pytest.raises(ConfigError, match="sf is a crowd model"):
        compared_laws(lin, asked, DiscoverOptions(compare=["sf"]))
    people = {**model_options("sf", "measured"), "desired": "direction"}
    others = compared_laws(people, build_model(people, 0), DiscoverOptions())
    assert {model.desired for model in others.values()} == {"direction"}


def test_effects_go_to_the_laws_that_have_a_place_for_them() -> None:
    laws = {"lin": law("lin"), "idm": law("idm"), "fvdm": law("fvdm")}
    memory, zone = (
        CATALOGUE.effects["memory"](tau_m=12.0),
        CATALOGUE.effects["speed_zone"](alpha=0.5, a=10.0, b=90.0),
    )
    found = with_effects(laws, [memory, zone])
    names = {n: [effect.name for effect in effects_of(one)] for n, one in found.items()}
    assert names == {"lin": ["speed_zone"], "idm": ["speed_zone", "memory"], "fvdm": ["speed_zone"]}
    assert effects_of(found["lin"])[0].options() == zone.options()
    assert not effects_of(laws["idm"])
    again = with_effects(found, [zone])
    assert [effect.name for effect in effects_of(again["lin"])] == ["speed_zone"]


@pytest.mark.thorough
def test_what_a_nearer_law_does_without_is_no_finding() -> None:
    """Behind ``ovm`` a law of the gap alone answers late, which it imitates by looking two ahead;
    what laws have in themselves, such as an inertia, is right to be missed."""
    table, _ = measured("ovm", 3, sequences=12, vehicles=4, seconds=20.0)
    sequences = list(nnode.sequences(table))
    label = np.arange(len(sequences))
    engine = TrafficEngine(sequences, clusters=label)
    base = converged_fit(engine, initial_fit(engine, law("lin").double()).system)

    def added(name: str) -> Selection:
        return selection(refine(engine, extended(base.system, CATALOGUE.effects[name]())[0]), name)

    other = initial_fit(engine, law("ovm").double())
    nearer = BetterLaw("ovm", other.system)
    ahead = added("multi_anticipation")
    taken, p_value = explained_by_law(engine, ahead, label, nearer)
    assert [step.chosen.name for step in taken] == ["multi_anticipation"]
    assert p_value < 0.05
    assert explained_by_law(engine, added("inertia"), label, nearer)[0] == []
    same = replace(nearer, named=frozenset({"multi_anticipation"}))
    assert explained_by_law(engine, ahead, label, same)[0] == []
    # the other way round nothing is taken back: lin predicts no better than ovm
    far = BetterLaw("lin", base.system)
    assert explained_by_law(engine, replace(ahead, fit=other), label, far)[0] == []
    left = without_steps(engine, ahead, taken, base.system)
    assert left.steps == []
    assert effects_of(left.fit.system) == []
