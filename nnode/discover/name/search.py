"""Adding effects one after the other, and taking back those that are not needed."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from nnode.calibrate.parameters import ParameterVector
from nnode.discover.lanes.followers import FollowersEngine
from nnode.discover.locate.curves import curves
from nnode.discover.name.candidate import Candidate, calibrated
from nnode.discover.residuals.comparison import Comparison
from nnode.discover.residuals.engine import Engine, square_of
from nnode.discover.residuals.fit import FINE, ROUGH, Fit, refine
from nnode.discover.residuals.variables import Variable
from nnode.discover.rules import rules
from nnode.discover.statistics.bias import Made, made, mean_scores
from nnode.discover.statistics.paired import compare, heldout, outdone, there
from nnode.discover.statistics.profile import moved
from nnode.discover.statistics.score import Score, Screen, Trace, traces
from nnode.errors import SimulationError
from nnode.model.effects import Effect
from nnode.model.extend import effects_of, without
from nnode.model.system import System

log = logging.getLogger(__name__)

#: A mean square error of positions, m², below which nothing is left to be explained: 1 mm.
EXACT = 1e-6
#: At most so many effects are calibrated in a round, and with variances of their own.
RIVALS, LIKELY = 5, 3


@dataclass
class Step:
    """An effect that was accepted.

    Attributes:
        chosen: the candidate.
        rivals: candidates that the data cannot tell from it, with the test against each.
    """

    chosen: Candidate
    rivals: list[tuple[Candidate, Comparison]]


@dataclass
class Search:
    """How far a search for effects came.

    Attributes:
        fit: of the model with all accepted effects.
        steps: in order of acceptance.
        scores: of all effects that are left, against ``fit``.
        screen: that they come from.
        first: the scores of all effects against the model as it was given.
        square: mean square error of positions of the model without any effect, m²; 0 until it
            is known.
    """

    fit: Fit
    steps: list[Step] = field(default_factory=list)
    scores: list[Score] = field(default_factory=list)
    screen: Screen | None = None
    first: list[Score] = field(default_factory=list)
    square: float = 0.0


def begun(engine: Engine, system: System) -> Fit | None:
    """A model calibrated in the engine's residuals as they are, from the better of two starts: its
    own parameters, and those near the measured rates. None where both blow up."""
    near = getattr(engine, "near", None)
    fits = []
    for start in (copy.deepcopy(system), *([] if near is None else [near(system)])):
        try:
            fits.append(refine(engine, start, tolerance=ROUGH))
        except SimulationError:
            continue
    return min(fits, key=lambda fit: fit.cost, default=None)


def wider(engine: Engine, fit: Fit, effects: list[type[Effect]]) -> list[System]:
    """The model with the effect that explains most of residuals as they are, calibrated; nothing
    where that cannot be simulated."""
    look = [trace for effect in effects for trace in traces(engine, fit, effect)]
    for score in Screen(fit, engine.cluster).scores(look)[:1]:
        try:
            return [calibrated(engine, fit, score, 0.0).system]
        except SimulationError:
            break
    return []


def settled(engine: Engine, system: System, rounds: int = 2) -> Fit:
    """Calibrate a model, and the engine's filter to what it leaves, in turns."""
    fit = refine(engine, system)
    for _ in range(rounds):
        engine.settle(fit.system, ParameterVector(fit.system).row)
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
    variables: list[Variable] | None = None,
    levels: dict[str, np.ndarray] | None = None,
    within: Callable[[float], None] = lambda part: None,
    hints: list[System] | None = None,
) -> Search:
    """Forwards until no effect passes, then backwards.

    An effect that a curve outdoes is kept if a second one comes to it and no curve outdoes both:
    of two effects that act at once, a curve may show one while the other comes first.

    Args:
        engine: of the open sequences.
        fit: the calibrated model, in the engine's filter.
        effects: to look for.
        alpha: probability of naming anything where nothing is hidden.
        most: effects at most.
        seed: of the sign flips.
        variables: no effect is accepted where a curve of one of these predicts better: it is a
            sign of something that the catalogue lacks.
        levels: by an effect's name the clusters ``(n,)`` that tell of it, where they are coarser
            than the engine's.
        within: is told, now and then, about which part of the search is done.
        hints: models with effects, calibrated: the calibration of these effects begins from there
            as well.
    """
    found, levels = Search(fit), levels or {}
    doubtful: Search | None = None  # as it was before an effect that a curve outdoes
    while True:
        screen = _screened(engine, found, effects, seed, levels, within, alpha)
        found.first = found.first or found.scores
        if len(found.steps) >= most:
            break
        step = _round(engine, found, alpha, hints or [])
        if step is None:
            break
        if _outdone(engine, found.fit, step.chosen, variables or []):
            if doubtful is not None:
                break
            doubtful = replace(found, steps=[*found.steps])
        elif doubtful is not None:
            # in the filter of now
            before = refine(engine, doubtful.fit.system)
            both = _candidate(step.chosen.score, step.chosen.fit, before, screen, 0.0)
            if _outdone(engine, before, both, variables or []):
                break
            doubtful = None
        found.steps.append(step)
        found.fit = settled(engine, step.chosen.fit.system, rounds=1)
        if step.chosen.score.effect.consecutive:
            found.fit = moved(engine, found.fit, step.chosen.name)
        log.info("added %s", step.chosen.name)
    if doubtful is not None:  # the filter is that of a model with more effects
        found = replace(doubtful, fit=settled(engine, doubtful.fit.system, rounds=1))
        _screened(engine, found, effects, seed, levels, within, alpha)
    return _pruned(engine, found)


def _screened(
    engine: Engine,
    found: Search,
    effects: list[type[Effect]],
    seed: int,
    levels: dict[str, np.ndarray],
    within: Callable[[float], None],
    alpha: float,
) -> Screen:
    """Give all effects that a model lacks their scores."""
    own = {effect.name for effect in effects_of(found.fit.system)}
    begun = len(found.steps)
    within(begun / (begun + 2))  # of most searches, the last but one round finds nothing more
    left = [effect for effect in effects if effect.name not in own]
    look = [trace for effect in left for trace in traces(engine, found.fit, effect)]
    within((begun + 0.5) / (begun + 2))
    found.screen = Screen(found.fit, engine.cluster, seed + begun, levels=levels)
    found.scores = found.screen.scores(look)
    shown = {score.effect.name for score in found.scores if score.p_value <= alpha}
    if shown and (drawn := made(engine, found.fit, seed)):
        for effect in left:
            if effect.name in shown:
                _unbiased(look, effect, drawn, found.screen)
        again = Screen(found.fit, engine.cluster, seed + begun, levels=levels).scores(look)
        least = {score.effect.name: score.p_value for score in again}
        found.scores = [
            replace(score, p_value=max(score.p_value, least.get(score.effect.name, 1.0)))
            for score in found.scores
        ]
    return found.screen


def _unbiased(look: list[Trace], effect: type[Effect], drawn: Made, screen: Screen) -> None:
    """Note in an effect's traces what they show in paths that the model has made."""
    label = screen.label(effect.name)
    again = {id(fit): traces(engine, fit, effect) for engine, fit in drawn}
    for k, trace in enumerate(one for one in look if one.effect is effect):
        columns = {own: every[k].columns for own, every in again.items()}
        trace.bias = mean_scores(drawn, partial(_columns, columns), label)


def _columns(known: dict[int, np.ndarray], _: Engine, fit: Fit) -> np.ndarray:
    return known[id(fit)]


def _round(engine: Engine, found: Search, alpha: float, hints: list[System]) -> Step | None:
    scores, screen = found.scores, found.screen
    assert screen is not None
    if not scores:
        return None
    scores = sorted(scores, key=lambda score: -score.gain)
    shown = min(score.p_value for score in scores) <= alpha
    if not shown and isinstance(engine, FollowersEngine):
        return None  # strong effects show in the variances of the likeliest model
    hinted = {effect.name for hint in hints for effect in effects_of(hint)}
    tried = [s for s in scores if s.gain >= rules().rival * scores[0].gain][:RIVALS]
    tried += [score for score in scores if score.effect.name in hinted and score not in tried]
    candidates = _in_order(engine, found, tried, hints, shown)
    good = [
        c
        for c in candidates
        if c.removed >= engine.least
        and c.gain.gain > 0
        and c.there < rules().level
        and c.strength_excludes_neutral(screen.label(c.name))
        and c.ordered
    ]
    passing = [c for c in good if c.score.p_value <= alpha]
    if not passing and not isinstance(engine, FollowersEngine):
        passing = [c for c in good if _sure(c, screen, len(scores))]
    if not passing:
        return None
    best = _simplest(passing, screen)
    if best.score.p_value > alpha:
        best.score = replace(best.score, p_value=best.there * len(scores))
    tests = [(other, _between(other, best, screen)) for other in candidates if other is not best]
    return Step(best, [(other, test) for other, test in tests if _rivals(best, other, test)])


def _in_order(
    engine: Engine, found: Search, tried: list[Score], hints: list[System], shown: bool
) -> list[Candidate]:
    """Effects calibrated with the model, the best first; none where nothing is left to explain.

    Args:
        shown: whether a score passes; otherwise only a leading effect that is sure is followed.
    """
    screen, candidates = found.screen, list[Candidate]()
    assert screen is not None
    square = square_of(engine, found.fit.system)
    found.square = found.square or square
    if square < EXACT:
        return []
    for score in tried:
        least = min((c.fit.cost for c in candidates), default=0.0)
        starts = _hinted(hints, found.fit.system, score.effect.name)
        try:
            fit = calibrated(engine, found.fit, score, least, starts)
        except SimulationError:
            continue
        removed = (square - square_of(engine, fit.system)) / found.square
        candidates.append(_candidate(score, fit, found.fit, screen, removed))
        # a strong effect is far from linear: held-out clusters may be sure of what no score shows
        leads = shown or len(candidates) > 1
        if not leads and not _sure(candidates[0], screen, len(found.scores)):
            return []
    if isinstance(engine, FollowersEngine):
        candidates = _in_best_variances(engine, candidates, found)
    return _to_the_end(engine, sorted(candidates, key=lambda c: -c.gain.gain), found)


def _in_best_variances(
    engine: FollowersEngine, candidates: list[Candidate], found: Search
) -> list[Candidate]:
    """Candidates in the variances of the likeliest of them: in those of the model without it, a
    strong effect is taken for pushes that last."""
    assert found.screen is not None
    likely = sorted(candidates, key=lambda c: c.fit.cost)[:LIKELY]
    engine.settle_among([one.fit.system for one in likely])
    found.fit = refine(engine, found.fit.system)
    again = []
    for one in candidates:
        fit = refine(engine, one.fit.system, tolerance=ROUGH)
        again.append(_candidate(one.score, fit, found.fit, found.screen, one.removed))
    return again


def _rivals(best: Candidate, other: Candidate, test: Comparison) -> bool:
    """Whether a test does not tell another effect from the best one, and it is no larger one."""
    return test.p_value > apart_at(best, other) and not _contains(other, best)


def _sure(one: Candidate, screen: Screen, tried: int) -> bool:
    """Whether held-out clusters lean the way of one of ``tried`` effects beyond all doubt, and it
    is more than what is taken for none."""
    label = screen.label(one.name)
    lean = one.there * tried <= rules().sure
    return lean and one.strength_excludes_neutral(label, minimal=True)


def apart_at(one: Candidate, other: Candidate) -> float:
    """The level at which two effects are told apart."""
    group = one.score.effect.confusable_group
    return rules().sure if group and group == other.score.effect.confusable_group else rules().level


def _hinted(hints: list[System], system: System, name: str) -> list[System]:
    """Hints that have all effects of a model and one more, each without its other effects."""
    wanted, starts = {effect.name for effect in effects_of(system)} | {name}, []
    for hint in hints:
        known = {effect.name for effect in effects_of(hint)}
        if wanted <= known:
            starts.append(without(hint, *(known - wanted)))
    return starts


def _candidate(score: Score, fit: Fit, before: Fit, screen: Screen, removed: float) -> Candidate:
    """Compared with the model without it, on the clusters that tell of the effect."""
    label = screen.label(score.effect.name)
    losses = heldout(fit, label)
    gain = compare(heldout(before, label), losses)
    return Candidate(score, fit, losses, gain, there(before, fit, label), removed)


def _between(first: Candidate, second: Candidate, screen: Screen) -> Comparison:
    """Whether the second candidate outdoes the first, on the coarser clusters of the two."""
    label = min(
        (screen.label(one.name) for one in (first, second)), key=lambda label: int(label.max())
    )
    return outdone(first.fit, second.fit, label)


def _to_the_end(engine: Engine, candidates: list[Candidate], found: Search) -> list[Candidate]:
    """Candidates in their order, calibrated to the end: kin differ by less than a rough calibration
    leaves."""
    assert found.screen is not None
    if not candidates or candidates[0].gain.gain <= 0:
        return candidates
    ended = []
    for one in candidates:
        fit = refine(engine, one.fit.system, tolerance=FINE)
        ended.append(_candidate(one.score, fit, found.fit, found.screen, one.removed))
    return sorted(ended, key=lambda c: -c.gain.gain)


def _outdone(engine: Engine, fit: Fit, best: Candidate, variables: list[Variable]) -> bool:
    """Whether a curve without a formula predicts better than an effect."""
    for curve in curves(engine, fit, variables) if variables else []:
        if curve.p_value < rules().level:
            test = compare(heldout(best.fit, engine.cluster), curve.losses)
            if test.p_value < rules().level:
                return True
    return False


def _simplest(candidates: list[Candidate], screen: Screen) -> Candidate:
    """The best candidate, or one that is as good and has fewer parameters, or as many and a
    greater likelihood."""
    best = candidates[0]
    for other in candidates[1:]:
        number = len(other.fit.row), len(best.fit.row)
        likelier = number[0] == number[1] and other.fit.cost < best.fit.cost
        near = other.gain.gain >= rules().near * best.gain.gain
        apart = _between(other, best, screen).p_value <= rules().level
        if (number[0] < number[1] or likelier) and near and not apart:
            best = other
    return best


def _contains(wider: Candidate, narrower: Candidate) -> bool:
    """Whether one effect is a special case of the other."""
    return narrower.name in wider.score.effect.contains


def without_steps(engine: Engine, found: Search, steps: list[Step], base: System) -> Search:
    """A search without some of its effects, calibrated anew.

    Args:
        base: the calibrated model without any.
    """
    if not steps:
        return found
    kept = [step for step in found.steps if step not in steps]
    names = [step.chosen.name for step in steps]
    start = without(found.fit.system, *names) if kept else copy.deepcopy(base)
    return replace(found, fit=settled(engine, start, rounds=1), steps=kept)


def _pruned(engine: Engine, found: Search) -> Search:
    """Take back effects that the later ones have made needless, and rivals that are told apart
    beside them. What held-out clusters need most comes first: beside it others are confirmed, and
    alone they would drown in what it does."""
    rest: list[tuple[Comparison, Step, Fit]] = []
    while len(found.steps) > 1:
        losses = heldout(found.fit, engine.cluster)
        rest = []
        for step in found.steps:
            fit = refine(engine, without(found.fit.system, step.chosen.name))
            rest.append((compare(heldout(fit, engine.cluster), losses), step, fit))
        rest.sort(key=lambda one: -one[0].gain)
        found.steps = [step for _, step, _ in rest]
        needless = [
            one
            for one in rest
            if one[0].gain <= 0 or there(one[2], found.fit, engine.cluster) > rules().level
        ]
        if not needless:
            break
        _, step, found.fit = needless[-1]
        found.steps.remove(step)
        log.info("took back %s", step.chosen.name)
    if len(found.steps) > 1:
        for _, step, before in rest:
            step.rivals = _rivals_beside(engine, found, step, before)
    return found


def _rivals_beside(
    engine: Engine, found: Search, step: Step, before: Fit
) -> list[tuple[Candidate, Comparison]]:
    """The rivals of an effect that are not told apart from it beside the other effects.

    Args:
        before: the model with the other effects alone.
    """
    assert found.screen is not None
    added = {one.chosen.name for one in found.steps}
    one = _candidate(step.chosen.score, found.fit, before, found.screen, step.chosen.removed)
    rivals = []
    for rival, _ in step.rivals:
        if rival.name in added:
            continue
        try:
            fit = calibrated(engine, before, rival.score, 0.0)
        except SimulationError:
            continue
        fit = refine(engine, fit.system, tolerance=FINE)
        other = _candidate(rival.score, fit, before, found.screen, rival.removed)
        test = _between(other, one, found.screen)
        if test.p_value > apart_at(one, other):
            rivals.append((other, test))
    return rivals
