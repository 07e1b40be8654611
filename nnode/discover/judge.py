"""What follows from a search: coefficients, what is absent, what could not be tested, what is
left."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nnode.discover.edges import intervals as edge_intervals
from nnode.discover.engine import Engine
from nnode.discover.fit import Fit
from nnode.discover.result import (
    Absence,
    Alternative,
    Coefficient,
    NamedEffect,
    Place,
    Structure,
)
from nnode.discover.score import Score
from nnode.discover.search import Search, Step
from nnode.discover.symbolic import symbolic
from nnode.discover.variables import Curves, normal_tail
from nnode.models.effects import Effect
from nnode.models.extend import place_of

#: Normal quantiles: of an interval of 95 %, and of a power of 80 %.
WIDE, POWER = 1.96, 0.84
#: A curve's knots count as a place where they stand out at this error probability.
STANDS_OUT = 0.01


def named(engine: Engine, search: Search, step: Step) -> NamedEffect:
    """An accepted effect with its coefficients in the final fit."""
    effect = step.chosen.score.effect
    coefficients = _coefficients(engine, search.fit, step)
    return NamedEffect(
        name=effect.name,
        formula=effect.formula,
        source=effect.source,
        coefficients=coefficients,
        where=_where(effect, coefficients, step.chosen.score.options),
        alternatives=[
            Alternative(
                name=other.name,
                loss=float(other.losses.sum() / step.chosen.losses.sum()),
                p_value=test.p_value,
                separated_by=effect.separated_by,
            )
            for other, test in step.rivals
        ],
        p_value=step.chosen.score.p_value,
        gain=step.chosen.gain.gain,
    )


def _coefficients(engine: Engine, fit: Fit, step: Step) -> dict[str, Coefficient]:
    effect = step.chosen.score.effect
    place = place_of(fit.system, effect.name)
    own = fit.system.terms[place]
    intervals = fit.intervals(engine.sequence)
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
        if step.individuals is not None and name in effect.strengths and full not in fit.names:
            value = step.individuals.sigma
            low, high = step.individuals.interval
        elif step.individuals is not None and name in step.individuals.settings:
            value = float(step.individuals.options[name])
            low, high = step.individuals.settings[name]
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


def absences(search: Search) -> list[Absence]:
    """What the final screening says of the effects that were not found."""
    assert search.screen is not None
    screen = search.screen
    return [_absence(score, screen.critical(score.effect.name)) for score in search.scores]


def _absence(score: Score, critical: float) -> Absence:
    effect = score.effect
    if not effect.strengths:
        name, setting = next(iter(effect.settings.items()))
        return Absence(
            effect.name, score.gain > 0, name, setting.unit, None, None,
            "has no strength that could be limited",
        )  # fmt: skip
    # the strength that is known best in units of what is plausible
    name = min(effect.strengths, key=lambda n: _relative(effect, n, score.error.get(n, 0.0)))
    strength = effect.strengths[name]
    amount, error = score.amount.get(name, 0.0), score.error.get(name, math.inf)
    known = error > 0 and math.isfinite(error)
    detectable, bound = math.inf, math.inf
    if known:
        detectable, bound = (critical + POWER) * error, abs(amount) + WIDE * error
    if score.probes:
        # what was tried at a size says nothing of smaller ones
        size, error = min(score.probes, key=lambda one: max(one[0], (critical + POWER) * one[1]))
        detectable = max(size, (critical + POWER) * error)
        bound = max(size, abs(amount) + WIDE * error)
    testable = known and detectable <= strength.expected
    return Absence(
        name=effect.name,
        testable=testable,
        coefficient=name,
        unit=strength.unit,
        detectable=detectable if math.isfinite(detectable) else None,
        bound=bound if testable else None,
        reason="" if testable else (
            f"{name} would not stand out in these data even if it were off by "
            f"{strength.expected:.3g}{'' if strength.unit == '1' else f' {strength.unit}'}"
        ),
    )  # fmt: skip


def _relative(effect: type[Effect], name: str, error: float) -> float:
    return error / effect.strengths[name].expected if error > 0 else math.inf


def places(found: list[Curves], excess: float) -> list[Place]:
    """Where each curve stands out, the one that explains most first.

    Args:
        found: with what they remove.
        excess: share of the squared errors that is not noise of the measurement.
    """
    result = []
    number = sum(len(one.heights) for one in found)
    for one in found:
        tail = normal_tail(one.statistic, number)
        best = int(np.argmin(tail))
        if tail[best] > STANDS_OUT or one.removed <= 0:
            continue
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
                p_value=float(tail[best]),
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
