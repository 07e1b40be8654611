"""Comparison of laws on held-out clusters."""

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
    """The result of a search that added one effect."""
    score = SimpleNamespace(effect=CATALOGUE.effects[effect])
    chosen = SimpleNamespace(name=effect, score=score)
    return Selection(fit, [Step(chosen, [])])


@pytest.mark.thorough
@pytest.mark.parametrize("true", ["idm", "lin"])
def test_true_law_is_best(true: str) -> None:
    table, parameters = measured(true, 5, sequences=24, vehicles=4, seconds=20.0)
    sequences = list(nnode.sequences(table))
    laws = {n: law(n) for n in ("lin", "idm", "helly")}
    result, calibrated = compare_laws(laws, true, sequences, DiscoverOptions())
    assert set(calibrated) == set(laws)
    first, second, _ = result.ranking
    assert first.name == result.best == true
    assert first.behind == 0.0 < second.behind
    assert second.p_value < 0.01
    name = "T" if true == "idm" else "L"
    assert first.values[f"{true}.{name}"][0] == pytest.approx(parameters[name], rel=0.15)


@pytest.mark.thorough
def test_comparison_with_different_drivers() -> None:
    """With equal parameters of all drivers, laws that imitate differences would be best."""
    sequences = list(nnode.sequences(drivers.platoons("idm", "none", 0.15, 6011, number=10)))
    laws = {n: law(n) for n in ("fvdm", "idm")}
    laws["other"] = extended(law("idm"), CATALOGUE.effects["leader_speed"]())[0]
    result, calibrated = compare_laws(laws, "idm", sequences, DiscoverOptions())
    assert result.likelihood
    assert result.best == "idm"
    assert result.ranking[1].p_value < 0.01
    assert result.ranking[0].values["idm.T"][0] == pytest.approx(drivers.T, rel=0.1)
    assert min(result.ranking, key=lambda compared: compared.error).name != "idm"
    assert "no formula" in result.refused["other"]
    engine, name = FollowersEngine(sequences), "multi_anticipation"
    better = BetterLaw("idm", calibrated["idm"])
    fit = initial_fit(engine, extended(law("fvdm").double(), CATALOGUE.effects[name]())[0])
    label = np.arange(len(sequences))
    steps, p_value = explained_by_law(engine, selection(fit, name), label, better)
    assert len(steps) == 1
    assert p_value < 0.01


@pytest.mark.thorough
def test_likelihood_uses_best_start() -> None:
    sequences = list(nnode.sequences(drivers.platoons("lin", "none", 0.15, 6013, number=6)))
    engine, good = FollowersEngine(sequences), law("lin").double()
    distant = ParameterVector(law("lin").double()).fill_(np.array([8.0, 2.0]))
    alone, calibrated = engine.log_likelihoods(good)
    best, _ = engine.log_likelihoods(distant, good)
    np.testing.assert_array_equal(best, alone)
    assert not np.array_equal(best, engine.log_likelihoods(distant)[0])
    assert float(calibrated.physical()["lin.L"][0]) == pytest.approx(drivers.LENGTH, rel=0.05)


@pytest.mark.parametrize("domain", ["traffic", "crowd"])
def test_laws_that_cannot_be_compared(domain: str) -> None:
    if domain == "traffic":
        names, refused, reason = ["lin"], "newell", "step by step"
        sequences = platoons(number=6, seconds=12.0, driver=0.2)
    else:
        names, refused, reason = ["sf", "ttc"], "cfsm", "first order"
        sequences = walkers.crowd()
    laws = {name: law(name) for name in (*names, refused)}
    before = ParameterVector(laws[names[0]]).row
    result, _ = compare_laws(laws, names[0], sequences, DiscoverOptions())
    assert {compared.name for compared in result.ranking} == set(names)
    assert reason in result.refused[refused]
    assert ParameterVector(laws[names[0]]).row.tolist() == before.tolist()


def test_selection_of_compared_laws() -> None:
    model, lin = law("lin"), {"name": "lin"}
    laws = compared_laws(lin, model, DiscoverOptions())
    assert set(laws) == set(LAWS["traffic"])
    assert laws["lin"] is not model
    chosen = compared_laws({"name": "own"}, model, DiscoverOptions(compare=["idm"]))
    assert list(chosen) == ["idm", "own"]
    assert compared_laws(lin, model, DiscoverOptions(compare=[])) == {}
    with pytest.raises(ConfigError, match=r"no model idn.*expected some of lin"):
        compared_laws(lin, model, DiscoverOptions(compare=["idn"]))
    with pytest.raises(ConfigError, match="sf is a crowd model"):
        compared_laws(lin, model, DiscoverOptions(compare=["sf"]))
    people = {**model_options("sf", "measured"), "desired": "direction"}
    laws = compared_laws(people, build_model(people, 0), DiscoverOptions())
    assert {model.desired for model in laws.values()} == {"direction"}


def test_effects_are_added_to_suitable_laws() -> None:
    laws = {name: law(name) for name in ("lin", "idm", "fvdm")}
    memory = CATALOGUE.effects["memory"](tau_m=12.0)
    zone = CATALOGUE.effects["speed_zone"](alpha=0.5, a=10.0, b=90.0)
    changed = with_effects(laws, [memory, zone])
    names = {name: [e.name for e in effects_of(model)] for name, model in changed.items()}
    assert names == {"lin": ["speed_zone"], "idm": ["speed_zone", "memory"], "fvdm": ["speed_zone"]}
    assert effects_of(changed["lin"])[0].options() == zone.options()
    assert not effects_of(laws["idm"])
    repeated = with_effects(changed, [zone])
    assert [effect.name for effect in effects_of(repeated["lin"])] == ["speed_zone"]


@pytest.mark.thorough
def test_effect_that_a_better_law_explains() -> None:
    """On data of ``ovm``, a law of the gap alone imitates the late reaction by multi-anticipation.
    Inertia is a part of ``ovm`` and therefore not explained away."""
    table, _ = measured("ovm", 3, sequences=12, vehicles=4, seconds=20.0)
    sequences = list(nnode.sequences(table))
    label = np.arange(len(sequences))
    engine = TrafficEngine(sequences, clusters=label)
    base = converged_fit(engine, initial_fit(engine, law("lin").double()).system)

    def added(name: str) -> Selection:
        return selection(refine(engine, extended(base.system, CATALOGUE.effects[name]())[0]), name)

    other = initial_fit(engine, law("ovm").double())
    better = BetterLaw("ovm", other.system)
    ahead = added("multi_anticipation")
    explained, p_value = explained_by_law(engine, ahead, label, better)
    assert [step.chosen.name for step in explained] == ["multi_anticipation"]
    assert p_value < 0.05
    assert explained_by_law(engine, added("inertia"), label, better)[0] == []
    with_same_effect = replace(better, named=frozenset({"multi_anticipation"}))
    assert explained_by_law(engine, ahead, label, with_same_effect)[0] == []
    # lin predicts no better than ovm
    worse = BetterLaw("lin", base.system)
    assert explained_by_law(engine, replace(ahead, fit=other), label, worse)[0] == []
    remaining = without_steps(engine, ahead, explained, base.system)
    assert remaining.steps == []
    assert effects_of(remaining.fit.system) == []
