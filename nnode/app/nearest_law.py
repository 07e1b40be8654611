"""Which law comes nearest, and what it lacks: laws are compared, the nearest one is diagnosed and
the one that was asked for, and laws are compared again with what they lack."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

from nnode.app.python.inputs import MODELS, model_options
from nnode.app.training import set_threads
from nnode.discover.compare.laws import BetterLaw, compare_laws, with_effects
from nnode.discover.diagnose import STAGES, diagnose
from nnode.discover.inputs import Inputs
from nnode.discover.options import DiscoverOptions
from nnode.discover.outcome import DiagnosisOutcome
from nnode.discover.result import Laws
from nnode.errors import ConfigError
from nnode.model import System, build_model
from nnode.model.effects import CATALOGUE, Effect
from nnode.model.extend import effects_of
from nnode.model.system import Traffic
from nnode.progress import Stages

#: Laws that are compared where none are named; networks contain effects, and newell remembers step
#: by step.
LAWS = {
    "traffic": ("lin", "log", "idm", "ovm", "fvdm", "gipps", "krauss", "helly"),
    "crowd": ("sf", "esf", "gcfm", "ttc"),
}

#: Options that say what is simulated, not by which law.
SHARED = ("desired", "neighbours")


@dataclass(frozen=True)
class Job:
    """What is diagnosed.

    Attributes:
        model, data: their options in plain types.
        groups: the configuration groups that they come from.
        system: the model, not calibrated.
        inputs: the data.
        options: checked.
        laws: models to compare before, by name; none where nothing is to be compared.
        seconds: that reading took.
    """

    model: dict[str, Any]
    data: dict[str, Any]
    groups: dict[str, str]
    system: System
    inputs: Inputs
    options: DiscoverOptions
    laws: dict[str, System]
    seconds: float

    @property
    def name(self) -> str:
        """Of the model."""
        return str(self.model["name"])


#: Shows the stages of a work by its name and their seconds.
Watch = Callable[[str, dict[str, float]], AbstractContextManager[Stages | None]]


def unwatched(name: str, stages: dict[str, float]) -> AbstractContextManager[None]:
    return nullcontext()


def candidates(
    model: Mapping[str, Any], asked: System, options: DiscoverOptions
) -> dict[str, System]:
    """Models by name, the one that was asked for among them; vehicles drive behind measured
    leaders, people want to go where the one that was asked for says. None where nothing is to be
    compared.

    Args:
        model: options of the one that was asked for.

    Raises:
        ConfigError: an unknown name, or one of another domain.
    """
    names = LAWS[asked.domain] if options.compare is None else options.compare
    found: dict[str, System] = {}
    for one in names:
        if one not in MODELS:
            raise ConfigError(
                f"discover.compare: there is no model {one}, expected some of "
                f"{', '.join(LAWS[asked.domain])}, or another name as in conf/model"
            )
        found[one] = build_model(law_options(one, model), options.seed)
        if found[one].domain != asked.domain:
            raise ConfigError(
                f"discover.compare: {one} is a {found[one].domain} model, the data and the model "
                f"are of {asked.domain}; leave it out"
            )
    if found:
        own = found[str(model["name"])] = copy.deepcopy(asked)
        if isinstance(own, Traffic):
            own.leader = "measured"
    return found


def law_options(name: str, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a model that is compared with another one."""
    found = model_options(name, "measured")
    return {**found, **{key: asked[key] for key in SHARED if key in asked and key in found}}


def diagnosed(job: Job, watch: Watch) -> list[tuple[Job, DiagnosisOutcome]]:
    """The law that was asked for, then the one that comes nearest, where that is another one.

    Laws are compared first as they are, then with what the nearest of them lacks, then with what
    the one asked for lacks beside: a strong effect may bring another law to the front, which can
    imitate it.
    """
    set_threads(None, job.system.domain)
    seconds = 0.0

    def compared(known: dict[str, System], effects: list[Effect]) -> tuple[Laws, dict[str, System]]:
        nonlocal seconds
        start = time.monotonic()
        found, calibrated = _compared(job, with_effects(known, effects), watch)
        found.effects = [effect.name for effect in effects]
        seconds += time.monotonic() - start
        return found, calibrated

    laws, systems = compared(job.laws, []) if job.laws else (None, {})
    nearest = _with_law(job, laws.best or job.name) if laws else job
    found = _diagnose(nearest, watch)
    effects, again = _lacking(nearest, found), None
    hints: dict[str, System] = {}
    if systems and effects:
        again, hints = compared(systems, effects)
        if again.best != nearest.name:
            nearest = _with_law(job, again.best)
            found = _diagnose(nearest, watch, hint=hints[again.best])
    done = _both(job, nearest, found, hints, watch)
    # what imitates another law would bring that law's other imitations to the front
    known = {effect.name for effect in effects}
    more = [e for e in _lacking(*done[0]) if not e.built_into_laws and e.name not in known]
    if len(done) > 1 and more:
        last, hints = compared(systems, effects + more)
        behind = {one.name: one.p_value for one in last.ranking}
        if behind.get(nearest.name, 1.0) <= job.options.rules.level:
            again, nearest = last, _with_law(job, last.best)
            found = _diagnose(nearest, watch, hint=hints[last.best])
            done = _both(job, nearest, found, hints, watch)
    first = done[0][1].diagnosis
    first.laws, first.laws_again = laws, again
    first.seconds = {"reading": job.seconds, "laws": round(seconds, 3), **first.seconds}
    return done


def _lacking(job: Job, found: DiagnosisOutcome) -> list[Effect]:
    """Effects that the search gave to a law."""
    own = {effect.name for effect in effects_of(job.system)}
    return [effect for effect in effects_of(found.searched) if effect.name not in own]


def _both(
    job: Job, nearest: Job, found: DiagnosisOutcome, hints: dict[str, System], watch: Watch
) -> list[tuple[Job, DiagnosisOutcome]]:
    """The nearest law's diagnosis, after that of the one asked for, where it is another one."""
    if nearest.name == job.name:
        return [(nearest, found)]
    nearer = BetterLaw(nearest.name, found.searched)
    return [(job, _diagnose(job, watch, nearer, hints.get(job.name))), (nearest, found)]


def _compared(job: Job, laws: dict[str, System], watch: Watch) -> tuple[Laws, dict[str, System]]:
    with watch("laws", {"comparing laws": 10.0}) as stages:
        if stages is None:
            return compare_laws(laws, job.inputs.sequences, job.options)
        stages.begin("comparing laws")
        return compare_laws(laws, job.inputs.sequences, job.options, stages.within)


def _diagnose(
    job: Job, watch: Watch, nearer: BetterLaw | None = None, hint: System | None = None
) -> DiagnosisOutcome:
    """Run the diagnosis, and add what only its caller knows."""
    inputs, name = job.inputs, job.name
    with watch(f"diagnosis of {name}", STAGES) as stages:
        found = diagnose(
            job.system, inputs.sequences, job.options, stages=stages, nearer=nearer, hint=hint
        )
    found.diagnosis.data_faults = inputs.data_faults
    found.diagnosis.notes += inputs.measured
    found.diagnosis.model = name
    return found


def _with_law(job: Job, name: str) -> Job:
    """The same with another law."""
    if name == job.name:
        return job
    system, options = job.laws[name], job.options
    # effects that laws of its order know
    known = {e.name for e in CATALOGUE.of(job.inputs.domain, system.order)}
    effects = None if options.effects is None else [e for e in options.effects if e in known]
    out = [e for e in options.exclude if e in known]
    return replace(
        job,
        model=law_options(name, job.model),
        groups={**job.groups, "model": name},
        system=system,
        options=replace(options, effects=effects, exclude=out),
        laws={},
    )
