"""Error messages are limited in length and contain no control characters."""

from __future__ import annotations

import pickle

import pytest

from nnode.errors import LONGEST, DataError, NotFittedError, printable
from nnode.model.parse import FormulaError


@pytest.mark.parametrize(
    "text",
    [
        "file.csv, line 3:\n\tcolumn 'größe' holds 'x' – expected a number in m²",
        "x" * LONGEST,
    ],
    ids=["printable", "longest"],
)
def test_printable_message_is_unchanged(text: str) -> None:
    assert str(DataError(text)) == text


def test_long_message_keeps_its_start_and_end() -> None:
    text = str(DataError("cars.csv, line 3: found " + "x" * 5_000_000 + "; expected a number"))
    assert len(text) == LONGEST
    assert text.startswith("cars.csv, line 3: found x")
    assert text.endswith("x; expected a number")
    assert "5000043 characters in all" in text


@pytest.mark.parametrize("kind", [DataError, NotFittedError])
def test_control_characters_are_escaped(kind: type[Exception]) -> None:
    error = kind("a\x1b]0;t\x07b\r\x9b31m\u202ec\udc80\u2028d")
    assert str(error) == r"a\x1b]0;t\x07b\r\x9b31m\u202ec\udc80\u2028d"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_arguments_are_kept() -> None:
    assert DataError("a", 3).args == ("a", 3)


def test_control_characters_of_formulas_are_escaped() -> None:
    assert "\x1b" not in str(FormulaError("gap \x1b[31m", 3, "no \x1b"))


def test_length_is_limited() -> None:
    assert len(str(DataError("\x1b" * LONGEST))) == LONGEST
    assert len(printable("y" * 1000, 100)) == 100
