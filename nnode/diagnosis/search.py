"""Stepwise selection of effects: forward addition, then backward elimination."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from nnode.calibrate.parameters import ParameterVector, with_parameters
from nnode.diagnosis import thresholds
from nnode.diagnosis.candidate import Candidate, calibrated
from nnode.diagnosis.curves import curves
from nnode.diagnosis.lanes.followers import FollowersEngine
from nnode.diagnosis.residuals.comparison import Comparison
from nnode.diagnosis.residuals.engine import AgentsEngine, Engine, square_of
from nnode.diagnosis.residuals.fit import FINE, ROUGH, Fit, refine
from nnode.diagnosis.residuals.variables import Variable
from nnode.diagnosis.statistics.bias import SimulatedFits, mean_scores, simulated_fits
from nnode.diagnosis.statistics.paired import compare, heldout, j_test, presence_pvalue
from nnode.diagnosis.statistics.profile import refined_edges, residuals_at
from nnode.diagnosis.statistics.score import Score, Screen, Trace, traces
from nnode.errors import SimulationError
from nnode.model.effects import Effect
from nnode.model.extend import effects_of, place_of, without
from nnode.model.system import System
from nnode.population.drivers import likeliest

log = logging.getLogger(__name__)

#: A mean square error of positions, m², below which nothing is left to be explained: 1 mm.
EXACT = 1e-6
#: At most so many effects are calibrated in a round, and so many with refitted variances.
RIVALS, LIKELY = 5, 3
#: Ends of periods within a sequence are tried so many seconds apart.
APART = 1.0


@dataclass
class Step:
    """An effect that was accepted.

    Attributes:
        chosen: the candidate.
        rivals: candidates that the data cannot distinguish from it, with the test against each.
    """

    chosen: Candidate
    rivals: list[tuple[Candidate, Comparison]]


@dataclass
class Selection:
    """The state of a selection of effects.

    Attributes:
        fit: of the model with all accepted effects.
        steps: in order of acceptance.
        scores: the score tests of all other effects against ``fit``.
        screen: the screen that computed them.
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


def initial_fit(engine: Engine, system: System) -> Fit | None:
    """A model calibrated to the engine's residuals with their present whitening, from the better of
    two starts: its own parameters, and a regression on the measured rates. None if the simulations
    of both diverge."""
    regression = getattr(engine, "regression_start", None)
    starts = [copy.deepcopy(system), *([] if regression is None else [regression(system)])]
    fits = []
    for start in starts:
        with suppress(SimulationError):
            fits.append(refine(engine, start, tolerance=ROUGH))
    return min(fits, key=lambda fit: fit.cost, default=None)


def likely_extensions(engine: Engine, fit: Fit, effects: list[type[Effect]]) -> list[System]:
    """The model with each of the effects that explain most of the present residuals, calibrated;
    without those whose simulations diverge."""
    effect_traces = [trace for effect in effects for trace in traces(engine, fit, effect)]
    extensions = []
    for score in Screen(fit, engine.cluster).scores(effect_traces)[:LIKELY]:
        with suppress(SimulationError):
            extension = calibrated(engine, fit, score, 0.0)
            if score.effect.consecutive:
                extension = refined_edges(engine, extension, score.effect.name)
            extensions.append(extension.system)
    return extensions


def converged_fit(engine: Engine, system: System, rounds: int = 2) -> Fit:
    """Alternate between calibrating a model and fitting the engine's whitening to its residuals."""
    fit = refine(engine, system)
    for _ in range(rounds):
        engine.fit_whitening(fit.system, ParameterVector(fit.system).row)
        start = fit.system
        if isinstance(engine, AgentsEngine) and engine.population is not None:
            # the agents' deviations belong to these parameters; from others, the search can end in
            # another minimum
            start = engine.population.system
        fit = refine(engine, start)
    return fit


def calibrated_without(engine: Engine, before: Fit, after: Fit, *names: str) -> Fit:
    """A model, calibrated from its own parameters, or from those that it has with further effects
    if it fits better then. Otherwise an effect could pass because the model with it was calibrated
    to a better minimum.

    Args:
        before: the model. after: with the effects. names: of the effects.
    """
    own = refine(engine, before.system)
    with suppress(SimulationError):
        other = refine(engine, without(after.system, *names))
        if other.cost < (1 - ROUGH) * own.cost:
            return other
    return own


def search(
    engine: Engine,
    fit: Fit,
    effects: list[type[Effect]],
    *,
    max_effects: int = 4,
    seed: int = 0,
    variables: list[Variable] | None = None,
    levels: dict[str, np.ndarray] | None = None,
    within: Callable[[float], None] = lambda part: None,
    hints: Sequence[System] = (),
) -> Selection:
    """Add effects until none passes, then eliminate those that are not needed.

    If a free curve predicts better than an effect, the effect is kept only if a second effect is
    added and no curve predicts better than both. When two effects act at once, a curve may describe
    one of them while the other is added first.

    Args:
        engine: of the exploration sequences.
        fit: the calibrated model, with the engine's whitening fitted to its residuals.
        effects: the candidates.
        max_effects: the largest number of effects that are added.
        seed: of the sign flips.
        variables: no effect is accepted if a curve of one of these predicts better, because then
            the catalogue lacks the true effect.
        levels: by an effect's name the independent clusters ``(n,)`` of its test, if they are
            coarser than the engine's.
        within: called with the share of the search that is done.
        hints: calibrated models with effects; the calibrations of these effects also start there.
    """
    selection, levels = Selection(fit), levels or {}
    # the state before an effect was added that predicts worse than a curve
    doubtful: Selection | None = None
    while True:
        screen = _screened(engine, selection, effects, seed, levels, within)
        selection.first = selection.first or selection.scores
        if len(selection.steps) >= max_effects:
            break
        step = _next_step(engine, selection, hints)
        if step is None:
            break
        if _curve_predicts_better(engine, selection.fit, step.chosen, variables or []):
            if doubtful is not None:
                break
            doubtful = replace(selection, steps=[*selection.steps])
        elif doubtful is not None:
            # the whitening has changed since
            before = refine(engine, doubtful.fit.system)
            retested = _candidate(step.chosen.score, step.chosen.fit, before, screen)
            if _curve_predicts_better(engine, before, retested, variables or []):
                break
            doubtful = None
        selection.steps.append(step)
        selection.fit = converged_fit(engine, step.chosen.fit.system, rounds=1)
        selection.fit = _with_best_ends(engine, selection.fit, step.chosen.score.effect)
        log.info("added %s", step.chosen.name)
    if doubtful is not None:  # the whitening was fitted with more effects
        selection = replace(doubtful, fit=converged_fit(engine, doubtful.fit.system, rounds=1))
        _screened(engine, selection, effects, seed, levels, within)
    return _eliminated(engine, selection)


def _with_best_ends(engine: Engine, fit: Fit, effect: type[Effect]) -> Fit:
    """The fit with the best ends of an interval that the effect may have."""
    if effect.consecutive:
        fit = refined_edges(engine, fit, effect.name)
        if isinstance(engine, FollowersEngine) and not effect.overlapping:
            return _with_likeliest_ends(engine, fit, effect.name)
    return fit


def _with_likeliest_ends(engine: FollowersEngine, fit: Fit, name: str) -> Fit:
    """The fit of a model with a period, or a likelier one, an end of which lies within a sequence.

    Where an end lies between sequences, drivers of the nearest ones are estimated as slower or
    faster and their pushes as stronger, and the cost does not show that the end lies within.
    Drivers are therefore estimated again, with the end at the place in each of the two sequences
    that costs least by usual variances.
    """
    place, spans = place_of(fit.system, name), [(s.time[0], s.time[-1]) for s in engine.sequences]
    index = [fit.names.index(f"terms.{place}.{end}") for end in ("a", "b")]
    for k in index:
        value = float(fit.row[k])
        if any(low < value < high for low, high in spans) or engine.population is None:
            continue
        nearest = [
            max((span for span in spans if span[1] <= value), default=None),
            min((span for span in spans if span[0] >= value), default=None),
        ]
        populations, usual = [engine.population], engine.with_usual_variances(fit.system)
        for low, high in filter(None, nearest):
            at = np.linspace(low, high, round((high - low) / APART) + 1)
            costs = (residuals_at(usual, fit, k, at) ** 2).sum(1)
            row = fit.row.copy()
            row[k] = at[np.nan_to_num(costs, nan=np.inf).argmin()]
            if row[index[0]] < row[index[1]]:
                with suppress(SimulationError):
                    moved = engine.population_of(with_parameters(fit.system, row))
                    populations.append(engine.reselected(moved))
        engine.set_population(likeliest(populations))
        if engine.population is not populations[0]:
            fit = refine(engine, engine.population.system)
    return fit


def _screened(
    engine: Engine,
    selection: Selection,
    effects: list[type[Effect]],
    seed: int,
    levels: dict[str, np.ndarray],
    within: Callable[[float], None],
) -> Screen:
    """Compute the score tests of all effects that the model lacks."""
    present = {effect.name for effect in effects_of(selection.fit.system)}
    n_steps = len(selection.steps)
    within(n_steps / (n_steps + 2))  # most searches end in the round after this one
    candidates = [effect for effect in effects if effect.name not in present]
    effect_traces = [
        trace for effect in candidates for trace in traces(engine, selection.fit, effect)
    ]
    within((n_steps + 0.5) / (n_steps + 2))
    selection.screen = Screen(selection.fit, engine.cluster, seed + n_steps, levels=levels)
    selection.scores = selection.screen.scores(effect_traces)
    significant = {s.effect.name for s in selection.scores if s.p_value <= thresholds.EACH}
    if significant and (simulated := simulated_fits(engine, selection.fit, seed)):
        for effect in candidates:
            if effect.name in significant:
                _set_bias(effect_traces, effect, simulated, selection.screen)
        screen = Screen(selection.fit, engine.cluster, seed + n_steps, levels=levels)
        corrected = {s.effect.name: s.p_value for s in screen.scores(effect_traces)}
        selection.scores = [
            replace(score, p_value=max(score.p_value, corrected.get(score.effect.name, 1.0)))
            for score in selection.scores
        ]
    return selection.screen


def _set_bias(
    effect_traces: list[Trace], effect: type[Effect], simulated: SimulatedFits, screen: Screen
) -> None:
    """Set the bias of an effect's traces: their mean scores in paths simulated by the model."""
    label = screen.label(effect.name)
    simulated_traces = {id(fit): traces(engine, fit, effect) for engine, fit in simulated}
    for k, trace in enumerate(t for t in effect_traces if t.effect is effect):
        columns = {key: sample[k].columns for key, sample in simulated_traces.items()}
        trace.bias = mean_scores(simulated, partial(_columns, columns), label)


def _columns(columns: dict[int, np.ndarray], _: Engine, fit: Fit) -> np.ndarray:
    return columns[id(fit)]


def _next_step(engine: Engine, selection: Selection, hints: Sequence[System]) -> Step | None:
    """The best effect that passes all tests, with its rivals; None if no effect passes."""
    scores, screen = selection.scores, selection.screen
    assert screen is not None
    if not scores:
        return None
    scores = sorted(scores, key=lambda score: -score.gain)
    significant = min(score.p_value for score in scores) <= thresholds.EACH
    hinted = {effect.name for hint in hints for effect in effects_of(hint)}
    # the linear score test can miss a strong, nonlinear effect. Where agents differ, variances were
    # already fitted with the most likely extension, so that only hints can be such effects
    strong = hinted if isinstance(engine, AgentsEngine) else {s.effect.name for s in scores}
    ranked = [s for s in scores if s.gain >= thresholds.RIVAL * scores[0].gain][:RIVALS]
    if not significant:
        ranked = [s for s in ranked if s.effect.name in strong]
    # the whitening removes most of a change by a property of agents, as of all that differs between
    # agents, so that its gain is too small until the variances are refitted
    hidden = {s.effect.name for s in scores if s.effect.covariate and s.p_value <= thresholds.EACH}
    ranked += [s for s in scores if s.effect.name in hinted | hidden and s not in ranked]
    candidates = _ranked(engine, selection, ranked, hints, significant) if ranked else []
    eligible = [
        c
        for c in candidates
        if c.gain.gain > 0
        and c.presence_pvalue < thresholds.LEVEL
        and c.strength_excludes_neutral(screen.label(c.name))
        and c.ordered
        and engine.relevant(selection.fit.system, c.fit.system, selection.square)
    ]
    passing = [c for c in eligible if c.score.p_value <= thresholds.EACH]
    if not passing:
        passing = [
            c
            for c in eligible
            if c.name in strong and _significant_held_out(c, screen, len(scores))
        ]
    if not passing:
        return None
    best = _simplest(passing, screen)
    if best.score.p_value > thresholds.EACH:
        best.score = replace(best.score, p_value=best.presence_pvalue * len(scores))
    tests = [(rival, _j_test(rival, best, screen)) for rival in candidates if rival is not best]
    return Step(best, [(rival, test) for rival, test in tests if _is_rival(best, rival, test)])


def _ranked(
    engine: Engine,
    selection: Selection,
    ranked: list[Score],
    hints: Sequence[System],
    significant: bool,
) -> list[Candidate]:
    """The candidates calibrated with the model, the best first; none if the model fits exactly.

    Args:
        significant: whether any score test rejects. Otherwise, where agents are alike, further
            candidates are calibrated only if the first one is significant on held-out clusters.
    """
    screen, candidates = selection.screen, list[Candidate]()
    assert screen is not None
    square = square_of(engine, selection.fit.system)
    selection.square = selection.square or square
    if square < EXACT:
        return []
    for score in ranked:
        lowest_cost = min((c.fit.cost for c in candidates), default=0.0)
        starts = _hinted(hints, selection.fit.system, score.effect.name)
        try:
            fit = calibrated(engine, selection.fit, score, lowest_cost, starts)
        except SimulationError:
            continue
        candidates.append(_candidate(score, fit, selection.fit, screen))
        followed = significant or len(candidates) > 1 or isinstance(engine, AgentsEngine)
        if not followed and not _significant_held_out(candidates[0], screen, len(selection.scores)):
            return []
    if candidates and isinstance(engine, AgentsEngine):
        candidates = _with_refitted_variances(engine, candidates, selection)
    return _refined(engine, sorted(candidates, key=lambda c: -c.gain.gain), selection)


def _with_refitted_variances(
    engine: AgentsEngine, candidates: list[Candidate], selection: Selection
) -> list[Candidate]:
    """The candidates with variances refitted under the most likely of them, if it is likelier than
    the model without it. The variances of the model without a strong effect would attribute it to
    autocorrelated pushes."""
    assert selection.screen is not None
    assert engine.population is not None
    by_cost = sorted(candidates, key=lambda c: c.fit.cost)
    refitted_first = by_cost[:LIKELY] + [c for c in by_cost[LIKELY:] if c.score.effect.covariate]
    populations = dict[str, Any]()
    for candidate in refitted_first:
        with suppress(SimulationError):
            populations[candidate.name] = engine.population_of(candidate.fit.system)
    likely = likeliest([engine.population, *populations.values()])
    if likely is not engine.population:
        engine.set_population(engine.reselected(likely))
    fits = list[tuple[Fit, Candidate]]()
    for candidate in candidates:
        population = populations.get(candidate.name)
        start = candidate.fit.system if population is None else population.system
        fits.append((refine(engine, start, tolerance=ROUGH), candidate))
    best, candidate = min(fits, key=lambda each: each[0].cost)
    selection.fit = calibrated_without(engine, selection.fit, best, candidate.name)
    return [_candidate(c.score, fit, selection.fit, selection.screen) for fit, c in fits]


def _is_rival(best: Candidate, rival: Candidate, test: Comparison) -> bool:
    """Whether the test does not reject another effect that does not contain the best one."""
    return test.p_value > apart_at(best, rival) and not _contains(rival, best)


def _significant_held_out(candidate: Candidate, screen: Screen, n_tried: int) -> bool:
    """Whether the held-out score of one of ``n_tried`` effects is significant, and its interval
    excludes all negligible strengths."""
    label = screen.label(candidate.name)
    significant = candidate.presence_pvalue * n_tried <= thresholds.STRICT
    return significant and candidate.strength_excludes_neutral(label, minimal=True)


def apart_at(first: Candidate, second: Candidate) -> float:
    """The level of the test between two effects."""
    group = first.score.effect.confusable_group
    same_group = group and group == second.score.effect.confusable_group
    return thresholds.STRICT if same_group else thresholds.LEVEL


def _hinted(hints: Sequence[System], system: System, name: str) -> list[System]:
    """Hints that contain all effects of a model and one more, each without its other effects."""
    required, starts = {effect.name for effect in effects_of(system)} | {name}, []
    for hint in hints:
        present = {effect.name for effect in effects_of(hint)}
        if required <= present:
            starts.append(without(hint, *(present - required)))
    return starts


def _candidate(score: Score, fit: Fit, before: Fit, screen: Screen) -> Candidate:
    """A fitted candidate, compared on the effect's clusters with the model without it."""
    label = screen.label(score.effect.name)
    losses = heldout(fit, label)
    gain = compare(heldout(before, label), losses)
    return Candidate(score, fit, losses, gain, presence_pvalue(before, fit, label))


def _j_test(first: Candidate, second: Candidate, screen: Screen) -> Comparison:
    """The J test of the first candidate against the second, on the coarser clusters of the two."""
    label = min(
        (screen.label(candidate.name) for candidate in (first, second)),
        key=lambda label: int(label.max()),
    )
    return j_test(first.fit, second.fit, label)


def _refined(engine: Engine, candidates: list[Candidate], selection: Selection) -> list[Candidate]:
    """The candidates with converged calibrations, the best first. Similar effects differ by less
    than the tolerance of the rough calibration."""
    assert selection.screen is not None
    if not candidates or candidates[0].gain.gain <= 0:
        return candidates
    refined = []
    for candidate in candidates:
        fit = refine(engine, candidate.fit.system, tolerance=FINE)
        refined.append(_candidate(candidate.score, fit, selection.fit, selection.screen))
    return sorted(refined, key=lambda c: -c.gain.gain)


def _curve_predicts_better(
    engine: Engine, fit: Fit, best: Candidate, variables: list[Variable]
) -> bool:
    """Whether a nonparametric curve predicts better than an effect."""
    for curve in curves(engine, fit, variables) if variables else []:
        if curve.p_value < thresholds.LEVEL:
            test = compare(heldout(best.fit, engine.cluster), curve.losses)
            if test.p_value < thresholds.LEVEL:
                return True
    return False


def _simplest(candidates: list[Candidate], screen: Screen) -> Candidate:
    """The best candidate, or one that is as good and has fewer parameters, or equally many and a
    larger likelihood."""
    best = candidates[0]
    for candidate in candidates[1:]:
        sizes = len(candidate.fit.row), len(best.fit.row)
        likelier = sizes[0] == sizes[1] and candidate.fit.cost < best.fit.cost
        comparable = candidate.gain.gain >= thresholds.AS_GOOD * best.gain.gain
        distinguishable = _j_test(candidate, best, screen).p_value <= apart_at(candidate, best)
        if (sizes[0] < sizes[1] or likelier) and comparable and not distinguishable:
            best = candidate
    return best


def _contains(wider: Candidate, narrower: Candidate) -> bool:
    """Whether one effect is a special case of the other."""
    return narrower.name in wider.score.effect.contains


def without_steps(
    engine: Engine, selection: Selection, steps: list[Step], base: System
) -> Selection:
    """A selection without some of its effects, recalibrated.

    Args:
        base: the calibrated model without effects.
    """
    if not steps:
        return selection
    kept = [step for step in selection.steps if step not in steps]
    names = [step.chosen.name for step in steps]
    start = without(selection.fit.system, *names) if kept else copy.deepcopy(base)
    return replace(selection, fit=converged_fit(engine, start, rounds=1), steps=kept)


def _eliminated(engine: Engine, selection: Selection) -> Selection:
    """Backward elimination: remove effects that are no longer needed, and rivals that can be
    distinguished given the other effects. Effects are ordered by their held-out gain, so that
    weaker ones are tested given stronger ones."""
    reduced: list[tuple[Comparison, Step, Fit]] = []
    while len(selection.steps) > 1:
        losses = heldout(selection.fit, engine.cluster)
        reduced = []
        for step in selection.steps:
            fit = refine(engine, without(selection.fit.system, step.chosen.name))
            reduced.append((compare(heldout(fit, engine.cluster), losses), step, fit))
        reduced.sort(key=lambda item: -item[0].gain)
        selection.steps = [step for _, step, _ in reduced]
        needless = [
            item
            for item in reduced
            if item[0].gain <= 0
            or presence_pvalue(item[2], selection.fit, engine.cluster) > thresholds.LEVEL
        ]
        if not needless:
            break
        _, step, selection.fit = needless[-1]
        selection.steps.remove(step)
        log.info("took back %s", step.chosen.name)
    if len(selection.steps) > 1:
        for _, step, before in reduced:
            step.rivals = _rivals_given_others(engine, selection, step, before)
    return selection


def _rivals_given_others(
    engine: Engine, selection: Selection, step: Step, before: Fit
) -> list[tuple[Candidate, Comparison]]:
    """The rivals of an effect that cannot be distinguished from it given the other effects.

    Args:
        before: the model with only the other effects.
    """
    assert selection.screen is not None
    added = {accepted.chosen.name for accepted in selection.steps}
    chosen = _candidate(step.chosen.score, selection.fit, before, selection.screen)
    rivals = []
    for rival, _ in step.rivals:
        if rival.name in added:
            continue
        try:
            fit = calibrated(engine, before, rival.score, 0.0)
        except SimulationError:
            continue
        fit = refine(engine, fit.system, tolerance=FINE)
        refitted = _candidate(rival.score, fit, before, selection.screen)
        test = _j_test(refitted, chosen, selection.screen)
        if test.p_value > apart_at(chosen, refitted):
            rivals.append((refitted, test))
    return rivals
