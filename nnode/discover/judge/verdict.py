"""What follows from a search: coefficients, what is absent, what could not be tested, what is
left."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import stats

from nnode.discover.judge.measure_next import advised
from nnode.discover.lanes.engine import TrafficEngine
from nnode.discover.locate.curves import tail
from nnode.discover.locate.symbolic import symbolic
from nnode.discover.name.candidate import Candidate
from nnode.discover.name.search import Search, Step, apart_at
from nnode.discover.residuals.engine import Engine
from nnode.discover.residuals.fit import Fit
from nnode.discover.residuals.variables import Curves
from nnode.discover.result import (
    Absence,
    Alternative,
    Coefficient,
    NamedEffect,
    Place,
    Profile,
    Structure,
)
from nnode.discover.rules import rules
from nnode.discover.statistics.paired import clusters_to_tell
from nnode.discover.statistics.power import PowerSimulation
from nnode.discover.statistics.profile import intervals as edge_intervals
from nnode.discover.statistics.random_effects import Individuals
from nnode.discover.statistics.score import Evidence, Score
from nnode.model.effects import Effect
from nnode.model.extend import place_of

#: Normal quantile of an interval of 95 %.
WIDE = 1.96


def named(engine: Engine, fit: Fit, step: Step, confirmed: float) -> NamedEffect:
    """An accepted effect with its coefficients in a fit.

    Args:
        confirmed: p-value of the sealed clusters.
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
                name=other.name,
                loss=float(other.losses.sum() / step.chosen.losses.sum()),
                p_value=test.p_value,
                separated_by=effect.distinguishing_data,
                clusters=clusters_to_tell(test, apart_at(step.chosen, other)),
                profile=_profile(engine, fit, other, apart_at(step.chosen, other)),
            )
            for other, test in step.rivals
        ],
        p_value=step.chosen.score.p_value,
        gain=step.chosen.gain.gain,
        confirmed=confirmed,
    )


def _profile(engine: Engine, fit: Fit, rival: Candidate, level: float) -> Profile | None:
    if not isinstance(engine, TrafficEngine):
        return None
    return advised(engine, fit.system, rival.fit.system, level)


def named_agents(one: Individuals, confirmed: float, order: int) -> NamedEffect:
    """An individual effect that was confirmed, in a law of an order."""
    effect = one.effect
    found = {}
    for name, strength in effect.strengths.items():
        found[name] = Coefficient(one.sigma, *one.interval(), strength.unit)
    for name, setting in effect.settings.items():
        value = float(one.options[name])
        low, high = one.settings.get(name, (float("nan"), float("nan")))
        found[name] = Coefficient(value, low, high, setting.unit)
    return NamedEffect(
        name=effect.name,
        formula=effect.formula_for(order),
        source=effect.source,
        coefficients=found,
        where="everybody, everywhere",
        p_value=one.p_value,
        confirmed=confirmed,
    )


def _coefficients(engine: Engine, fit: Fit, step: Step) -> dict[str, Coefficient]:
    effect = step.chosen.score.effect
    place = place_of(fit.system, effect.name)
    own = fit.system.terms[place]
    intervals = fit.intervals(engine.cluster)
    edges = edge_intervals(engine, fit, effect.name) if effect.consecutive else {}
    found = {}
    units = {name: strength.unit for name, strength in effect.strengths.items()}
    units |= {name: setting.unit for name, setting in effect.settings.items()}
    for name, unit in units.items():
        value = float(getattr(own, name).detach())
        full = f"terms.{place}.{name}"
        low, high = value, value
        if full in fit.names:
            low, high = (float(end) for end in intervals[fit.names.index(full)])
        low, high = edges.get(name, (low, high))
        found[name] = Coefficient(value, low, high, unit)
    return found


def _where(effect: type[Effect], found: dict[str, Coefficient], options: dict[str, Any]) -> str:
    if effect.consecutive:
        what = "x" if found["a"].unit == "m" else "t"
        return f"{what} in [{found['a'].value:.4g}, {found['b'].value:.4g}] {found['a'].unit}"
    if "kind" in options:
        return f"vehicles of class {options['kind']}"
    if {"x_o", "y_o"} <= set(found):
        return f"around ({found['x_o'].value:.2f}, {found['y_o'].value:.2f}) m"
    return "everybody, everywhere"


def absences(search: Search, way: PowerSimulation) -> list[Absence]:
    """What the final screening says of the effects that were not found, by the power of the whole
    way."""
    return [_absence(score, way) for score in search.scores]


def _absence(score: Score, way: PowerSimulation) -> Absence:
    effect = score.effect
    if not effect.strengths:
        return _without_strength(score, way)
    # the strength that is known best in units of what is plausible
    name = min(effect.strengths, key=lambda n: _relative(effect, n, score.error.get(n, 0.0)))
    strength, k = effect.strengths[name], list(effect.strengths).index(name)
    amount, error = score.amount.get(name, 0.0), score.error.get(name, math.inf)
    known = error > 0 and math.isfinite(error) and bool(score.evidence)
    expected, detectable, least = strength.expected, math.inf, 0.0
    if known and effect.remembers():
        # what was tried at a size says nothing of smaller ones
        found = [
            max(one.size, way.detectable(score, one, max(one.size, expected)))
            for one in score.evidence
        ]
        best = int(np.argmin(found))
        detectable, least = found[best], score.evidence[best].size
    elif known:
        detectable = way.detectable(
            score, score.evidence[min(k, len(score.evidence) - 1)], expected
        )
    degrees = max(len(way.screen.costs(effect.name)) - 1, 1)
    bound = max(least, abs(amount) + float(stats.t.ppf(0.975, degrees)) * error)
    testable = known and detectable <= expected
    unit = "" if strength.unit == "1" else f" {strength.unit}"
    return Absence(
        name=effect.name,
        testable=testable,
        coefficient=name,
        unit=strength.unit,
        detectable=detectable if math.isfinite(detectable) else None,
        bound=bound if testable else None,
        reason=""
        if testable
        else (
            f"{name} would not be named with these data with a probability of {rules().power:.0%} "
            f"even if it were off by {expected:.3g}{unit}"
        ),
    )


def _without_strength(score: Score, way: PowerSimulation) -> Absence:
    """Of an effect that is there or not: the weakest of its settings that would be named."""
    effect = score.effect
    name, setting = next(iter(effect.settings.items()))
    found = [
        one
        for one in score.evidence
        if one.grams.sum() > 0 and way.power(score, one, 1.0) >= rules().power
    ]
    weakest = min(found, key=_information, default=None)
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


def _information(one: Evidence) -> float:
    return float(one.grams.sum())


def agents_absent(one: Individuals, alpha: float, enough: bool) -> Absence:
    """What the open clusters say of numbers that nobody was found to have of his own."""
    (name,) = one.effect.strengths
    strength = one.effect.strengths[name]
    detectable, (_, high) = one.detectable(alpha), one.interval()
    testable = enough and 0 < detectable <= strength.expected
    return Absence(
        one.effect.name,
        testable,
        name,
        strength.unit,
        detectable if math.isfinite(detectable) else None,
        high if testable else None,
        ""
        if testable
        else (
            f"{name} would not stand out with a probability of {rules().power:.0%} even if it were "
            f"{strength.expected:.3g}{'' if strength.unit == '1' else ' ' + strength.unit}"
        ),
    )


def _relative(effect: type[Effect], name: str, error: float) -> float:
    return error / effect.strengths[name].expected if error > 0 else math.inf


def places(found: list[Curves], excess: float) -> list[Place]:
    """Where each curve is largest of where it stands out, the one that explains most first.

    Args:
        found: with what they remove.
        excess: share of the squared errors that is not noise of the measurement.
    """
    result = []
    number = sum(len(one.heights) for one in found)
    for one in found:
        chance = tail(one, number)
        known = chance <= rules().sure
        if not known.any() or one.removed <= 0:
            continue
        best = int(np.argmax(np.where(known, np.abs(one.heights), 0.0)))
        sign = np.sign(one.statistic)
        alike = (sign == sign[best]) & (np.abs(one.statistic) > WIDE)
        first = last = best
        while first > 0 and alike[first - 1]:
            first -= 1
        while last < len(alike) - 1 and alike[last + 1]:
            last += 1
        part = slice(first, last + 1)
        weight = 1 / one.errors[part] ** 2
        mean = float((one.heights[part] * weight).sum() / weight.sum())
        knots = one.variable.knots
        result.append(
            Place(
                variable=one.variable.name,
                unit=one.variable.unit,
                low=knots[first],
                high=knots[last],
                deviation=mean,
                error=float(1 / math.sqrt(weight.sum())),
                share=min(one.removed / excess, 1.0),
                p_value=float(chance[best]),
                curve={
                    "at": list(knots),
                    "deviation": one.heights.tolist(),
                    "error": one.errors.tolist(),
                },
            )
        )
    return result


def structure(found: list[Curves]) -> Structure:
    """What is left, by the curves that are significant."""
    best = found[0]
    at = np.array(best.variable.knots)
    return Structure(
        variables=[one.variable.name for one in found],
        gain=best.removed,
        hint=symbolic(best.variable.name, at, best.heights, best.errors),
        curve={"at": at.tolist(), "deviation": best.heights.tolist()},
        unit=best.variable.unit,
    )
