"""Candidate effects: added to a model, calibrated with it, and tested."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nnode.diagnosis.residuals.comparison import Comparison
from nnode.diagnosis.residuals.engine import Engine
from nnode.diagnosis.residuals.fit import ROUGH, Fit, refine
from nnode.diagnosis.statistics.score import Score, Screen, negligible_strengths, traces
from nnode.errors import SimulationError
from nnode.model.effects import Effect
from nnode.model.extend import extended, place_of
from nnode.model.system import System

#: Largest number of shifts of an interval.
SHIFTS = 3


@dataclass
class Candidate:
    """An effect that was added and calibrated with the model.

    Attributes:
        score: its score test.
        fit: of the extended model.
        losses: ``(G,)`` held-out costs of the effect's clusters.
        gain: over the model without it.
        presence_pvalue: of the one-sided score test on held-out clusters.
    """

    score: Score
    fit: Fit
    losses: np.ndarray
    gain: Comparison
    presence_pvalue: float

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.score.effect.name

    @property
    def ordered(self) -> bool:
        """Whether the ends of an interval are in order."""
        if not self.score.effect.consecutive:
            return True
        term = self.fit.system.terms[place_of(self.fit.system, self.name)]
        low, high = (float(term.get_parameter(name).detach()) for name in ("a", "b"))
        return low < high

    def strength_excludes_neutral(self, cluster: np.ndarray, *, minimal: bool = False) -> bool:
        """Whether the interval of any of its strengths, given its settings, excludes the neutral
        value. With a neutral strength, settings have no influence, so that their errors say nothing
        about whether the strength is neutral (Davies 1977).

        Args:
            minimal: whether it must exclude all negligible strengths as well.
        """
        effect, place = self.score.effect, place_of(self.fit.system, self.name)
        settings = [f"terms.{place}.{name}" for name in effect.settings]
        given_settings = replace(self.fit, free=self.fit.free & ~np.isin(self.fit.names, settings))
        intervals = given_settings.jackknife_intervals(cluster)
        negligible = negligible_strengths(effect, len(effect.strengths)) * minimal
        bounds = [
            (strength.neutral, margin, *intervals[self.fit.names.index(f"terms.{place}.{name}")])
            for (name, strength), margin in zip(effect.strengths.items(), negligible, strict=True)
            if f"terms.{place}.{name}" in self.fit.names
        ]
        return not bounds or any(
            low > neutral + margin or high < neutral - margin
            for neutral, margin, low, high in bounds
        )


def calibrated(
    engine: Engine, before: Fit, score: Score, hopeless: float, hints: Sequence[System] = ()
) -> Fit:
    """Calibrate the model with one more effect, from the score's settings and from hints.

    Args:
        hopeless: see :func:`~nnode.diagnosis.residuals.fit.refine`.
        hints: the extended model with other parameters.

    Raises:
        SimulationError: its simulation diverges from all starts.
    """
    system, place = extended(before.system, score.effect(**score.options))
    fits = []
    for start in (system, *hints):
        try:
            fits.append(refine(engine, start, tolerance=ROUGH, hopeless=hopeless))
        except SimulationError:
            continue
    if not fits:
        raise SimulationError(f"the model with {score.effect.name} blows up on these data")
    fit = min(fits, key=lambda candidate: candidate.cost)
    if score.effect.consecutive:
        # strong effects change the paths, which shifts the interval of the linearised score
        for _ in range(SHIFTS):
            shifted = _shifted(engine, fit, score.effect, place)
            if shifted is None:
                break
            fit = shifted
    return fit


def _shifted(engine: Engine, fit: Fit, effect: type[Effect], place: int) -> Fit | None:
    """The fit with a better interval, if a second instance of the effect would explain more."""
    term = fit.system.terms[place]
    assert isinstance(term, effect)
    options = term.options()
    (score,) = Screen(fit, engine.cluster).scores(traces(engine, fit, effect))
    if score.gain < ROUGH:
        return None
    low, high = score.options["a"], score.options["b"]
    trials = [
        {**options, "a": min(options["a"], low), "b": max(options["b"], high)},
        {**options, "a": max(low, options["a"]), "b": min(high, options["b"])},
    ]
    best = None
    for values in trials:
        if values["b"] <= values["a"]:
            continue
        system = copy.deepcopy(fit.system)
        system.terms[place] = effect(**values)
        try:
            shifted = refine(engine, system, tolerance=ROUGH, hopeless=fit.cost)
        except SimulationError:
            continue
        if shifted.cost < (1 - ROUGH) * (fit if best is None else best).cost:
            best = shifted
    return best
