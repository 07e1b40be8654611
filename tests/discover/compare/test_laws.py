"""Base laws are ranked on clusters that their calibration left out."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.truths.laws.case import LawCase, measured
from nnode.app.base_laws import LAWS, candidates
from nnode.app.python.inputs import model_options, table_options
from nnode.data.readers.table import read_table
from nnode.data.sequence import Sequence
from nnode.discover.compare.laws import compare_laws
from nnode.discover.options import DiscoverOptions
from nnode.discover.residuals.engine import row_of
from nnode.errors import ConfigError
from nnode.models import System, build_model
from tests.discover import walkers
from tests.discover.platoons import platoons


def law(name: str) -> System:
    return build_model(model_options(name, "measured"), 0)


@pytest.mark.parametrize("true", ["idm", "lin"])
def test_the_true_law_comes_first(true: str, tmp_path: Path) -> None:
    table, parameters = measured(LawCase(true, 5, sequences=12, vehicles=4, seconds=20.0))
    path = tmp_path / "table.csv"
    table.to_csv(path, index=False)
    sequences = read_table(path, table_options(path, "traffic", None, tmp_path))
    found = compare_laws({n: law(n) for n in ("lin", "idm", "helly")}, sequences, DiscoverOptions())
    assert found.ranking[0].name == found.best == true
    assert found.ranking[0].behind == 0.0 < found.ranking[1].behind
    assert found.ranking[1].p_value < 0.01
    first = {name.partition(".")[2]: value for name, (value, _) in found.ranking[0].values.items()}
    name = "T" if true == "idm" else "L"
    assert first[name] == pytest.approx(parameters[name], rel=0.15)


def test_what_cannot_be_simulated_is_told(platoons_of_lin: list[Sequence]) -> None:
    models = {"lin": law("lin"), "newell": law("newell")}
    before = row_of(models["lin"])
    found = compare_laws(models, platoons_of_lin, DiscoverOptions())
    assert [one.name for one in found.ranking] == ["lin"]
    assert "step by step" in found.refused["newell"]
    assert row_of(models["lin"]).tolist() == before.tolist()


@pytest.fixture(scope="module")
def platoons_of_lin() -> list[Sequence]:
    return platoons(number=6, seconds=12.0, driver=0.2)


def test_people_are_compared_too() -> None:
    sequences = walkers.crowd()
    found = compare_laws({n: law(n) for n in ("sf", "ttc", "cfsm")}, sequences, DiscoverOptions())
    assert {one.name for one in found.ranking} == {"sf", "ttc"}
    assert "first order" in found.refused["cfsm"]


def test_which_laws_are_candidates() -> None:
    asked = law("lin")
    lin = {"name": "lin"}
    every = candidates(lin, asked, DiscoverOptions())
    assert set(every) == set(LAWS["traffic"])
    assert every["lin"] is not asked
    few = candidates({"name": "own"}, asked, DiscoverOptions(compare=["idm"]))
    assert list(few) == ["idm", "own"]
    assert candidates(lin, asked, DiscoverOptions(compare=[])) == {}
    with pytest.raises(ConfigError, match=r"no model idn.*expected some of lin"):
        candidates(lin, asked, DiscoverOptions(compare=["idn"]))
    with pytest.raises(ConfigError, match="sf is a crowd model"):
        candidates(lin, asked, DiscoverOptions(compare=["sf"]))
    people = {**model_options("sf", "measured"), "desired": "direction"}
    others = candidates(people, build_model(people, 0), DiscoverOptions())
    assert {model.desired for model in others.values()} == {"direction"}
