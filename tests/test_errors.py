"""Messages can be shown: they are short, and a terminal obeys nothing in them."""

from __future__ import annotations

import pickle

import pytest

from nnode.errors import LONGEST, DataError, NotFittedError, printable
from nnode.model.parse import FormulaError


def test_a_message_that_is_sound_stays_as_it_is() -> None:
    text = "file.csv, line 3:\n\tcolumn 'größe' holds 'x' – expected a number in m²"
    assert str(DataError(text)) == text
    assert str(DataError("x" * LONGEST)) == "x" * LONGEST


def test_a_long_message_keeps_its_place_and_what_to_do() -> None:
    text = str(DataError("cars.csv, line 3: found " + "x" * 5_000_000 + "; expected a number"))
    assert len(text) == LONGEST
    assert text.startswith("cars.csv, line 3: found x")
    assert text.endswith("x; expected a number")
    assert "5000043 characters in all" in text


@pytest.mark.parametrize("kind", [DataError, NotFittedError])
def test_control_characters_are_written_as_escapes(kind: type[Exception]) -> None:
    error = kind("a\x1b]0;t\x07b\r\x9b31m\u202ec\udc80\u2028d")
    assert str(error) == r"a\x1b]0;t\x07b\r\x9b31m\u202ec\udc80\u2028d"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_escapes_do_not_make_a_message_longer() -> None:
    assert len(str(DataError("\x1b" * LONGEST))) == LONGEST


def test_other_arguments_stay() -> None:
    assert DataError("a", 3).args == ("a", 3)


def test_a_formula_is_shown_without_control_characters() -> None:
    assert "\x1b" not in str(FormulaError("gap \x1b[31m", 3, "no \x1b"))


def test_a_limit_of_ones_own() -> None:
    assert len(printable("y" * 1000, 100)) == 100
