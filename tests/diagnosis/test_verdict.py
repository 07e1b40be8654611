"""Words and intervals of a verdict, from curves and scores whose numbers are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
import torch

from nnode.diagnosis import verdict as judge
from nnode.diagnosis.report.figures.marks import flexible_curve
from nnode.diagnosis.residuals.variables import Curves, Variable
from nnode.diagnosis.result import Absence, Coefficient
from nnode.diagnosis.statistics.power import PowerSimulation
from nnode.diagnosis.statistics.score import Evidence, Score
from nnode.diagnosis.statistics.standard import standardised as scaled
from nnode.diagnosis.verdict import _absence
from nnode.model.effects import CATALOGUE
from nnode.model.effects.lane import FreeFlowSpeed, ReactionDelay, RelativeSpeed


def curves(heights: list[float], errors: list[float], removed: float, name: str = "gap") -> Curves:
    """A curve of a variable with knots at 0, 10, 20, ..., compared on 16 clusters."""
    knots = tuple(10.0 * k for k in range(len(heights)))
    variable = Variable(name, "m", lambda s: s.x[..., 0], knots, lambda s: torch.ones_like(s.x))
    return Curves(
        variable,
        np.zeros(1),
        np.array(heights),
        np.array(errors),
        np.zeros(16),
        cast(Any, None),
        0.001,
        np.zeros(1),
        removed,
    )


def test_a_place_is_the_stretch_of_one_sign_around_the_highest_knot() -> None:
    # knots 1 to 3 stand out upwards, the fifth downwards, and neither the first nor the fourth
    one = curves([0.1, 2.0, 4.0, 1.0, 0.0, -3.0], [1.0, 0.5, 0.5, 0.25, 1.0, 1.0], removed=0.06)
    (found,) = judge.places([one], excess=0.24)
    assert (found.variable, found.unit, found.low, found.high) == ("gap", "m", 10.0, 30.0)
    # weights 4, 4 and 16
    assert found.deviation == pytest.approx((4 * 2.0 + 4 * 4.0 + 16 * 1.0) / 24)
    assert found.error == pytest.approx(24**-0.5)
    assert found.share == pytest.approx(0.25)
    # Student's two-sided tail of 8 standard errors, 15 degrees, for six knots that were looked at
    assert found.p_value == pytest.approx(6 * 8.61093038e-7, rel=1e-6)
    assert found.curve["deviation"] == [0.1, 2.0, 4.0, 1.0, 0.0, -3.0]
    assert found.curve["at"] == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]


def test_what_does_not_stand_out_or_explains_nothing_is_no_place() -> None:
    flat = curves([0.1, -0.2], [1.0, 1.0], removed=0.1)
    useless = curves([9.0, 0.0], [1.0, 1.0], removed=0.0)
    assert judge.places([flat, useless], excess=0.2) == []
    # no place holds more than all there is to explain
    (whole,) = judge.places([curves([9.0, 0.0], [1.0, 1.0], removed=0.5)], excess=0.2)
    assert whole.share == 1.0


@pytest.mark.parametrize(
    ("name", "found", "options", "words"),
    [
        ("speed_zone", {"a": (120.0, "m"), "b": (260.5, "m")}, {}, "x in [120, 260.5] m"),
        ("speed_period", {"a": (5.0, "s"), "b": (60.0, "s")}, {}, "t in [5, 60] s"),
        ("leader_length", {"beta": (1.0, "1")}, {}, "everybody, everywhere"),
        ("leader_length", {"beta": (1.0, "1")}, {"kind": "truck"}, "vehicles of class truck"),
        (
            "leader_length",
            {"x_o": (1.25, "m"), "y_o": (-0.5, "m")},
            {},
            "around (1.25, -0.50) m",
        ),
    ],
)
def test_where_an_effect_acts_in_words(
    name: str, found: dict[str, tuple[float, str]], options: dict[str, Any], words: str
) -> None:
    coefficients = {key: Coefficient(v, v, v, unit) for key, (v, unit) in found.items()}
    assert judge._where(CATALOGUE.effects[name], coefficients, options) == words


def test_scores_are_on_the_scale_of_a_standard_normal_variable() -> None:
    rng = np.random.default_rng(3)
    sizes = rng.uniform(0.5, 2.0, (25, 1)) * np.ones((1, 20_000))
    parts = 3.0 * np.sqrt(sizes) * rng.standard_normal(sizes.shape)
    signs = np.ones((1, 25))

    def standardised(factor: float) -> np.ndarray:
        found = scaled(factor * parts, factor**2 * sizes, signs, cluster_variance=9.0)
        return np.asarray(found[0])

    found = standardised(1.0)
    # two parts in a hundred: the error of 20,000 draws and the approximation's own
    assert np.sqrt(np.mean(found**2)) == pytest.approx(1.0, abs=0.02)
    assert np.mean(found > 1.96) == pytest.approx(0.05, abs=0.006)
    # as little as the unit of the effect's coefficient matters
    assert standardised(10.0) == pytest.approx(found)


class Known:
    """What is likely to be found, with 16 clusters.

    Args:
        sizes: that are detectable, by the size that was tried.
    """

    def __init__(self, sizes: dict[float, float]) -> None:
        self.sizes, self.screen = sizes, self

    def detectable(self, score: Score, one: Evidence, expected: float) -> float:
        return self.sizes[one.size]

    def costs(self, name: str) -> np.ndarray:
        return np.ones(16)


def evidence(size: float) -> Evidence:
    return Evidence({}, size, np.zeros(16), np.ones(16), 0.0)


@pytest.mark.parametrize(
    ("sizes", "testable", "detectable"),
    [
        # the long delay shakes the platoon: that says nothing of short ones
        ({0.3: 0.38, 0.8: 1e-3}, False, 0.38),
        ({0.3: 1.1, 0.8: 1e-3}, False, 0.8),
        ({0.3: 0.04, 0.8: 1e-3}, True, 0.3),
    ],
)
def test_a_delay_is_bounded_where_it_was_tried(
    sizes: dict[float, float], testable: bool, detectable: float
) -> None:
    each = [evidence(size) for size in sizes]
    score = Score(ReactionDelay, {}, 1.0, 0.5, 0.0, {"T": 1e-4}, {"T": 1e-4}, each)
    found = _absence(score, cast(PowerSimulation, Known(sizes)))
    assert found.testable == testable
    assert found.detectable == pytest.approx(detectable)
    assert (found.bound is not None) == testable
    assert ("0.3 s" in found.reason) != testable


def test_an_effect_is_tested_where_one_of_usual_size_would_be_named() -> None:
    def of(detectable: float, error: float = 0.05) -> Absence:
        one = [evidence(0.0)]
        score = Score(RelativeSpeed, {}, 1.0, 0.5, 0.0, {"kappa": 0.01}, {"kappa": error}, one)
        return _absence(score, cast(PowerSimulation, Known({0.0: detectable})))

    assert of(0.19).testable
    # Student's quantile with 15 degrees
    assert of(0.19).bound == pytest.approx(0.01 + 2.13145 * 0.05, rel=1e-5)
    assert not of(0.21).testable
    assert of(0.21).bound is None
    assert of(float("inf")).detectable is None
    assert not of(0.0, error=0.0).testable


def test_a_cap_is_absent_down_to_the_weakest_that_would_be_named() -> None:
    class Caps(Known):
        def power(self, score: Score, one: Evidence, size: float) -> float:
            assert size == 1.0  # it is there or not
            return self.sizes[one.options["v_max"]]

    def of(powers: dict[float, float]) -> Absence:
        # the higher the cap the less it does
        caps = [replace(evidence(0.0), options={"v_max": v}, grams=np.ones(16) / v) for v in powers]
        score = Score(FreeFlowSpeed, {}, 1.0, 0.5, 0.0, {}, {}, caps)
        return _absence(score, cast(PowerSimulation, Caps(powers)))

    found = of({12.0: 1.0, 15.0: 0.85, 18.0: 0.6})
    assert (found.testable, found.detectable, found.bound) == (True, 15.0, 15.0)
    rarely = of({12.0: 0.79, 15.0: 0.3})
    assert (rarely.testable, rarely.detectable, rarely.bound) == (False, None, None)
    assert rarely.reason == "it acts too rarely, or in too few clusters, to be named"


def test_what_is_left_is_drawn_in_the_unit_of_its_variable() -> None:
    left = judge.structure([curves([0.0, 1.0, 2.0], [0.1, 0.1, 0.1], removed=0.2)])
    assert (left.variables, left.gain) == (["gap"], 0.2)
    ax = flexible_curve(left, "m/s").axes[0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("gap (m)", "missing term (m/s)")
    assert list(np.asarray(ax.lines[-1].get_ydata())) == [0.0, 1.0, 2.0]
