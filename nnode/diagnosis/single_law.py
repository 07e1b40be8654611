"""The diagnosis of one law: calibrate, locate deviations, select effects, confirm them, report."""

from __future__ import annotations

import copy
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import Any

import numpy as np
import torch

from nnode.data.clusters import least_number, level
from nnode.data.sequence import Sequence
from nnode.diagnosis import thresholds
from nnode.diagnosis.compare import BetterLaw, explained_by_law
from nnode.diagnosis.confirmation import ConfirmationSet
from nnode.diagnosis.crowds.engine import CrowdEngine
from nnode.diagnosis.crowds.people import parameters_differ
from nnode.diagnosis.curves import curves, significant_curves
from nnode.diagnosis.division import SETTLED, Division, divide, spacing
from nnode.diagnosis.eligibility import check_model, not_offered
from nnode.diagnosis.lanes.followers import FollowersEngine
from nnode.diagnosis.model_comparison import engine_of
from nnode.diagnosis.options import DiscoverOptions, check_options
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.residuals.engine import AgentsEngine, Engine, of_residuals, square_of
from nnode.diagnosis.residuals.fit import Fit, refine
from nnode.diagnosis.residuals.variables import Curves, Variable
from nnode.diagnosis.result import (
    Absence,
    Clusters,
    Diagnosis,
    FirstScreen,
    NamedEffect,
    Place,
    Variation,
    Verdict,
)
from nnode.diagnosis.search import (
    Selection,
    calibrated_without,
    converged_fit,
    initial_fit,
    likely_extensions,
    search,
    without_steps,
)
from nnode.diagnosis.statistics.bounds import parameters_at_bounds
from nnode.diagnosis.statistics.combination import least_confirmation
from nnode.diagnosis.statistics.paired import compare, heldout
from nnode.diagnosis.statistics.power import PowerSimulation
from nnode.diagnosis.statistics.random_effects import IndividualEstimate, estimate_individual
from nnode.diagnosis.statistics.simultaneous import Simultaneous, simultaneous
from nnode.diagnosis.verdict import (
    absences,
    agents_absent,
    named,
    named_agents,
    places,
    structure,
)
from nnode.errors import SimulationError
from nnode.model.effects import CATALOGUE, Effect, IndividualEffect
from nnode.model.system import System
from nnode.population.drivers import EXPLAINED, likeliest
from nnode.population.followers import drivers_differ, without_errors
from nnode.population.intervals import variations
from nnode.progress import Stages

#: Number of the strongest effects that the first screen lists.
SCREENED = 3
#: Why a model is not diagnosed whose simulations diverge.
BLOWS_UP = (
    "the model cannot be simulated on these data: it blows up from its own parameters and "
    "from those near the measured rates; start from others, or look at the data"
)


#: Stages of a diagnosis, with the seconds that they take on 40 platoons of six by ``idm`` with a
#: zone, beside other work.
STAGES = {
    "calibrating": 79.0,
    "locating": 12.0,
    "naming": 69.0,
    "confirming": 30.0,
}


@dataclass
class _Clock:
    """Seconds that each part of the diagnosis took."""

    last: float
    seconds: dict[str, float]

    def lap(self, name: str) -> None:
        now = time.monotonic()
        self.seconds[name] = round(now - self.last, 3)
        self.last = now


@dataclass
class _Exploration:
    """The results of the exploration sequences.

    Attributes:
        base: the calibrated model. base_curves: the curves in its residuals.
        located: these curves in words.
        selection: the effects that were added to it.
        simultaneity: whether simultaneous clusters are independent, in the residuals of the
            selected model.
    """

    division: Division
    engine: Engine
    base: Fit
    base_system: System
    variables: list[Variable]
    base_curves: list[Curves]
    located: list[Place]
    selection: Selection
    simultaneity: Simultaneous


def diagnose_law(
    system: System,
    sequences: list[Sequence],
    options: DiscoverOptions,
    *,
    stages: Stages | None = None,
    nearer: BetterLaw | None = None,
    hint: System | None = None,
) -> DiagnosisOutcome:
    """Diagnose which effects a model lacks on some sequences.

    Args:
        system: the model; it is not changed.
        sequences: without faults, at least three of them.
        options: see :class:`~nnode.diagnosis.options.DiscoverOptions`.
        stages: shows how far the work is.
        nearer: a law that fits these sequences better. An effect that this law does not need is
            reported as not confirmed.
        hint: the model, calibrated with effects that another law lacks.

    Raises:
        ConfigError: options that do not fit.
        DataError: too few sequences.
        SimulationError: the model cannot be simulated on these data at all.
    """
    names = check_options(options, system.domain, system.order)
    check_model(system)
    clock = _Clock(time.monotonic(), {})
    stages = stages or Stages("diagnosis", STAGES)
    differ = drivers_differ(system, sequences)
    skip_starts = differ and system.order == 1 and without_errors(sequences)
    notes = [SETTLED] if skip_starts else []
    offered, refused = _offered(system, names, differ or parameters_differ(system))
    effects = [effect for effect in offered if not issubclass(effect, IndividualEffect)]
    explore = partial(
        _explore, system, sequences, options, effects, differ, skip_starts, clock, stages, hint
    )
    exploration = explore()
    if exploration.simultaneity.together:
        exploration = replace(explore(together=True), simultaneity=exploration.simultaneity)
    division, engine = exploration.division, exploration.engine
    base_system = exploration.base_system
    notes += [division.note] if division.note else []
    unexplained, insufficient = _unexplained(exploration, exploration.selection)
    selection, imitations, law_at_bounds = _without_imitations(
        exploration, nearer, unexplained if insufficient else [], notes, options.seed
    )
    numbers = _clusters(exploration, options, len(effects))
    testable = numbers.exploration >= numbers.least_exploration
    stages.begin("confirming")
    confirmation = ConfirmationSet(
        engine,
        base_system,
        division.exploration.sequences,
        division.confirmation,
        numbers.confirmation,
        options.alpha,
        options.seed,
    )
    kinds = [effect for effect in offered if issubclass(effect, IndividualEffect)]
    individuals = [estimate_individual(engine, selection.fit, kind) for kind in kinds]
    selection, unconfirmed = confirmation.confirmed(engine, selection)
    law_at_bounds |= parameters_at_bounds(base_system, selection.fit, engine, options.seed)
    if selection is not exploration.selection:
        unexplained, insufficient = _unexplained(exploration, selection)
    assert selection.screen is not None
    power = PowerSimulation(
        selection.screen, options.alpha, numbers.confirmation if testable else 0
    )
    absent_effects = absences(selection, power)
    corrected = confirmation.corrected(engine, selection)
    if unconfirmed:
        refitted = [estimate_individual(engine, selection.fit, kind) for kind in kinds]
        individuals = _less_significant(individuals, refitted)
    estimates = _bonferroni([estimate for estimate in individuals if estimate is not None])
    agents = [
        confirmation.agents(estimate, corrected.system, bool(unexplained), testable)
        for estimate in estimates
    ]
    tested = list(zip(estimates, agents, strict=True))
    named_individuals = [estimate for estimate, agent in tested if agent.named]
    absent_effects += [
        agents_absent(estimate, options.alpha / len(estimates), testable)
        for estimate, agent in tested
        if not agent.found
    ]
    extended = base_system
    if selection.steps or named_individuals:
        extended = confirmation.with_agents(engine, corrected, named_individuals)
    gap, errors, simulations = confirmation.gap(extended, named_individuals)
    clock.lap("confirm")
    effects_named = [
        *(confirmation.named(engine, corrected, step) for step in selection.steps),
        *(
            named_agents(estimate, agent.confirmed, system.order)
            for estimate, agent in tested
            if agent.named
        ),
    ]
    hypotheses = [
        *unconfirmed,
        *imitations,
        *(
            named_agents(estimate, agent.confirmed, system.order)
            for estimate, agent in tested
            if agent.found and not agent.named
        ),
    ]
    diagnosis = Diagnosis(
        verdict=_verdict(
            selection,
            unexplained,
            insufficient,
            bool(named_individuals),
            testable,
            bool(imitations or law_at_bounds),
            absent_effects,
        ),
        domain=system.domain,
        model="",
        clusters=numbers,
        screen=_first_screen(selection, numbers),
        confirmation=confirmation.confirmation(agents),
        effects=effects_named,
        hypotheses=hypotheses,
        agents=agents,
        drivers=_drivers(engine, selection.fit, options.seed, notes),
        data_faults=[],
        not_testable=[absence.name for absence in absent_effects if not absence.testable],
        absences=absent_effects,
        places=exploration.located,
        unknown=structure(unexplained) if unexplained else None,
        gap=gap,
        base=_shift(base_system, extended),
        split={
            "exploration": [s.name for s in division.exploration.sequences],
            "confirmation": [s.name for s in division.confirmation.sequences],
        },
        notes=notes,
        law_at_bounds=sorted(law_at_bounds),
        not_offered=refused,
        seconds=clock.seconds,
        confirmation_errors=errors,
    )
    return DiagnosisOutcome(
        diagnosis=diagnosis,
        base=base_system,
        extended=extended,
        searched=exploration.selection.fit.system,
        exploration=division.exploration.places,
        confirmation=division.confirmation.places,
        simulated=simulations,
    )


def _unexplained(exploration: _Exploration, selection: Selection) -> tuple[list[Curves], bool]:
    """The curves that remain significant in the residuals of a selected model, and whether the
    selected effects do not suffice beside them."""
    engine, remaining = exploration.engine, exploration.base_curves
    if selection.fit is not exploration.base:
        remaining = curves(engine, selection.fit, exploration.variables)
        remaining = significant_curves(engine, selection.fit, remaining, thresholds.STRICT)
    unexplained = [c for c in remaining if c.relevant]
    return unexplained, _insufficient(exploration, selection, unexplained)


def _insufficient(
    exploration: _Exploration, selection: Selection, unexplained: list[Curves]
) -> bool:
    """Whether remaining structure would lower held-out costs by more than
    :data:`~nnode.diagnosis.thresholds.UNEXPLAINED` of what the selected effects do."""
    if not (selection.steps and unexplained):
        return False
    engine = exploration.engine
    alone = refine(engine, copy.deepcopy(exploration.base_system))
    costs = [heldout(fit, engine.cluster) for fit in (alone, selection.fit)]
    lowered = compare(*costs).gain
    largest = max(curve.gain.gain for curve in unexplained)
    return largest * (1 - lowered) > thresholds.UNEXPLAINED * lowered


def _offered(
    system: System, names: list[str], differ: bool
) -> tuple[list[type[Effect]], dict[str, str]]:
    """The effects that are tested, and by name why others are not.

    Args:
        names: of all candidates.
        differ: whether agents differ in the law's parameters.
    """
    catalogue = CATALOGUE.of(system.domain, system.order)
    candidates = [effect for effect in catalogue if effect.name in names]
    refused = {e.name: reason for e in candidates if (reason := not_offered(e, system, differ))}
    return [effect for effect in candidates if effect.name not in refused], refused


def _less_significant(
    before: list[IndividualEstimate | None], after: list[IndividualEstimate | None]
) -> list[IndividualEstimate | None]:
    """The less significant estimates of two models, if both exist. An unconfirmed effect that was
    removed could otherwise show as a difference between agents."""
    pairs = [(a, b) for a, b in zip(before, after, strict=True) if a and b]
    return [max(pair, key=lambda estimate: estimate.p_value) for pair in pairs]


def _bonferroni(estimates: list[IndividualEstimate]) -> list[IndividualEstimate]:
    """The estimates with p-values that are corrected for their number."""
    number = len(estimates)
    return [
        replace(estimate, p_value=min(1.0, estimate.p_value * number)) for estimate in estimates
    ]


def _drivers(engine: Engine, fit: Fit, seed: int, notes: list[str]) -> list[Variation]:
    """The variances between drivers and over time, under the model with all selected effects.

    Args:
        seed: of the simulations that correct their bias.
        notes: notes are added to them if the estimation does not converge, and if pushes explain a
            large part of the rates.
    """
    if not isinstance(engine, AgentsEngine):
        return []
    engine.fit_whitening(fit.system, torch.from_numpy(fit.row))
    if isinstance(engine, FollowersEngine):
        population = engine.drivers(seed)
        rows = variations(population)
        if not population.estimate.converged:
            notes.append(
                "The estimation of the differences between drivers did not converge. They are not "
                "corrected for their bias."
            )
    else:
        assert isinstance(engine, CrowdEngine)
        rows = engine.variations()
        assert engine.population is not None
        if not engine.population.predicts:
            notes.append(
                "The law does not help to predict these people: their paths are as likely if they "
                "walk straight on for the length of a window and are pushed at random."
            )
    drivers = [Variation(name, **row) for name, row in rows.items()]
    assert engine.population is not None
    push = next(row for row in drivers if row.name == "push")
    if push.at_bound == "high" or not engine.population.explains_rates:
        rate = "accelerations" if fit.system.order > 1 else "speeds"
        hint = ""
        smoothed = isinstance(engine, FollowersEngine) and not engine.apart
        if smoothed and without_errors(engine.sequences):
            hint = " If positions were smoothed before, set discover.smoothed=true."
        notes.append(
            f"The law explains little of how {rate} vary: pushes have a standard deviation of "
            f"{push.estimate:.3g} {push.unit}, more than {EXPLAINED:.0%} of that of the {rate}. "
            f"Effects may be hidden behind them. Compare other laws.{hint}"
        )
    return drivers


def _without_imitations(
    exploration: _Exploration,
    nearer: BetterLaw | None,
    unexplained: list[Curves],
    notes: list[str],
    seed: int,
) -> tuple[Selection, list[NamedEffect], set[str]]:
    """Remove effects that may imitate something else; they become hypotheses. They are those that a
    better-fitting law does not need, and all if parameters of the diagnosed law end at bounds or if
    much structure remains: then no set of effects suffices.

    Args:
        unexplained: the curves beside which the selected effects do not suffice.
        notes: the reason is added to them.
        seed: of the simulations that estimate the bias of scores.

    Returns:
        The selection, the hypotheses, and the parameters at bounds.
    """
    engine, selection, division = exploration.engine, exploration.selection, exploration.division
    law_at_bounds = parameters_at_bounds(exploration.base_system, selection.fit, engine, seed)
    steps = selection.steps if law_at_bounds or unexplained else []
    if unexplained:
        names = ", ".join(step.chosen.name for step in steps)
        variables = ", ".join(curve.variable.name for curve in unexplained)
        notes.append(
            f"{names}: deviations by {variables} remain in the model with these effects. They may "
            "imitate something that the catalogue lacks, and are hypotheses."
        )
    if nearer is not None and selection.steps and not steps:
        label = division.exploration.label
        steps, p_value = explained_by_law(engine, selection, label, nearer)
        if steps:
            names = ", ".join(step.chosen.name for step in steps)
            notes.append(
                f"{names}: {nearer.name} does without and predicts left-out clusters better than "
                f"the model with it (one-sided p = {p_value:.2g}); it is a hypothesis."
            )
    imitations = [named(engine, selection.fit, step) for step in steps]
    remaining = without_steps(engine, selection, steps, exploration.base_system)
    return remaining, imitations, law_at_bounds


def _explore(
    system: System,
    sequences: list[Sequence],
    options: DiscoverOptions,
    effects: list[type[Effect]],
    differ: bool,
    skip_starts: bool,
    clock: _Clock,
    stages: Stages,
    hint: System | None,
    together: bool = False,
) -> _Exploration:
    """Calibrate, locate deviations, and select effects on the exploration sequences.

    Args:
        differ: whether drivers differ.
        skip_starts: leave out the time in which a simulation adapts to its start.
        together: simultaneous sequences form one cluster.
    """
    stages.begin("calibrating")
    division = divide(sequences, options, together=together, skip_starts=skip_starts)
    part, apart = division.exploration, spacing(sequences, options)
    engine = engine_of(system, part.sequences, part.label, differ=differ, apart=apart)
    testable = int(engine.cluster.max()) + 1 >= _least_clusters(options, len(effects))
    initial = _initial(engine, system)
    hints = [] if hint is None else [hint]
    if isinstance(engine, AgentsEngine):
        try:
            populations = [engine.population_of(initial)]
        except SimulationError as error:
            raise SimulationError(BLOWS_UP) from error
        if testable and not populations[0].plausible:
            # a strong missing effect is attributed to pushes
            start = populations[0].system
            usual = engine.with_usual_variances(start)
            extensions = likely_extensions(usual, refine(usual, copy.deepcopy(start)), effects)
            hints += extensions
            for extension in extensions:
                with suppress(SimulationError):
                    populations.append(engine.population_of(extension))
                if populations[-1].plausible:
                    break
        engine.set_population(likeliest(populations))
        base = refine(engine, copy.deepcopy(populations[0].system))
    else:
        base = converged_fit(engine, initial)
    base_system = copy.deepcopy(base.system)
    clock.lap("calibrate")
    stages.begin("locating")
    variables = engine.variables() if options.structure else []
    base_curves = significant_curves(
        engine, base, curves(engine, base, variables), thresholds.STRICT
    )
    located = places(base_curves, _excess(engine, base))
    clock.lap("locate")
    stages.begin("naming")
    selection = search(
        engine,
        base,
        effects,
        max_effects=options.max_effects if testable else 0,
        seed=options.seed,
        variables=variables,
        levels=_levels(engine, effects),
        within=stages.within,
        hints=hints,
    )
    if selection.steps:
        names = [step.chosen.name for step in selection.steps]
        alone = calibrated_without(engine, base, selection.fit, *names)
        if alone.system is not base.system:
            base_system = alone.system
    # a missing effect correlates the residuals of all clusters, so they are tested after selection
    simultaneity = simultaneous(engine, selection.fit, options.seed)
    clock.lap("name")
    return _Exploration(
        division=division,
        engine=engine,
        base=base,
        base_system=base_system,
        variables=variables,
        base_curves=base_curves,
        located=located,
        selection=selection,
        simultaneity=simultaneity,
    )


def _initial(engine: Engine, system: System) -> System:
    """Where the calibration of a model starts.

    Raises:
        SimulationError: the model cannot be simulated on these data.
    """
    own = copy.deepcopy(system).double()
    if isinstance(engine, CrowdEngine):  # estimates people from several starts
        return own
    fit = initial_fit(engine, own)
    if fit is None:
        raise SimulationError(BLOWS_UP)
    return fit.system


def _least_clusters(options: DiscoverOptions, effects: int) -> int:
    """The number of exploration clusters that are needed to name any effect."""
    return least_number(options.alpha, hypotheses=max(effects, 1))


def _clusters(exploration: _Exploration, options: DiscoverOptions, effects: int) -> Clusters:
    """The numbers of clusters, and the numbers that are needed."""
    division, least_exploration = exploration.division, _least_clusters(options, effects)
    sufficient = next(
        number
        for number in count(2)
        if least_confirmation()
        <= round(options.confirmation * number)
        <= number - least_exploration
    )
    return Clusters(
        exploration=int(exploration.engine.cluster.max()) + 1,
        confirmation=0 if division.note else division.confirmation.clusters,
        least_exploration=least_exploration,
        least_confirmation=least_confirmation(),
        enough=sufficient,
        why=division.why,
        simultaneous=exploration.simultaneity.plain(),
        note=division.note,
    )


def _levels(engine: Engine, effects: list[type[Effect]]) -> dict[str, np.ndarray]:
    """Recordings ``(n,)`` of the residuals, for effects of a covariate that is constant within
    recordings."""
    positions = np.arange(len(engine.sequences))
    levels = {}
    for effect in effects:
        label = level(engine.sequences, positions, effect.covariate)
        if label is not positions:
            levels[effect.name] = of_residuals(label, engine.sequence)
    return levels


def _first_screen(selection: Selection, numbers: Clusters) -> FirstScreen:
    """The scores of all effects against the calibrated model."""
    best = min(selection.first, key=lambda score: score.p_value, default=None)
    strongest = [
        {"name": s.effect.name, "share": s.gain, "p_value": s.p_value, **s.amount}
        for s in selection.first[:SCREENED]
    ]
    floor = 2.0 ** (1 - numbers.exploration)
    if best is None:
        return FirstScreen(None, "", numbers.exploration, floor)
    return FirstScreen(best.p_value, best.effect.name, numbers.exploration, floor, strongest)


def _excess(engine: Engine, fit: Fit) -> float:
    """Share of the squared errors of positions that is not measurement noise."""
    floor = engine.noise_floor()
    return 1.0 if np.isnan(floor) else max(1 - floor / square_of(engine, fit.system), 1e-3)


def _verdict(
    selection: Selection,
    unexplained: list[Curves],
    insufficient: bool,
    individuals_named: bool,
    testable: bool,
    law_is_wrong: bool,
    absences: list[Absence],
) -> Verdict:
    """The verdict.

    Args:
        insufficient: whether the selected effects do not suffice.
        individuals_named: whether agent-specific parameters were confirmed.
        law_is_wrong: whether effects were selected that may imitate something else, or the law's
            own parameters are at bounds.
        absences: the effects that were not found.
    """
    if not testable:
        return "not_testable"
    if insufficient:
        return "unknown"
    if selection.steps:
        return "indistinguishable" if any(step.rivals for step in selection.steps) else "named"
    if individuals_named:
        return "named"
    if unexplained or law_is_wrong:
        return "unknown"
    if absences and not any(absence.testable for absence in absences):
        return "not_testable"
    return "none"


def _shift(before: System, after: System) -> dict[str, dict[str, Any]]:
    """The base model's parameters before and after effects were added."""
    extended = after.physical()
    return {
        name: {"before": float(value), "after": float(extended[name][0]), "unit": unit}
        for name, (value, unit) in before.physical().items()
        if name in extended
    }
