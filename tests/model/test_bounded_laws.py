"""Laws of huge size are built within seconds or refused with a short error."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from nnode.errors import ConfigError, NNodeError
from nnode.model.laws import CAR_FOLLOWING_LAWS, law_from
from nnode.model.names import ENTRIES
from nnode.model.network import NEURONS, FeedForward
from nnode.model.parse import OPERATIONS
from nnode.model.terms import REMEMBERED
from nnode.model.text import LONGEST, latex, plain

LAW: dict[str, Any] = {
    "parameters": {"v0": "30 m/s", "L": "5 m"},
    "rate": {"x": "v0*(1 - L/gap)"},
}


@contextmanager
def soon() -> Iterator[None]:
    """Less than 30 s, a hundred times the usual duration."""
    start = time.monotonic()
    yield
    assert time.monotonic() - start < 30.0


def chain(number: int, step: str, first: str = "1 + L/gap") -> dict[str, Any]:
    """Parts that each name the part before them several times."""
    where = {"p0": first} | {f"p{i + 1}": re.sub(r"\bp\b", f"p{i}", step) for i in range(number)}
    return {**LAW, "where": where, "rate": {"x": f"v0*p{number}"}}


@pytest.mark.parametrize(
    "step", ["p*(p + 1)", "L/(gap*p) + 1/p", "L/(gap*(1/p + L/(gap*p)))", "p**64", "exp(p)*p"]
)
def test_doubling_parts_are_built(step: str) -> None:
    with soon():
        law = law_from("mine", chain(ENTRIES - 2, step))
        rate = law.dynamics().rates["x"]
        for text in (plain(rate), latex(rate)):  # in full, 2**98 characters
            assert len(text) < 4 * LONGEST
            assert "(...)" in text


def test_error_on_doubling_parts_is_short() -> None:
    law = chain(ENTRIES - 2, "L/(gap*p) + 1/p")
    with soon(), pytest.raises(ConfigError, match="has the unit 1, expected m/s") as error:
        law_from("mine", {**law, "rate": {"x": f"p{ENTRIES - 2}"}})
    assert len(str(error.value)) < 5 * LONGEST


def test_powers_of_units_have_a_limit() -> None:
    with soon(), pytest.raises(ConfigError, match="a unit to a power above"):
        law_from("mine", chain(ENTRIES - 2, "p**64", first="gap"))


def test_operations_have_a_limit() -> None:
    """Parts with other inputs are not shared: 30 doubled parts have 2**30 operations."""
    where = {"p0": "exp(-d/B)"}
    for i in range(30):
        where[f"p{i + 1}"] = f"p{i}(dx=dx*1.1) + p{i}(dx=dx*1.3)*p{i}(dy=dy + dx)"
    people = {
        "parameters": {"A": "2 m/s²", "B": "1 m"},
        "where": where,
        "others": {"push": "A*p30*n_x"},
        "rate": {"vx": "push", "vy": "push"},
    }
    with soon(), pytest.raises(ConfigError, match=f"more than {OPERATIONS} operations"):
        law_from("mine", people)


@pytest.mark.parametrize("kind", ["where", "constants", "parameters", "states", "delayed"])
def test_entries_have_a_limit(kind: str) -> None:
    many = {f"a{i}": "9**9**9 m" for i in range(ENTRIES + 1)}
    with soon(), pytest.raises(ConfigError, match=rf"{kind}: {ENTRIES + 1} entries, .* {ENTRIES}"):
        law_from("mine", {**LAW, kind: many})


@pytest.mark.parametrize("number", [REMEMBERED + 1, 10**9, -1])
def test_remembered_steps_have_a_limit(number: int) -> None:
    with soon(), pytest.raises(ConfigError, match=f"expected at most {REMEMBERED}"):
        law_from("mine", {**CAR_FOLLOWING_LAWS["newell"], "remembered": number})
    half = {"a": ["gap", "m", "L/v0"], "b": ["x", "m", "L/v0"]}
    with pytest.raises(ConfigError, match="states of every vehicle"):
        law_from("mine", {**LAW, "delayed": half, "remembered": REMEMBERED // 2 + 1})


def test_law_at_the_limit_of_remembered_steps() -> None:
    with soon():
        law = law_from("mine", {**CAR_FOLLOWING_LAWS["newell"], "remembered": REMEMBERED})
    assert law.formulas.memory == REMEMBERED + 1


@pytest.mark.parametrize("number", [NEURONS + 1, 10**9])
def test_networks_have_a_limit(number: int) -> None:
    with soon():
        with pytest.raises(ConfigError, match=f"{number} neurons in a layer .* {NEURONS}"):
            law_from("mine", LAW, network=number)
        with pytest.raises(ConfigError, match="too large"):
            FeedForward((4, number, 2))


@pytest.mark.parametrize("wrong", ["text", 5, ["a"]])
@pytest.mark.parametrize("kind", ["parameters", "where", "constants", "states", "delayed"])
def test_entries_of_a_wrong_type(kind: str, wrong: object) -> None:
    with pytest.raises(NNodeError, match="must be a mapping"):
        law_from("mine", {**LAW, kind: wrong})
    if wrong != 5 or kind in ("states", "delayed"):  # 5 is a valid quantity or formula
        with pytest.raises(NNodeError):
            law_from("mine", {**LAW, kind: {"a": wrong}})
