"""Valid names in formulas and in generated source."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from nnode.errors import ConfigError
from nnode.model.effects import CATALOGUE
from nnode.model.expression import symbol
from nnode.model.laws import (
    CAR_FOLLOWING_LAWS,
    NEURONS,
    PEDESTRIAN_LAWS,
    law_from,
    make_law,
)
from nnode.model.names import check_names, check_symbols
from nnode.model.system import Traffic
from nnode.model.term import Term
from nnode.model.terms import Rule
from nnode.simulation.kernels.alone import WalkSource
from nnode.simulation.kernels.crowds import CrowdSource
from nnode.simulation.kernels.lanes import LaneSource

CODE = '__import__("os").abort()'
#: Code in several forms, wrong underscores, non-ASCII letters and digits, and keywords.
INVALID = [
    f"a: {CODE}",
    f"[{CODE}]",
    f"a={CODE}",
    f"a\n{CODE}",
    CODE,
    "",
    "_a",
    "a_",
    "a__b",
    "2a",
    "a b",
    "a-b",
    "a.b",
    "ä",
    "a²",
    "a٣",
    "a\n",
    "lambda",
    "None",
    "class",
]

LAW: dict[str, Any] = {
    "parameters": {"v0": "30 m/s", "T": "1.2 s"},
    "rate": {"v": "(v0*(1 - v*T/gap) - v)/T"},
}
PERSON: dict[str, Any] = {
    "parameters": {"A": "2 m/s²", "B": "1 m"},
    "others": {"push": "A*exp(-d/B)*n_x"},
    "rate": {"vx": "push", "vy": "push"},
}
ENTRIES: list[tuple[dict[str, Any], str, Any]] = [
    (LAW, "parameters", "1 m"),
    (LAW, "constants", "1 m"),
    (LAW, "where", "gap"),
    (LAW, "states", ["m", "v", "gap"]),
    (LAW, "delayed", ["gap", "m", "T"]),
    (PERSON, "parameters", "1 m"),
    (PERSON, "constants", "1 m"),
    (PERSON, "where", "d/B"),
    *((PERSON, over, "A*n_x") for over in ("others", "points", "walls")),
    *((PERSON, over, "A") for over in ("smallest", "largest")),
]


@pytest.mark.parametrize("name", ["v0", "T", "time_gap", "a_1", "A2_b3_c", "lambda_0"])
def test_valid_names(name: str) -> None:
    check_names("it", [name])


@pytest.mark.parametrize("name", INVALID)
def test_invalid_names(name: str) -> None:
    with pytest.raises(ConfigError, match=r"^it: .* cannot be a name; expected ASCII letters"):
        check_names("it", ["good", name])
    for law in (LAW, PERSON):
        with pytest.raises(ConfigError, match=r"^model\.name: "):
            law_from(name, law)
    if name != "a_":  # parameters in Python code may end like lambda_
        with pytest.raises(ConfigError, match=r"^parameters: "):
            Term().declare(name, 1.0, unit="m")


@pytest.mark.parametrize(("law", "kind", "entry"), ENTRIES)
def test_invalid_names_in_laws(law: dict[str, Any], kind: str, entry: Any) -> None:
    good = {**law, kind: {**law.get(kind, {}), "other": entry}}
    if law is LAW:
        good["remembered"] = 2
    law_from("mine", good)
    for name in INVALID:
        with pytest.raises(ConfigError, match=rf"^model\.law\.{kind}: .* cannot be a name"):
            law_from("mine", {**good, kind: {**law.get(kind, {}), name: entry}})


@pytest.mark.parametrize("kind", ["states", "delayed", "where", "constants", "inputs"])
def test_invalid_names_in_rules(kind: str) -> None:
    with pytest.raises(ConfigError, match=rf"^{kind}: "):
        Rule(**{kind: {f"a: {CODE}": ("m", "v", "x")}})
    if kind not in ("states", "delayed"):
        with pytest.raises(ConfigError, match=rf"^{kind}: "):
            Rule(("0", "0"), **{kind: {f"a: {CODE}": "m"}})


def test_invalid_names_of_effects() -> None:
    class Misnamed(CATALOGUE.effects["relative_speed"]):
        name = f"a: {CODE}"

    model = Traffic([make_law("lin"), Misnamed(kappa=0.3)])
    with pytest.raises(ConfigError, match=r"^terms: "):
        model.formula  # noqa: B018


def test_names_in_the_catalogue_are_valid() -> None:
    laws = [
        *(
            law_from(name, law, network=NEURONS.get(name))
            for name, law in CAR_FOLLOWING_LAWS.items()
        ),
        *(law_from(name, law) for name, law in PEDESTRIAN_LAWS.items()),
    ]
    assert len(laws) >= 14
    for term in [*laws, *(effect() for effect in CATALOGUE.effects.values())]:
        check_names(type(term).__name__, [term.name])
        check_names(type(term).__name__, term.scalars, in_code=True)
    for law in laws:
        if law.domain == "traffic":
            LaneSource(law.dynamics().flat()).text()
        else:
            CrowdSource(law.dynamics()).text()


@pytest.mark.parametrize("name", ["x__d0", "mine__v0", "D_mine__v0__d1_1", "who_mine__a", "G_a__b"])
def test_valid_symbols(name: str) -> None:
    check_symbols([name])


@pytest.mark.parametrize("name", [*INVALID[:5], "_a", "pass", "a__ä"])
def test_invalid_symbols(name: str) -> None:
    with pytest.raises(ConfigError, match="no source is generated with the name"):
        check_symbols(["x", name])


def test_generators_check_symbols() -> None:
    """Formulas that were not made from a law are checked too."""
    law = law_from("mine", LAW)
    lane, bad = law.dynamics().flat(), symbol(f"a: {CODE}")
    lane.rates["v"] = lane.rates["v"] + bad
    with pytest.raises(ConfigError, match="no source is generated"):
        LaneSource(lane).text()
    force = law_from("mine", PERSON)
    for source in (CrowdSource, WalkSource):
        crowd = force.dynamics()
        object.__setattr__(crowd, "sums", {**crowd.sums, "walls": {bad.value: crowd.rate[0]}})
        with pytest.raises(ConfigError, match="no source is generated"):
            source(crowd).text()


def test_constants_that_overflow_are_not_folded() -> None:
    """``inf`` would be a name in generated source."""
    law = law_from("mine", {**LAW, "rate": {"v": "(v0 - v)/T*min(1e308*10, 1)"}})
    assert "inf" not in LaneSource(law.dynamics().flat()).text()
    gap = torch.tensor([10.0], dtype=torch.float64)
    assert law.speed(gap).item() == pytest.approx(30.0)
