"""Closed forms of curves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from nnode.diagnosis.symbolic import symbolic

Form = Callable[[np.ndarray], np.ndarray]


@pytest.mark.parametrize(
    ("form", "text"),
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
def test_true_form_is_selected(form: Form, text: str) -> None:
    u = np.linspace(0, 1, 12)
    assert symbolic("gap", 10 + 40 * u, form(u), np.full(12, 0.05)).startswith(text)


def test_changes_within_errors_are_ignored() -> None:
    u = np.linspace(0, 1, 12)
    heights = 2 + 0.1 * u + 0.3 * np.random.default_rng(1).normal(size=12)
    assert symbolic("speed", u, heights, np.full(12, 0.3)).endswith("whatever the speed")


def test_knots_are_weighted_by_errors() -> None:
    # a line through all knots but the last, whose error is large
    at = np.arange(8.0)
    heights = np.append(at[:-1], 100.0)
    text = symbolic("gap", at, heights, np.append(np.full(7, 0.01), 1e6))
    assert "+7 z with z = (gap - 0) / 7" in text


def test_sign_of_negative_start() -> None:
    text = symbolic("speed difference", np.arange(-4.0, 4.0), np.arange(8.0), np.full(8, 0.01))
    assert "z = (speed difference + 4) / 7" in text
