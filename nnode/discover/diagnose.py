"""The whole diagnosis: calibrate, locate, name, add, judge; then look at what was sealed."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from nnode.data.options import SplitOptions
from nnode.data.quality import Fault
from nnode.data.sequence import Domain, Sequence
from nnode.data.split import split
from nnode.discover.crowd import CrowdEngine
from nnode.discover.engine import Engine, row_of, square_of
from nnode.discover.fit import Fit, evaluated
from nnode.discover.found import Found
from nnode.discover.individual import individuals, sharpened
from nnode.discover.judge import absences, named, places, structure
from nnode.discover.options import DiscoverOptions, check_options
from nnode.discover.result import Diagnosis, Gap, Verdict
from nnode.discover.search import Search, search, settled
from nnode.discover.traffic import TrafficEngine
from nnode.discover.unbiased import unbiased
from nnode.discover.variables import Curves, curves, weighed
from nnode.errors import DataError
from nnode.models.effects import CATALOGUE, IndividualEffect
from nnode.models.extend import effects_of
from nnode.models.system import System
from nnode.progress import Stages

#: Structure that is left counts from this share of the squared errors of positions on, at this
#: error probability over all variables.
LEFT, SURE = 0.02, 0.01
#: Named effects do not explain the data where what is left is this share of what they removed.
TOO_MUCH = 0.5


#: Stages of a diagnosis, with the seconds that they take on the motorway recordings.
STAGES = {
    "calibrating": 2.0,
    "locating": 1.5,
    "naming": 11.5,
    "comparing on sealed sequences": 1.0,
    "drawing": 5.0,
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


def engine_of(domain: str, sequences: list[Sequence], whole: bool = False) -> Engine:
    """The engine of a domain; ``whole`` compares whole sequences where that makes sense."""
    if domain == "crowd":
        return CrowdEngine(sequences)
    return TrafficEngine(sequences, np.inf) if whole else TrafficEngine(sequences)


def diagnose(
    system: System,
    sequences: list[Sequence],
    options: DiscoverOptions,
    *,
    faults: dict[str, list[Fault]] | None = None,
    stages: Stages | None = None,
) -> Found:
    """Find out what a model lacks on some sequences.

    Args:
        system: the model; it is not changed.
        sequences: without faults, at least three of them.
        options: see :class:`~nnode.discover.options.DiscoverOptions`.
        faults: that were found in other sequences, by name.
        stages: shows how far the work is.

    Raises:
        ConfigError: options that do not fit.
        DataError: too few sequences.
        SimulationError: the model cannot be simulated on these data at all.
    """
    domain = cast(Domain, system.domain)
    names = check_options(options, domain)
    clock = _Clock(time.monotonic(), {})
    stages = stages or Stages("diagnosis", STAGES)
    stages.begin("calibrating")
    opened, sealed = divide(sequences, options)
    engine = engine_of(domain, [sequences[i] for i in opened])
    start = copy.deepcopy(system).double()
    base = settled(engine, engine.near(start) if isinstance(engine, TrafficEngine) else start)
    base_system = copy.deepcopy(base.system)
    clock.lap("calibrate")
    stages.begin("locating")
    variables = engine.variables()
    first = weighed(engine, base, curves(engine, base, variables), SURE)
    located = places(first, _excess(engine, base))
    clock.lap("locate")
    stages.begin("naming")
    effects = [effect for effect in CATALOGUE.of(domain) if effect.name in names]
    found = search(
        engine, base, effects, alpha=options.alpha, most=options.max_effects, seed=options.seed,
        variables=variables, within=stages.within,
    )  # fmt: skip
    last = first
    if found.fit is not base:
        last = weighed(engine, found.fit, curves(engine, found.fit, variables), SURE)
    left = [one for one in last if one.removed > LEFT]
    clock.lap("name")
    stages.begin("comparing on sealed sequences")
    removed = 1 - square_of(engine, found.fit.system) / square_of(engine, base_system)
    verdict = _verdict(found, left, removed, bool(faults))
    if found.steps and domain == "crowd":
        found.fit = unbiased(found.fit, [sequences[i] for i in opened], options.seed)
    gap, each = _gap(domain, base_system, found, [sequences[i] for i in sealed])
    clock.lap("sealed")
    absent = absences(found)
    diagnosis = Diagnosis(
        verdict=verdict,
        domain=domain,
        model="",
        effects=[named(engine, found, step) for step in found.steps],
        data_faults=[],
        not_testable=[one.name for one in absent if not one.testable],
        absences=absent,
        places=located,
        unknown=structure(left) if left else None,
        gap=gap,
        base=_shift(base_system, found.fit.system),
        split={
            "open": [sequences[i].name for i in opened],
            "sealed": [sequences[i].name for i in sealed],
        },
        notes=_notes(found, gap),
        seconds=clock.seconds,
        sealed=each,
    )
    return Found(
        diagnosis=diagnosis,
        base=base_system,
        extended=found.fit.system,
        open=opened,
        sealed=sealed,
    )


def _excess(engine: Engine, fit: Fit) -> float:
    """Share of the squared errors of positions that is not noise of the measurement."""
    floor = engine.noise_floor()
    return 1.0 if np.isnan(floor) else max(1 - floor / square_of(engine, fit.system), 1e-3)


def divide(sequences: list[Sequence], options: DiscoverOptions) -> tuple[list[int], list[int]]:
    """Positions of the open and of the sealed sequences; no agent is on both sides.

    The open ones are not divided further: every judgement on them is made on sequences that a
    calibration has left out in turn.

    Raises:
        DataError: fewer than three sequences, or none that could be sealed.
    """
    if len(sequences) < 3:
        raise DataError(
            f"a diagnosis needs at least 3 sequences without a fault, there are {len(sequences)}; "
            "take more data, or cut them into shorter sequences"
        )
    index: list[dict[str, Any]] = [
        {
            "name": s.name,
            "recording": s.recording,
            "start": float(s.time[0]),
            "end": float(s.time[-1]),
            "agents": list(s.agents),
        }
        for s in sequences
    ]
    parts = split(index, SplitOptions(heldout=options.sealed, seed=options.seed))
    return parts.train, parts.heldout


def _verdict(found: Search, left: list[Curves], removed: float, faulty: bool) -> Verdict:
    """Args: ``removed``: share of the squared errors that the named effects removed."""
    if found.steps:
        if left and left[0].removed * (1 - removed) > TOO_MUCH * removed:
            return "unknown"
        rivals = any(step.rivals for step in found.steps)
        return "indistinguishable" if rivals else "named"
    if left:
        return "unknown"
    return "data_fault" if faulty else "none"


def _notes(found: Search, gap: Gap) -> list[str]:
    """What a reader must know to take the verdict for no more than it is."""
    if found.steps and not gap.after < gap.before:
        return [
            "The errors of positions on the sealed sequences did not become smaller: the effects "
            "stand out in the open ones, but do not predict the sealed ones better. Take them as "
            "a lead to follow, not as a finding."
        ]
    return []


def _gap(
    domain: str, base: System, found: Search, sequences: list[Sequence]
) -> tuple[Gap, list[dict[str, Any]]]:
    """The costs of the sealed sequences, and of each of them."""
    engine = engine_of(domain, sequences, whole=True)
    engine.settle(base, row_of(base))
    before = _costs(engine, base)
    after = before
    if found.steps:
        after = _costs(engine, found.fit.system)
        own = [
            type(effect) for effect in effects_of(found.fit.system)
            if isinstance(effect, IndividualEffect)
        ]  # fmt: skip
        if own:
            after = _crossed_costs(domain, engine, found.fit.system, sequences)
    floor = engine.noise_floor()
    first, last = float(before.mean()), float(after.mean())
    closable = first - floor
    closed = (first - last) / closable if closable > 0 else float("nan")
    each = [
        {"name": s.name, "before": float(a), "after": float(b)}
        for s, a, b in zip(sequences, before, after, strict=True)
    ]
    return Gap(first, last, floor, closed), each


def _costs(engine: Engine, system: System) -> np.ndarray:
    """``(S,)`` mean square error of each sequence, m²."""
    return engine.squares(system, row_of(system)).means()


def _crossed_costs(
    domain: str, whole: Engine, system: System, sequences: list[Sequence]
) -> np.ndarray:
    """Costs where each agent's number comes from the other half of his time."""
    engine = engine_of(domain, sequences)
    plain = copy.deepcopy(system)
    for effect in effects_of(plain):
        if isinstance(effect, IndividualEffect):
            effect.people = {}
    engine.settle(plain, row_of(plain))
    numbers = {}
    for effect in effects_of(plain):
        if isinstance(effect, IndividualEffect):
            kind = type(effect)
            fit: Fit = evaluated(engine, plain)
            # an agent's number means something at this setting only
            own = {name: float(getattr(effect, name).detach()) for name in effect.settings}
            one = individuals(engine, fit, kind, own)
            if one is not None:
                numbers[effect.name] = sharpened(engine, plain, one).halves
    parts = []
    for half in (0, 1):
        for effect in effects_of(plain):
            if isinstance(effect, IndividualEffect) and effect.name in numbers:
                effect.people = numbers[effect.name][1 - half]
        parts.append(whole.squares(plain, row_of(plain)))
    value = np.where(parts[0].half == 0, parts[0].value, parts[1].value)
    return replace(parts[0], value=value).means()


def _shift(before: System, after: System) -> dict[str, dict[str, Any]]:
    """The base model's parameters before and after effects were added."""
    later = after.physical()
    return {
        name: {"before": float(value), "after": float(later[name][0]), "unit": unit}
        for name, (value, unit) in before.physical().items()
        if name in later
    }
