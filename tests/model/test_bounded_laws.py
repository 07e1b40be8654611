"""Laws of huge size: refused with one short error, or built within seconds.

The limits are far above what the package's own laws need, which other tests build.
"""

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
#: s; a hundred times what each case takes.
LONG = 30.0


@contextmanager
def soon() -> Iterator[None]:
    start = time.monotonic()
    yield
    assert time.monotonic() - start < LONG


def chain(number: int, step: str, first: str = "1 + L/gap") -> dict[str, Any]:
    """Parts of which each one names the one before it several times."""
    where = {"p0": first} | {f"p{i + 1}": re.sub(r"\bp\b", f"p{i}", step) for i in range(number)}
    return {**LAW, "where": where, "rate": {"x": f"v0*p{number}"}}


@pytest.mark.parametrize(
    "step", ["p*(p + 1)", "L/(gap*p) + 1/p", "L/(gap*(1/p + L/(gap*p)))", "p**64", "exp(p)*p"]
)
def test_parts_that_double_are_built(step: str) -> None:
    with soon():
        law = law_from("mine", chain(ENTRIES - 2, step))
        rate = law.dynamics().rates["x"]
        for text in (plain(rate), latex(rate)):  # written out: 2**98 characters
            assert len(text) < 4 * LONGEST
            assert "(...)" in text


def test_an_error_on_such_parts_is_short() -> None:
    law = chain(ENTRIES - 2, "L/(gap*p) + 1/p")
    with soon(), pytest.raises(ConfigError, match="has the unit 1, expected m/s") as error:
        law_from("mine", {**law, "rate": {"x": f"p{ENTRIES - 2}"}})
    assert len(str(error.value)) < 5 * LONGEST


def test_powers_of_units_have_an_end() -> None:
    with soon(), pytest.raises(ConfigError, match="a unit to a power above"):
        law_from("mine", chain(ENTRIES - 2, "p**64", first="gap"))


def test_parts_with_other_quantities_in_them_are_counted() -> None:
    """Each one is built anew: 30 parts that are named twice have 2**30 operations."""
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
def test_entries_are_counted_before_they_are_read(kind: str) -> None:
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


def test_as_many_as_that_are_built() -> None:
    with soon():
        law = law_from("mine", {**CAR_FOLLOWING_LAWS["newell"], "remembered": REMEMBERED})
    assert law.memory == REMEMBERED + 1


@pytest.mark.parametrize("number", [NEURONS + 1, 10**9])
def test_networks_have_a_limit(number: int) -> None:
    with soon():
        with pytest.raises(ConfigError, match=f"{number} neurons in a layer .* {NEURONS}"):
            law_from("mine", LAW, network=number)
        with pytest.raises(ConfigError, match="too large"):
            FeedForward((4, number, 2))


@pytest.mark.parametrize("wrong", ["text", 5, ["a"]])
@pytest.mark.parametrize("kind", ["parameters", "where", "constants", "states", "delayed"])
def test_entries_of_another_kind_are_refused(kind: str, wrong: object) -> None:
    with pytest.raises(NNodeError, match="must be a mapping"):
        law_from("mine", {**LAW, kind: wrong})
    if wrong != 5 or kind in ("states", "delayed"):  # 5 is a quantity, and a formula
        with pytest.raises(NNodeError):
            law_from("mine", {**LAW, kind: {"a": wrong}})
