"""Hints: the form that made a curve is the one that is told, with its numbers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from nnode.diagnosis.symbolic import symbolic

Form = Callable[[np.ndarray], np.ndarray]


@pytest.mark.parametrize(
    ("form", "words"),
    [
        (lambda u: 0 * u + 1.5, "1.5, whatever the gap"),
        (lambda u: 1 + 2 * u, "1 +2 z with z = (gap - 10) / 40"),
        (lambda u: 1 + 2 * u - 3 * u**2, "1 +2 z -3 z² with"),
        (lambda u: 1 - 2 * np.exp(-4 * u), "1 -2 exp(-4 z) with"),
        (
            lambda u: 1 + 2 * np.sin(2 * np.pi * u) + 0.5 * np.cos(2 * np.pi * u),
            "1 +2 sin(2 pi z) +0.5 cos(2 pi z) with",
        ),
        (
            lambda u: 1 - 2 * np.sin(4 * np.pi * u) + 0.5 * np.cos(4 * np.pi * u),
            "1 -2 sin(4 pi z) +0.5 cos(4 pi z) with",
        ),
    ],
)
def test_the_form_that_made_a_curve_is_found(form: Form, words: str) -> None:
    u = np.linspace(0, 1, 12)
    found = symbolic("gap", 10 + 40 * u, form(u), np.full(12, 0.05))
    assert found.startswith(words)


def test_what_lies_within_the_errors_is_a_constant() -> None:
    u = np.linspace(0, 1, 12)
    rng = np.random.default_rng(1)
    found = symbolic("speed", u, 2 + 0.1 * u + 0.3 * rng.normal(size=12), np.full(12, 0.3))
    assert found.endswith("whatever the speed")


def test_knots_of_small_error_decide() -> None:
    # a line through all knots but the last, of which nothing is known
    at = np.arange(8.0)
    heights = np.append(at[:-1], 100.0)
    found = symbolic("gap", at, heights, np.append(np.full(7, 0.01), 1e6))
    assert "+7 z with z = (gap - 0) / 7" in found


def test_a_negative_beginning_is_added() -> None:
    found = symbolic("speed difference", np.arange(-4.0, 4.0), np.arange(8.0), np.full(8, 0.01))
    assert "z = (speed difference + 4) / 7" in found
