"""Conclusions of a selection: coefficients, bounds of absent effects, unexplained structure."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import stats

from nnode.diagnosis import thresholds
from nnode.diagnosis.candidate import Candidate
from nnode.diagnosis.curves import tail
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.measure_next import best_profile
from nnode.diagnosis.residuals.engine import Engine
from nnode.diagnosis.residuals.fit import Fit
from nnode.diagnosis.residuals.variables import Curves
from nnode.diagnosis.result import (
    Absence,
    Alternative,
    Coefficient,
    NamedEffect,
    Place,
    Profile,
    Structure,
)
from nnode.diagnosis.search import Selection, Step, apart_at
from nnode.diagnosis.statistics.paired import clusters_to_tell
from nnode.diagnosis.statistics.power import PowerSimulation
from nnode.diagnosis.statistics.profile import intervals as edge_intervals
from nnode.diagnosis.statistics.random_effects import IndividualEstimate
from nnode.diagnosis.statistics.score import Evidence, Score
from nnode.diagnosis.symbolic import symbolic
from nnode.model.effects import Effect
from nnode.model.extend import place_of

#: Normal quantile of an interval of 95 %.
WIDE = 1.96


def named(
    engine: Engine, fit: Fit, step: Step, confirmed: float = math.nan, combined: float = math.nan
) -> NamedEffect:
    """An accepted effect with its coefficients in a fit.

    Args:
        confirmed: p-value of the confirmation clusters. combined: of both parts together.
    """
    effect = step.chosen.score.effect
    coefficients = _coefficients(engine, fit, step)
    return NamedEffect(
        name=effect.name,
        formula=effect.formula_for(fit.system.order),
        source=effect.source,
        coefficients=coefficients,
        where=_where(effect, coefficients, step.chosen.score.options),
        alternatives=[
            Alternative(
                name=rival.name,
                loss=float(rival.losses.sum() / step.chosen.losses.sum()),
                p_value=test.p_value,
                distinguishing_data=effect.distinguishing_data,
                clusters=clusters_to_tell(test, apart_at(step.chosen, rival)),
                profile=_profile(engine, fit, rival, apart_at(step.chosen, rival)),
            )
            for rival, test in step.rivals
        ],
        p_value=step.chosen.score.p_value,
        gain=step.chosen.gain.gain,
        confirmed=confirmed,
        combined=combined,
    )


def _profile(engine: Engine, fit: Fit, rival: Candidate, level: float) -> Profile | None:
    if not isinstance(engine, TrafficEngine):
        return None
    return best_profile(engine, fit.system, rival.fit.system, level)


def named_agents(estimate: IndividualEstimate, confirmed: float, order: int) -> NamedEffect:
    """A confirmed individual effect, in a law of an order."""
    effect = estimate.effect
    coefficients = {}
    for name, strength in effect.strengths.items():
        coefficients[name] = Coefficient(estimate.sigma, *estimate.interval(), strength.unit)
    for name, setting in effect.settings.items():
        value = float(estimate.options[name])
        low, high = estimate.settings.get(name, (float("nan"), float("nan")))
        coefficients[name] = Coefficient(value, low, high, setting.unit)
    return NamedEffect(
        name=effect.name,
        formula=effect.formula_for(order),
        source=effect.source,
        coefficients=coefficients,
        where="all agents, everywhere",
        p_value=estimate.p_value,
        confirmed=confirmed,
    )


def _coefficients(engine: Engine, fit: Fit, step: Step) -> dict[str, Coefficient]:
    effect = step.chosen.score.effect
    place = place_of(fit.system, effect.name)
    term = fit.system.terms[place]
    intervals = fit.intervals(engine.cluster)
    edges = edge_intervals(engine, fit, effect.name) if effect.consecutive else {}
    coefficients = {}
    units = {name: strength.unit for name, strength in effect.strengths.items()}
    units |= {name: setting.unit for name, setting in effect.settings.items()}
    for name, unit in units.items():
        value = float(getattr(term, name).detach())
        full = f"terms.{place}.{name}"
        low, high = value, value
        if full in fit.names:
            low, high = (float(end) for end in intervals[fit.names.index(full)])
        low, high = edges.get(name, (low, high))
        coefficients[name] = Coefficient(value, low, high, unit)
    return coefficients


def _where(
    effect: type[Effect], coefficients: dict[str, Coefficient], options: dict[str, Any]
) -> str:
    if effect.consecutive:
        what = "x" if coefficients["a"].unit == "m" else "t"
        a, b = coefficients["a"], coefficients["b"]
        return f"{what} in [{a.value:.4g}, {b.value:.4g}] {a.unit}"
    if "kind" in options:
        return f"vehicles of class {options['kind']}"
    if {"x_o", "y_o"} <= set(coefficients):
        return f"around ({coefficients['x_o'].value:.2f}, {coefficients['y_o'].value:.2f}) m"
    return "all agents, everywhere"


def absences(search: Selection, power: PowerSimulation) -> list[Absence]:
    """Bounds of the effects that were not selected, by the power of the whole procedure."""
    return [_absence(score, power) for score in search.scores]


def _absence(score: Score, power: PowerSimulation) -> Absence:
    effect = score.effect
    if not effect.strengths:
        return _without_strength(score, power)
    # the strength with the smallest error relative to its expected size
    name = min(effect.strengths, key=lambda n: _relative(effect, n, score.error.get(n, 0.0)))
    strength, k = effect.strengths[name], list(effect.strengths).index(name)
    amount, error = score.amount.get(name, 0.0), score.error.get(name, math.inf)
    estimable = error > 0 and math.isfinite(error) and bool(score.evidence)
    expected, detectable, smallest_tested, where = strength.expected, math.inf, 0.0, ""
    if estimable and effect.consecutive:
        # the interval that explains most was selected: one of median precision is judged instead
        by_precision = sorted(score.evidence, key=lambda evidence: evidence.error)
        median = by_precision[len(by_precision) // 2]
        detectable = power.detectable(score, median, expected)
        amount, error = median.amount, median.error
        where = (
            f"from {median.options['a']:.0f} to {median.options['b']:.0f} "
            f"{effect.settings['a'].unit}; half of the intervals of this length are known better"
        )
    elif estimable and effect.remembers():
        # a trace of finite strength does not apply to smaller strengths
        detectable_sizes = [
            max(evidence.size, power.detectable(score, evidence, max(evidence.size, expected)))
            for evidence in score.evidence
        ]
        best = int(np.argmin(detectable_sizes))
        detectable, smallest_tested = detectable_sizes[best], score.evidence[best].size
    elif estimable:
        detectable = power.detectable(
            score, score.evidence[min(k, len(score.evidence) - 1)], expected
        )
    degrees = max(len(power.screen.costs(effect.name)) - 1, 1)
    bound = max(smallest_tested, abs(amount) + float(stats.t.ppf(0.975, degrees)) * error)
    testable = estimable and detectable <= expected
    unit = "" if strength.unit == "1" else f" {strength.unit}"
    return Absence(
        name=effect.name,
        testable=testable,
        coefficient=name,
        unit=strength.unit,
        detectable=detectable if math.isfinite(detectable) else None,
        bound=bound if testable else None,
        reason=where
        if testable
        else (
            f"{name} would not be named with these data with a probability of "
            f"{thresholds.POWER:.0%} even if it were off by {expected:.3g}{unit}"
        ),
    )


def _without_strength(score: Score, power: PowerSimulation) -> Absence:
    """The bound of an effect without a strength: the weakest setting that would be named."""
    effect = score.effect
    name, setting = next(iter(effect.settings.items()))
    detectable_settings = [
        evidence
        for evidence in score.evidence
        if evidence.grams.sum() > 0 and power.power(score, evidence, 1.0) >= thresholds.POWER
    ]
    weakest = min(detectable_settings, key=_information, default=None)
    value = None if weakest is None else float(weakest.options[name])
    return Absence(
        effect.name,
        value is not None,
        name,
        setting.unit,
        value,
        value,
        "" if value is not None else "it acts too rarely, or in too few clusters, to be named",
    )


def _information(evidence: Evidence) -> float:
    return float(evidence.grams.sum())


def agents_absent(estimate: IndividualEstimate, alpha: float, enough_clusters: bool) -> Absence:
    """The bound of differences between agents that were not significant."""
    (name,) = estimate.effect.strengths
    strength = estimate.effect.strengths[name]
    detectable, (_, high) = estimate.detectable(alpha), estimate.interval()
    testable = enough_clusters and 0 < detectable <= strength.expected
    return Absence(
        estimate.effect.name,
        testable,
        name,
        strength.unit,
        detectable if math.isfinite(detectable) else None,
        high if testable else None,
        ""
        if testable
        else (
            f"{name} would not be significant with a probability of "
            f"{thresholds.POWER:.0%} even if it were {strength.expected:.3g}"
            f"{'' if strength.unit == '1' else ' ' + strength.unit}"
        ),
    )


def _relative(effect: type[Effect], name: str, error: float) -> float:
    return error / effect.strengths[name].expected if error > 0 else math.inf


def places(curves: list[Curves], excess: float) -> list[Place]:
    """The interval of each significant curve around its largest height, in the curves' order.

    Args:
        curves: with the shares that they remove.
        excess: share of the squared errors that is not measurement noise.
    """
    result = []
    number = sum(len(curve.heights) for curve in curves)
    for curve in curves:
        p_values = tail(curve, number)
        significant = p_values <= thresholds.STRICT
        if not significant.any() or curve.removed <= 0:
            continue
        best = int(np.argmax(np.where(significant, np.abs(curve.heights), 0.0)))
        sign = np.sign(curve.statistic)
        same_sign = (sign == sign[best]) & (np.abs(curve.statistic) > WIDE)
        left = right = best
        while left > 0 and same_sign[left - 1]:
            left -= 1
        while right < len(same_sign) - 1 and same_sign[right + 1]:
            right += 1
        part = slice(left, right + 1)
        weight = 1 / curve.errors[part] ** 2
        mean = float((curve.heights[part] * weight).sum() / weight.sum())
        knots = curve.variable.knots
        result.append(
            Place(
                variable=curve.variable.name,
                unit=curve.variable.unit,
                low=knots[left],
                high=knots[right],
                deviation=mean,
                error=float(1 / math.sqrt(weight.sum())),
                share=min(curve.removed / excess, 1.0),
                p_value=float(p_values[best]),
                curve={
                    "at": list(knots),
                    "deviation": curve.heights.tolist(),
                    "error": curve.errors.tolist(),
                },
            )
        )
    return result


def structure(curves: list[Curves]) -> Structure:
    """Unexplained structure, described by the significant curves."""
    best = curves[0]
    knots = np.array(best.variable.knots)
    return Structure(
        variables=[curve.variable.name for curve in curves],
        gain=best.removed,
        hint=symbolic(best.variable.name, knots, best.heights, best.errors),
        curve={"at": knots.tolist(), "deviation": best.heights.tolist()},
        unit=best.variable.unit,
    )
