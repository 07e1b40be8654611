"""The whole diagnosis: calibrate, locate, name, add, judge; then look at what was sealed."""

from __future__ import annotations

import copy
import math
import time
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, cast

import numpy as np
import torch

from nnode.data.clusters import least_number, level
from nnode.data.sequence import Domain, Sequence
from nnode.discover.able import check_model, not_offered
from nnode.discover.compare.laws import Nearer, imitated
from nnode.discover.division import Division, divide
from nnode.discover.found import Found
from nnode.discover.judge.confirm import engine_of
from nnode.discover.judge.sealed import Sealed
from nnode.discover.judge.verdict import (
    absences,
    agents_absent,
    named,
    named_agents,
    places,
    structure,
)
from nnode.discover.lanes.followers import FollowersEngine
from nnode.discover.locate.curves import curves, weighed
from nnode.discover.name.search import Search, begun, search, settled, wider, without_steps
from nnode.discover.options import DiscoverOptions, check_options
from nnode.discover.residuals.engine import Engine, of_residuals, square_of
from nnode.discover.residuals.fit import Fit, refine
from nnode.discover.residuals.variables import Curves, Variable
from nnode.discover.result import (
    Clusters,
    Diagnosis,
    FirstScreen,
    NamedEffect,
    Place,
    Variation,
    Verdict,
)
from nnode.discover.rules import applied, rules
from nnode.discover.statistics.power import Way
from nnode.discover.statistics.random_effects import individuals
from nnode.discover.statistics.simultaneous import Simultaneous, simultaneous
from nnode.errors import SimulationError
from nnode.model.effects import CATALOGUE, Effect, IndividualEffect
from nnode.model.system import System
from nnode.population.followers import drivers_differ
from nnode.population.intervals import variations
from nnode.progress import Stages

#: Effects that are described where nothing can be tested.
LEADS = 3


#: Stages of a diagnosis, with the seconds that they take on 120 pairs of NGSIM I-80.
STAGES = {
    "calibrating": 6.0,
    "locating": 22.0,
    "naming": 62.0,
    "comparing on sealed sequences": 55.0,
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
class _Look:
    """What was found in the open sequences.

    Attributes:
        tested: whether what is simultaneous is independent, in what the search leaves.
        first: curves in the residuals of ``base``, the calibrated model; ``located``: in words.
    """

    division: Division
    engine: Engine
    base: Fit
    base_system: System
    variables: list[Variable]
    first: list[Curves]
    located: list[Place]
    found: Search
    tested: Simultaneous


def diagnose(
    system: System,
    sequences: list[Sequence],
    options: DiscoverOptions,
    *,
    stages: Stages | None = None,
    nearer: Nearer | None = None,
    hint: System | None = None,
) -> Found:
    """Find out what a model lacks on some sequences.

    Args:
        system: the model; it is not changed.
        sequences: without faults, at least three of them.
        options: see :class:`~nnode.discover.options.DiscoverOptions`.
        stages: shows how far the work is.
        nearer: a law that comes nearer to these sequences; what the model lacks only because it is
            another law is a lead, and no finding.
        hint: the model, calibrated with effects that another law lacks.

    Raises:
        ConfigError: options that do not fit.
        DataError: too few sequences.
        SimulationError: the model cannot be simulated on these data at all.
    """
    with applied(options.rules):
        return _diagnosed(system, sequences, options, stages, nearer, hint)


def _diagnosed(
    system: System,
    sequences: list[Sequence],
    options: DiscoverOptions,
    stages: Stages | None,
    nearer: Nearer | None,
    hint: System | None,
) -> Found:
    domain = cast(Domain, system.domain)
    names = check_options(options, domain, system.order)
    check_model(system)
    clock = _Clock(time.monotonic(), {})
    stages = stages or Stages("diagnosis", STAGES)
    known = [e for e in CATALOGUE.of(domain, system.order) if e.name in names]
    differ = drivers_differ(system, sequences)
    refused = {e.name: reason for e in known if (reason := not_offered(e, system, differ))}
    wanted = [effect for effect in known if effect.name not in refused]
    effects = [effect for effect in wanted if not issubclass(effect, IndividualEffect)]
    look = _looked_for(system, sequences, options, effects, clock, stages, hint)
    if look.tested.together:
        again = _looked_for(system, sequences, options, effects, clock, stages, hint, True)
        look = replace(again, tested=look.tested)
    division, engine, base, found = look.division, look.engine, look.base, look.found
    base_system, searched = look.base_system, look.found.fit.system
    notes: list[str] = [division.note] if division.note else []
    imitations: list[NamedEffect] = []
    if nearer is not None and found.steps:
        found, imitations = _without_imitations(look, nearer, notes)
    numbers = _clusters(look, options, len(effects))
    enough = numbers.open >= numbers.least
    stages.begin("comparing on sealed sequences")
    sealed = Sealed(
        engine,
        base_system,
        [sequences[i] for i in division.open],
        [sequences[i] for i in division.sealed],
        division.label[division.sealed],
        numbers.sealed,
        options.seed,
    )
    kinds = [effect for effect in wanted if issubclass(effect, IndividualEffect)]
    beside = [individuals(engine, found.fit, kind) for kind in kinds]
    found, leads = sealed.confirmed(engine, found)
    last = (
        look.first
        if found.fit is base
        else weighed(engine, found.fit, curves(engine, found.fit, look.variables), rules().sure)
    )
    left = [one for one in last if one.removed > rules().least]
    assert found.screen is not None
    absent = absences(found, Way(found.screen, options.alpha, numbers.sealed))
    final = sealed.corrected(found)
    if leads:  # what stands out without a lead alone may be the lead
        without = [individuals(engine, found.fit, kind) for kind in kinds]
        pairs = [(a, b) for a, b in zip(beside, without, strict=True) if a and b]
        beside = [max(pair, key=lambda one: one.p_value) for pair in pairs]
    seen = [one for one in beside if one is not None]
    seen = [replace(one, p_value=min(1.0, one.p_value * len(seen))) for one in seen]
    agents = [sealed.agents(one, final.system, options.alpha, bool(left), enough) for one in seen]
    both = list(zip(seen, agents, strict=True))
    own = [one for one, agent in both if agent.named]
    absent += [
        agents_absent(one, options.alpha / len(seen), enough)
        for one, agent in both
        if not agent.found
    ]
    extended = sealed.with_numbers(engine, final, own) if found.steps or own else base_system
    gap, each, simulated = sealed.gap(extended, own)
    clock.lap("sealed")
    removed = 1 - square_of(engine, found.fit.system) / square_of(engine, base_system)
    effects_found = [
        *(named(engine, final, s, sealed.tried[s.chosen.name].p_value) for s in found.steps),
        *(named_agents(one, a.confirmed, system.order) for one, a in both if a.named),
    ]
    others = [pair for pair in both if pair[1].found and not pair[1].named]
    leads_found = [
        *leads,
        *imitations,
        *(named_agents(one, agent.confirmed, system.order) for one, agent in others),
    ]
    diagnosis = Diagnosis(
        verdict=_verdict(
            found, left, removed, bool(own), bool(leads_found), enough, bool(imitations)
        ),
        domain=domain,
        model="",
        clusters=numbers,
        screen=_first(found, numbers),
        confirmation=sealed.confirmation(agents),
        effects=effects_found,
        leads=leads_found,
        agents=agents,
        drivers=_drivers(engine, found.fit, notes),
        data_faults=[],
        not_testable=[one.name for one in absent if not one.testable],
        absences=absent,
        places=look.located,
        unknown=structure(left) if left else None,
        gap=gap,
        base=_shift(base_system, extended),
        split={
            "open": [sequences[i].name for i in division.open],
            "sealed": [sequences[i].name for i in division.sealed],
        },
        notes=notes,
        not_offered=refused,
        seconds=clock.seconds,
        sealed=each,
    )
    return Found(
        diagnosis=diagnosis,
        base=base_system,
        extended=extended,
        searched=searched,
        open=division.open,
        sealed=division.sealed,
        simulated=simulated,
    )


def _drivers(engine: Engine, fit: Fit, notes: list[str]) -> list[Variation]:
    """What differs between drivers and over time, under the model with all that was found.

    Args:
        notes: where pushes are as strong as they may be, this is added to them.
    """
    if not isinstance(engine, FollowersEngine):
        return []
    engine.settle(fit.system, torch.from_numpy(fit.row))
    assert engine.population is not None
    found = [Variation(name, **row) for name, row in variations(engine.population).items()]
    push = next(one for one in found if one.name == "push")
    if push.at_bound == "high":
        notes.append(
            f"Pushes of {push.estimate:.3g} {push.unit} are the strongest that are allowed: the "
            "law explains little of how speeds change, and effects may be hidden behind them. "
            "Compare other laws, or look at how the positions were measured."
        )
    return found


def _without_imitations(
    look: _Look, nearer: Nearer, notes: list[str]
) -> tuple[Search, list[NamedEffect]]:
    """Take out effects that a law which fits better does not need; they become leads.

    Args:
        notes: the reason is added to them.
    """
    engine, found, division = look.engine, look.found, look.division
    steps, p_value = imitated(engine, found, division.label[division.open], nearer)
    imitations = [named(engine, found.fit, step, math.nan) for step in steps]
    if steps:
        names = ", ".join(step.chosen.name for step in steps)
        notes.append(
            f"{names}: {nearer.name} does without and predicts left-out clusters better than "
            f"the model with it (one-sided p = {p_value:.2g}); a lead, no finding."
        )
    return without_steps(engine, found, steps, look.base_system), imitations


def _looked_for(
    system: System,
    sequences: list[Sequence],
    options: DiscoverOptions,
    effects: list[type[Effect]],
    clock: _Clock,
    stages: Stages,
    hint: System | None,
    together: bool = False,
) -> _Look:
    """Calibrate, locate, and search for the population's effects.

    Args:
        together: what is simultaneous is one cluster.
    """
    stages.begin("calibrating")
    division = divide(sequences, options, together=together)
    chosen = [sequences[i] for i in division.open]
    engine = engine_of(system, chosen, division.label[division.open])
    start = begun(engine, copy.deepcopy(system).double())
    if start is None:
        raise SimulationError(
            "the model cannot be simulated on these data: it blows up from its own parameters and "
            "from those near the measured rates; start from others, or look at the data"
        )
    hints = [] if hint is None else [hint]
    if isinstance(engine, FollowersEngine):
        likely = wider(engine, start, effects)
        engine.settle_among([*likely, start.system])
        hints += likely
        base = refine(engine, start.system)
    else:
        base = settled(engine, start.system)
    base_system = copy.deepcopy(base.system)
    clock.lap("calibrate")
    stages.begin("locating")
    variables = engine.variables() if options.structure else []
    first = weighed(engine, base, curves(engine, base, variables), rules().sure)
    located = places(first, _excess(engine, base))
    clock.lap("locate")
    stages.begin("naming")
    enough = int(engine.cluster.max()) + 1 >= _least(options, len(effects))
    found = search(
        engine,
        base,
        effects,
        alpha=options.alpha,
        most=options.max_effects if enough else 0,
        seed=options.seed,
        variables=variables,
        levels=_levels(engine, effects),
        within=stages.within,
        hints=hints,
    )
    # what a missing effect leaves is common to all clusters: only what the search leaves tells
    tested = simultaneous(engine, found.fit, options.seed)
    clock.lap("name")
    return _Look(division, engine, base, base_system, variables, first, located, found, tested)


def _least(options: DiscoverOptions, effects: int) -> int:
    """Open clusters that it takes to name any effect."""
    return least_number(options.alpha, hypotheses=max(effects, 1))


def _clusters(look: _Look, options: DiscoverOptions, effects: int) -> Clusters:
    """How many there are, and how many it takes."""
    division, least = look.division, _least(options, effects)
    least_sealed = least_number(rules().level, sided=1)
    enough = next(
        number
        for number in count(2)
        if least_sealed <= round(options.sealed * number) <= number - least
    )
    return Clusters(
        open=int(look.engine.cluster.max()) + 1,
        sealed=0 if division.note else division.number(division.sealed),
        least=least,
        least_sealed=least_sealed,
        enough=enough,
        why=division.why,
        simultaneous=look.tested.plain(),
        note=division.note,
    )


def _levels(engine: Engine, effects: list[type[Effect]]) -> dict[str, np.ndarray]:
    """Of effects that act by something fixed within recordings: the recordings ``(n,)``."""
    every = np.arange(len(engine.sequences))
    found = {}
    for effect in effects:
        label = level(engine.sequences, every, effect.covariate)
        if label is not every:
            found[effect.name] = of_residuals(label, engine.sequence)
    return found


def _first(found: Search, numbers: Clusters) -> FirstScreen:
    """What the first look said."""
    best = min(found.first, key=lambda score: score.p_value, default=None)
    leads = [
        {"name": one.effect.name, "share": one.gain, "p_value": one.p_value, **one.amount}
        for one in found.first[:LEADS]
    ]
    floor = 2.0 ** (1 - numbers.open)
    if best is None:
        return FirstScreen(None, "", numbers.open, floor)
    return FirstScreen(best.p_value, best.effect.name, numbers.open, floor, leads)


def _excess(engine: Engine, fit: Fit) -> float:
    """Share of the squared errors of positions that is not noise of the measurement."""
    floor = engine.noise_floor()
    return 1.0 if np.isnan(floor) else max(1 - floor / square_of(engine, fit.system), 1e-3)


def _verdict(
    found: Search,
    left: list[Curves],
    removed: float,
    own: bool,
    leads: bool,
    enough: bool,
    imitated: bool,
) -> Verdict:
    """Args: ``removed``: share of the squared errors that the named effects removed; ``own``:
    whether agents' own numbers were confirmed; ``leads``: whether something was not; ``imitated``:
    whether something was found that a nearer law does without."""
    if not enough:
        return "not_testable"
    if found.steps:
        if left and left[0].removed * (1 - removed) > rules().too_much * removed:
            return "unknown"
        return "indistinguishable" if any(step.rivals for step in found.steps) else "named"
    if own:
        return "named"
    if left or imitated:
        return "unknown"
    return "unconfirmed" if leads else "none"


def _shift(before: System, after: System) -> dict[str, dict[str, Any]]:
    """The base model's parameters before and after effects were added."""
    later = after.physical()
    return {
        name: {"before": float(value), "after": float(later[name][0]), "unit": unit}
        for name, (value, unit) in before.physical().items()
        if name in later
    }
