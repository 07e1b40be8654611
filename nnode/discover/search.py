"""Adding effects one after the other, and taking back those that are not needed."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import numpy as np

from nnode.discover.compare import Comparison, compare, heldout
from nnode.discover.engine import Engine, row_of
from nnode.discover.fit import Fit, refine
from nnode.discover.score import Score, Screen, Trace, traces
from nnode.errors import SimulationError
from nnode.models.effects import Effect
from nnode.models.extend import effects_of, extended, without
from nnode.models.system import System

log = logging.getLogger(__name__)

#: An effect must remove this share of the held-out cost.
FLOOR = 0.01
#: Effects whose trace explains this share of what the best one explains are calibrated too.
RIVAL = 0.25
#: At most so many effects are calibrated in a round.
RIVALS = 5
#: A rival whose held-out gain is below this share of the best one's is told apart from it.
CLOSE = 0.9
#: Two rivals are told apart at this error probability.
APART = 0.05


@dataclass
class Candidate:
    """An effect that was added and calibrated with the model.

    Attributes:
        score: that it was chosen by.
        fit: of the extended model.
        losses: ``(S,)`` held-out cost of each sequence.
        gain: over the model without it.
    """

    score: Score
    fit: Fit
    losses: np.ndarray
    gain: Comparison

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.score.effect.name

    def strength_excludes_neutral(self, sequence: np.ndarray) -> bool:
        """Whether the interval of any of its strengths excludes the neutral value."""
        intervals = self.fit.intervals(sequence)
        place = next(
            i for i, t in enumerate(self.fit.system.terms) if getattr(t, "name", "") == self.name
        )
        strengths = self.score.effect.strengths
        if not strengths:
            return True
        for name, strength in strengths.items():
            if f"terms.{place}.{name}" not in self.fit.names:
                return True
            low, high = intervals[self.fit.names.index(f"terms.{place}.{name}")]
            if low > strength.neutral or high < strength.neutral:
                return True
        return False


@dataclass
class Step:
    """An effect that was accepted.

    Attributes:
        chosen: the candidate.
        rivals: candidates that the data cannot tell from it, with the test against each.
        scores: of all effects before it was added.
    """

    chosen: Candidate
    rivals: list[tuple[Candidate, Comparison]]
    scores: list[Score]


@dataclass
class Search:
    """How far a search for effects came.

    Attributes:
        fit: of the model with all accepted effects.
        steps: in order of acceptance.
        scores: of all effects that are left, against ``fit``.
        screen: that they come from.
        refused: candidates of the last round that were not accepted.
    """

    fit: Fit
    steps: list[Step] = field(default_factory=list)
    scores: list[Score] = field(default_factory=list)
    screen: Screen | None = None
    refused: list[Candidate] = field(default_factory=list)


def settled(engine: Engine, system: System, rounds: int = 2) -> Fit:
    """Calibrate a model, and the engine's filter to what it leaves, in turns."""
    fit = refine(engine, system)
    for _ in range(rounds):
        engine.settle(fit.system, row_of(fit.system))
        fit = refine(engine, fit.system)
    return fit


def search(
    engine: Engine,
    fit: Fit,
    effects: list[type[Effect]],
    *,
    alpha: float = 0.05,
    most: int = 4,
    seed: int = 0,
) -> Search:
    """Forwards until no effect passes, then backwards.

    Args:
        engine: of the open sequences.
        fit: the calibrated model without effects, in the engine's filter.
        effects: to look for.
        alpha: probability of naming anything where nothing is hidden.
        most: effects at most.
        seed: of the sign flips.
    """
    found = Search(fit)
    while True:
        left = [e for e in effects if e.name not in {t.name for t in effects_of(found.fit.system)}]
        screening = Screen(found.fit, engine.block, seed + len(found.steps))
        all_traces = [trace for effect in left for trace in traces(engine, found.fit, effect)]
        found.screen, found.scores = screening, screening.scores(all_traces)
        if len(found.steps) >= most:
            break
        step = _round(engine, found, all_traces, alpha)
        if step is None:
            break
        found.steps.append(step)
        found.fit = settled(engine, step.chosen.fit.system, rounds=1)
        log.info("added %s", step.chosen.name)
    return _pruned(engine, found)


def _round(engine: Engine, found: Search, all_traces: list[Trace], alpha: float) -> Step | None:
    scores = found.scores
    if not scores or min(score.p_value for score in scores) > alpha:
        return None
    most = max(score.gain for score in scores)
    tried = [score for score in scores if score.gain >= RIVAL * most][:RIVALS]
    before = heldout(found.fit, engine.sequence)
    candidates: list[Candidate] = []
    for score in tried:
        system, _ = extended(found.fit.system, score.effect(**score.options))
        least = min((c.fit.cost for c in candidates), default=0.0)
        try:
            fit = refine(engine, system, hopeless=least)
        except SimulationError:
            continue
        losses = heldout(fit, engine.sequence)
        candidates.append(Candidate(score, fit, losses, compare(before, losses)))
    candidates.sort(key=lambda c: -c.gain.gain)
    passing = [
        c for c in candidates
        if c.score.p_value <= alpha
        and c.gain.gain >= FLOOR
        and c.gain.low > 0
        and c.strength_excludes_neutral(engine.sequence)
    ]  # fmt: skip
    if not passing:
        found.refused = candidates
        return None
    best = _simplest(passing)
    rivals = []
    for other in candidates:
        if other is best or other.gain.gain < CLOSE * best.gain.gain:
            continue
        test = compare(other.losses, best.losses)
        if test.p_value > APART and not _contains(other, best):
            rivals.append((other, test))
    return Step(best, rivals, scores)


def _simplest(candidates: list[Candidate]) -> Candidate:
    """The best candidate, or one with fewer parameters that is as good."""
    best = candidates[0]
    for other in candidates[1:]:
        fewer = len(other.fit.row) < len(best.fit.row)
        near = other.gain.gain >= 0.97 * best.gain.gain
        if fewer and near and compare(other.losses, best.losses).p_value > APART:
            best = other
    return best


def _contains(wider: Candidate, narrower: Candidate) -> bool:
    """Whether one effect is a special case of the other."""
    return narrower.name in wider.score.effect.contains


def _pruned(engine: Engine, found: Search) -> Search:
    """Take back effects that the later ones have made needless."""
    while len(found.steps) > 1:
        losses = heldout(found.fit, engine.sequence)
        worst: tuple[float, Step, Fit] | None = None
        for step in found.steps:
            fit = refine(engine, without(found.fit.system, step.chosen.name))
            test = compare(heldout(fit, engine.sequence), losses)
            if (test.low <= 0 or test.gain < FLOOR) and (worst is None or test.gain < worst[0]):
                worst = test.gain, step, fit
        if worst is None:
            break
        found.steps.remove(worst[1])
        found.fit = worst[2]
        log.info("took back %s", worst[1].chosen.name)
    return found
