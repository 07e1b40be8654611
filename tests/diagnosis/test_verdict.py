"""Places, bounds and texts of a verdict from given curves and scores."""

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
from nnode.diagnosis.statistics.standard import standardised
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


def test_place_of_deviation() -> None:
    # knots 1 to 3 are significantly positive, and knot 5 is significantly negative
    heights = [0.1, 2.0, 4.0, 1.0, 0.0, -3.0]
    curve = curves(heights, [1.0, 0.5, 0.5, 0.25, 1.0, 1.0], removed=0.06)
    (place,) = judge.places([curve], excess=0.24)
    assert (place.variable, place.unit, place.low, place.high) == ("gap", "m", 10.0, 30.0)
    # weights 4, 4 and 16
    assert place.deviation == pytest.approx((4 * 2.0 + 4 * 4.0 + 16 * 1.0) / 24)
    assert place.error == pytest.approx(24**-0.5)
    assert place.share == pytest.approx(0.25)
    # Student's two-sided tail of 8 standard errors with 15 degrees of freedom, for six knots
    assert place.p_value == pytest.approx(6 * 8.61093038e-7, rel=1e-6)
    assert place.curve["deviation"] == heights
    assert place.curve["at"] == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]


def test_places_are_significant_and_explain_excess() -> None:
    flat = curves([0.1, -0.2], [1.0, 1.0], removed=0.1)
    useless = curves([9.0, 0.0], [1.0, 1.0], removed=0.0)
    assert judge.places([flat, useless], excess=0.2) == []
    # the share is at most one
    (whole,) = judge.places([curves([9.0, 0.0], [1.0, 1.0], removed=0.5)], excess=0.2)
    assert whole.share == 1.0


@pytest.mark.parametrize(
    ("name", "values", "options", "text"),
    [
        ("speed_zone", {"a": (120.0, "m"), "b": (260.5, "m")}, {}, "x in [120, 260.5] m"),
        ("speed_period", {"a": (5.0, "s"), "b": (60.0, "s")}, {}, "t in [5, 60] s"),
        ("leader_length", {"beta": (1.0, "1")}, {}, "all agents, everywhere"),
        ("leader_length", {"beta": (1.0, "1")}, {"kind": "truck"}, "vehicles of class truck"),
        (
            "leader_length",
            {"x_o": (1.25, "m"), "y_o": (-0.5, "m")},
            {},
            "around (1.25, -0.50) m",
        ),
    ],
)
def test_text_of_place(
    name: str, values: dict[str, tuple[float, str]], options: dict[str, Any], text: str
) -> None:
    coefficients = {key: Coefficient(v, v, v, unit) for key, (v, unit) in values.items()}
    assert judge._where(CATALOGUE.effects[name], coefficients, options) == text


def test_standardised_scores_are_normal() -> None:
    rng = np.random.default_rng(3)
    sizes = rng.uniform(0.5, 2.0, (25, 1)) * np.ones((1, 20_000))
    parts = 3.0 * np.sqrt(sizes) * rng.standard_normal(sizes.shape)
    signs = np.ones((1, 25))

    scores, other_unit = (
        standardised(factor * parts, factor**2 * sizes, signs, cluster_variance=9.0)[0]
        for factor in (1.0, 10.0)
    )
    # the tolerance covers the error of 20,000 draws and of the approximation
    assert np.sqrt(np.mean(scores**2)) == pytest.approx(1.0, abs=0.02)
    assert np.mean(scores > 1.96) == pytest.approx(0.05, abs=0.006)
    assert other_unit == pytest.approx(scores)


class GivenPower:
    """Detectable sizes with 16 clusters.

    Args:
        sizes: detectable sizes, by the size of the evidence.
    """

    def __init__(self, sizes: dict[float, float]) -> None:
        self.sizes, self.screen = sizes, self

    def detectable(self, score: Score, evidence: Evidence, expected: float) -> float:
        return self.sizes[evidence.size]

    def costs(self, name: str) -> np.ndarray:
        return np.ones(16)


def evidence(size: float) -> Evidence:
    return Evidence({}, size, np.zeros(16), np.ones(16), 0.0)


@pytest.mark.parametrize(
    ("sizes", "testable", "detectable"),
    [
        # long delays destabilise the platoon; their power does not hold for short ones
        ({0.3: 0.38, 0.8: 1e-3}, False, 0.38),
        ({0.3: 1.1, 0.8: 1e-3}, False, 0.8),
        ({0.3: 0.04, 0.8: 1e-3}, True, 0.3),
    ],
)
def test_bound_of_delay(sizes: dict[float, float], testable: bool, detectable: float) -> None:
    by_size = [evidence(size) for size in sizes]
    score = Score(ReactionDelay, {}, 1.0, 0.5, 0.0, {"T": 1e-4}, {"T": 1e-4}, by_size)
    absence = _absence(score, cast(PowerSimulation, GivenPower(sizes)))
    assert absence.testable == testable
    assert absence.detectable == pytest.approx(detectable)
    assert (absence.bound is not None) == testable
    assert ("0.3 s" in absence.reason) != testable


def test_effect_is_testable_if_usual_size_is_detectable() -> None:
    def absence(detectable: float, error: float = 0.05) -> Absence:
        score = Score(
            RelativeSpeed, {}, 1.0, 0.5, 0.0, {"kappa": 0.01}, {"kappa": error}, [evidence(0.0)]
        )
        return _absence(score, cast(PowerSimulation, GivenPower({0.0: detectable})))

    assert absence(0.19).testable
    # Student's quantile with 15 degrees of freedom
    assert absence(0.19).bound == pytest.approx(0.01 + 2.13145 * 0.05, rel=1e-5)
    assert not absence(0.21).testable
    assert absence(0.21).bound is None
    assert absence(float("inf")).detectable is None
    assert not absence(0.0, error=0.0).testable


@pytest.mark.parametrize(
    ("powers", "bound"),
    [({12.0: 1.0, 15.0: 0.85, 18.0: 0.6}, 15.0), ({12.0: 0.79, 15.0: 0.3}, None)],
)
def test_bound_of_free_flow_speed(powers: dict[float, float], bound: float | None) -> None:
    class PowerOfSpeeds(GivenPower):
        def power(self, score: Score, evidence: Evidence, size: float) -> float:
            assert size == 1.0  # the effect has no strength
            return self.sizes[evidence.options["v_max"]]

    # higher speeds are reached more rarely
    by_speed = [replace(evidence(0.0), options={"v_max": v}, grams=np.ones(16) / v) for v in powers]
    score = Score(FreeFlowSpeed, {}, 1.0, 0.5, 0.0, {}, {}, by_speed)
    absence = _absence(score, cast(PowerSimulation, PowerOfSpeeds(powers)))
    testable = bound is not None
    assert (absence.testable, absence.detectable, absence.bound) == (testable, bound, bound)
    if not testable:
        assert absence.reason == "it acts too rarely, or in too few clusters, to be named"


def test_figure_of_remaining_structure() -> None:
    structure = judge.structure([curves([0.0, 1.0, 2.0], [0.1, 0.1, 0.1], removed=0.2)])
    assert (structure.variables, structure.gain) == (["gap"], 0.2)
    ax = flexible_curve(structure, "m/s").axes[0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("gap (m)", "missing term (m/s)")
    assert list(np.asarray(ax.lines[-1].get_ydata())) == [0.0, 1.0, 2.0]
