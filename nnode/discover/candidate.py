"""An effect that is added to a model, calibrated with it, and what can be said of it then."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from nnode.discover.compare import Comparison
from nnode.discover.engine import Engine
from nnode.discover.fit import ROUGH, Fit, evaluated, refine
from nnode.discover.individual import Individuals, individuals, sharpened
from nnode.discover.score import Score, Screen, traces
from nnode.errors import SimulationError
from nnode.models.effects import Effect, IndividualEffect
from nnode.models.extend import effects_of, extended, place_of, without
from nnode.models.system import System

#: An interval is moved at most so many times.
SHIFTS = 3


@dataclass
class Candidate:
    """An effect that was added and calibrated with the model.

    Attributes:
        score: that it was chosen by.
        fit: of the extended model.
        losses: ``(S,)`` held-out cost of each sequence.
        gain: over the model without it.
        removed: share of the first model's squared errors of positions that it removed.
        individuals: of an individual effect.
    """

    score: Score
    fit: Fit
    losses: np.ndarray
    gain: Comparison
    removed: float
    individuals: Individuals | None = None

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.score.effect.name

    @property
    def ordered(self) -> bool:
        """Whether an interval has kept its ends in their order."""
        if not self.score.effect.consecutive:
            return True
        own = self.fit.system.terms[place_of(self.fit.system, self.name)]
        first, last = (float(own.get_parameter(name).detach()) for name in ("a", "b"))
        return first < last

    def strength_excludes_neutral(self, sequence: np.ndarray) -> bool:
        """Whether the interval of any of its strengths excludes the neutral value."""
        if self.individuals is not None and self.individuals.interval[0] <= 0:
            return False
        intervals = self.fit.intervals(sequence)
        place = place_of(self.fit.system, self.name)
        known = [
            (strength.neutral, *intervals[self.fit.names.index(f"terms.{place}.{name}")])
            for name, strength in self.score.effect.strengths.items()
            if f"terms.{place}.{name}" in self.fit.names
        ]
        return not known or any(low > neutral or high < neutral for neutral, low, high in known)


def calibrated(
    engine: Engine, before: Fit, score: Score, hopeless: float, one: Individuals | None
) -> tuple[Fit, Individuals | None]:
    """The model with one more effect, and the agents' numbers of an individual one."""
    system, place = extended(before.system, score.effect(**score.options))
    if one is not None:
        system, one = _peopled(engine, system, one)
        return refine(engine, system, tolerance=ROUGH), one
    fit = refine(engine, system, tolerance=ROUGH, hopeless=hopeless)
    if score.effect.consecutive:
        # a strong effect bends the paths, so that the interval of a weak one would be off
        for _ in range(SHIFTS):
            shifted = _shifted(engine, fit, score.effect, place)
            if shifted is None:
                break
            fit = shifted
    return fit, None


def _shifted(engine: Engine, fit: Fit, effect: type[Effect], place: int) -> Fit | None:
    """The fit with another interval, where the same effect once more would explain something."""
    own = fit.system.terms[place]
    assert isinstance(own, effect)
    now = own.options()
    (score,) = Screen(fit, engine.block).scores(traces(engine, fit, effect))
    if score.gain < ROUGH:
        return None
    low, high = score.options["a"], score.options["b"]
    trials = [
        {**now, "a": min(now["a"], low), "b": max(now["b"], high)},
        {**now, "a": max(low, now["a"]), "b": min(high, now["b"])},
    ]
    best = None
    for values in trials:
        if values["b"] <= values["a"]:
            continue
        system = copy.deepcopy(fit.system)
        system.terms[place] = effect(**values)
        try:
            found = refine(engine, system, tolerance=ROUGH, hopeless=fit.cost)
        except SimulationError:
            continue
        if found.cost < (1 - ROUGH) * (fit if best is None else best).cost:
            best = found
    return best


def again(engine: Engine, fit: Fit, chosen: Candidate) -> Fit:
    """Everybody's numbers once more, around the parameters that the model has with them."""
    kind, one = chosen.score.effect, chosen.individuals
    assert issubclass(kind, IndividualEffect)
    assert one is not None
    if len(engine.people[0]) == 1:
        plain = evaluated(engine, without(fit.system, kind.name))
        one = individuals(engine, plain, kind)
        if one is None:
            return fit
    system, chosen.individuals = _peopled(engine, copy.deepcopy(fit.system), one)
    return refine(engine, system)


def _peopled(engine: Engine, system: System, one: Individuals) -> tuple[System, Individuals]:
    """A model with an individual effect, and everybody's numbers in it."""
    one = sharpened(engine, system, one)
    for effect in effects_of(system):
        if isinstance(effect, one.effect):
            effect.people = one.people
    return system, one
