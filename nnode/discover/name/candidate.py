"""An effect that is added to a model, calibrated with it, and what can be said of it then."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from nnode.discover.residuals.comparison import Comparison
from nnode.discover.residuals.engine import Engine
from nnode.discover.residuals.fit import ROUGH, Fit, refine
from nnode.discover.statistics.score import Score, Screen, minimal_of, traces
from nnode.errors import SimulationError
from nnode.model.effects import Effect
from nnode.model.extend import extended, place_of
from nnode.model.system import System

#: An interval is moved at most so many times.
SHIFTS = 3


@dataclass
class Candidate:
    """An effect that was added and calibrated with the model.

    Attributes:
        score: that it was chosen by.
        fit: of the extended model.
        losses: ``(G,)`` held-out cost of each cluster that tells of the effect.
        gain: over the model without it.
        there: p-value that held-out clusters do not lean its way.
        removed: share of the first model's squared errors of positions that it removed.
    """

    score: Score
    fit: Fit
    losses: np.ndarray
    gain: Comparison
    there: float
    removed: float

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

    def strength_excludes_neutral(self, cluster: np.ndarray, *, minimal: bool = False) -> bool:
        """Whether the interval of any of its strengths excludes the neutral value; or, if asked,
        all amounts that are taken for none."""
        intervals, effect = self.fit.jackknife_intervals(cluster), self.score.effect
        place = place_of(self.fit.system, self.name)
        none = minimal_of(effect, len(effect.strengths)) * minimal
        known = [
            (strength.neutral, less, *intervals[self.fit.names.index(f"terms.{place}.{name}")])
            for (name, strength), less in zip(effect.strengths.items(), none, strict=True)
            if f"terms.{place}.{name}" in self.fit.names
        ]
        return not known or any(
            low > neutral + less or high < neutral - less for neutral, less, low, high in known
        )


def calibrated(
    engine: Engine, before: Fit, score: Score, hopeless: float, hints: list[System] | None = None
) -> Fit:
    """The model with one more effect, from where its score found it and from hints.

    Args:
        hopeless: see :func:`~nnode.discover.residuals.fit.refine`.
        hints: the extended model with other parameters.

    Raises:
        SimulationError: it blows up.
    """
    system, place = extended(before.system, score.effect(**score.options))
    fits = []
    for start in (system, *(hints or [])):
        try:
            fits.append(refine(engine, start, tolerance=ROUGH, hopeless=hopeless))
        except SimulationError:
            continue
    if not fits:
        raise SimulationError(f"the model with {score.effect.name} blows up on these data")
    fit = min(fits, key=lambda one: one.cost)
    if score.effect.consecutive:
        # a strong effect bends the paths, so that the interval of a weak one would be off
        for _ in range(SHIFTS):
            shifted = _shifted(engine, fit, score.effect, place)
            if shifted is None:
                break
            fit = shifted
    return fit


def _shifted(engine: Engine, fit: Fit, effect: type[Effect], place: int) -> Fit | None:
    """The fit with another interval, where the same effect once more would explain something."""
    own = fit.system.terms[place]
    assert isinstance(own, effect)
    now = own.options()
    (score,) = Screen(fit, engine.cluster).scores(traces(engine, fit, effect))
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
