"""Comparison of laws and diagnosis of the nearest one.

Laws are compared, the nearest law and the requested one are diagnosed, and laws are compared again
with the missing effects.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from nnode.app.python.inputs import model_options
from nnode.app.training import set_threads, threads_given_back
from nnode.config import choices
from nnode.discover import thresholds
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

#: Default laws of the comparison. Networks are excluded because they contain effects, and newell
#: because it remembers steps.
LAWS = {
    "traffic": ("lin", "log", "idm", "ovm", "fvdm", "gipps", "krauss", "helly"),
    "crowd": ("sf", "esf", "gcfm", "ttc"),
}

#: Options of the simulation that all compared laws share.
SHARED = ("desired", "neighbours")


@dataclass(frozen=True)
class Job:
    """The arguments of a diagnosis.

    Attributes:
        model, data: options of model and data in plain types.
        groups: the configuration groups of model and data.
        system: the uncalibrated model.
        inputs: the data.
        options: the checked options.
        laws: name to model for the comparison; empty without a comparison.
        seconds: time of reading, s.
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
        """Name of the model."""
        return str(self.model["name"])


def candidates(
    model: Mapping[str, Any], asked: System, options: DiscoverOptions
) -> dict[str, System]:
    """Name to model for the comparison, including the requested model; empty without a comparison.

    Vehicles follow measured leaders. People have the destinations of the requested model.

    Args:
        model: options of the requested model.
        asked: the requested model.

    Raises:
        ConfigError: a name is unknown, or its model has another domain.
    """
    names = LAWS[asked.domain] if options.compare is None else options.compare
    models: dict[str, System] = {}
    for name in names:
        if name not in choices("model"):
            raise ConfigError(
                f"discover.compare: there is no model {name}, expected some of "
                f"{', '.join(LAWS[asked.domain])}, or another name as in conf/model"
            )
        models[name] = build_model(law_options(name, model), options.seed)
        if models[name].domain != asked.domain:
            raise ConfigError(
                f"discover.compare: {name} is a {models[name].domain} model, the data and the "
                f"model are of {asked.domain}; leave it out"
            )
    if models:
        asked_model = models[str(model["name"])] = copy.deepcopy(asked)
        if isinstance(asked_model, Traffic):
            asked_model.leader = "measured"
    return models


def law_options(name: str, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a model for the comparison with the model of the options ``asked``."""
    options = model_options(name, "measured")
    return {**options, **{key: asked[key] for key in SHARED if key in asked and key in options}}


@threads_given_back()
def diagnosed(job: Job) -> list[tuple[Job, DiagnosisOutcome]]:
    """Diagnoses of the requested law and of the nearest law, if it is another one.

    Laws are compared without effects, then with the effects that the nearest law lacks, and then
    with further effects that the requested law lacks. The repetition is necessary because a law
    that imitates a strong effect may first seem to be the nearest one.
    """
    set_threads(None, job.system.domain)
    seconds = 0.0

    def compared(
        models: dict[str, System], effects: list[Effect]
    ) -> tuple[Laws, dict[str, System]]:
        nonlocal seconds
        start = time.monotonic()
        with Stages("laws", {"comparing laws": 10.0}) as stages:
            stages.begin("comparing laws")
            ranking, calibrated = compare_laws(
                with_effects(models, effects),
                job.name,
                job.inputs.sequences,
                job.options,
                stages.within,
            )
        ranking.effects = [effect.name for effect in effects]
        seconds += time.monotonic() - start
        return ranking, calibrated

    laws, _ = compared(job.laws, []) if job.laws else (None, {})
    nearest = _with_law(job, _nearest(laws, job)) if laws else job
    outcome = _diagnose(nearest)
    effects, second_comparison = _added_effects(nearest, outcome), None
    calibrated_laws: dict[str, System] = {}
    if job.laws and effects:
        second_comparison, calibrated_laws = compared(job.laws, effects)
        best = _nearest(second_comparison, nearest)
        if best != nearest.name:
            nearest = _with_law(job, best)
            outcome = _diagnose(nearest, hint=calibrated_laws[best])
    diagnoses = _diagnoses(job, nearest, outcome, calibrated_laws)
    # effects that are built into other laws are excluded, because they would favour laws that
    # imitate those
    names = {effect.name for effect in effects}
    further = [
        e for e in _added_effects(*diagnoses[0]) if not e.built_into_laws and e.name not in names
    ]
    if len(diagnoses) > 1 and further:
        last, calibrated_laws = compared(job.laws, effects + further)
        if last.p_values.get(nearest.name, 1.0) <= thresholds.LEVEL:
            second_comparison, nearest = last, _with_law(job, last.best)
            outcome = _diagnose(nearest, hint=calibrated_laws[last.best])
            diagnoses = _diagnoses(job, nearest, outcome, calibrated_laws)
    first = diagnoses[0][1].diagnosis
    first.laws, first.laws_again = laws, second_comparison
    for comparison in filter(None, (laws, second_comparison)):
        comparison.nearest = nearest.name
    first.seconds = {"reading": job.seconds, "laws": round(seconds, 3), **first.seconds}
    return diagnoses


def _nearest(laws: Laws, job: Job) -> str:
    """The name of the best law; the law of the job, if the comparison does not reject it."""
    if laws.p_values.get(job.name, 0.0) > thresholds.STRICT:
        return job.name
    return laws.best or job.name


def _added_effects(job: Job, outcome: DiagnosisOutcome) -> list[Effect]:
    """Effects that the search added to a law."""
    present = {effect.name for effect in effects_of(job.system)}
    return [effect for effect in effects_of(outcome.searched) if effect.name not in present]


def _diagnoses(
    job: Job,
    nearest: Job,
    outcome: DiagnosisOutcome,
    calibrated_laws: dict[str, System],
) -> list[tuple[Job, DiagnosisOutcome]]:
    """The diagnosis of the requested law, if it is not the nearest, and of the nearest law."""
    if nearest.name == job.name:
        return [(nearest, outcome)]
    named = frozenset(effect.name for effect in outcome.diagnosis.effects)
    nearer = BetterLaw(nearest.name, outcome.searched, named)
    return [(job, _diagnose(job, nearer, calibrated_laws.get(job.name))), (nearest, outcome)]


def _diagnose(
    job: Job, nearer: BetterLaw | None = None, hint: System | None = None
) -> DiagnosisOutcome:
    """Run the diagnosis, and add faults of the data, notes and the name of the model."""
    inputs, name = job.inputs, job.name
    with Stages(f"diagnosis of {name}", STAGES) as stages:
        outcome = diagnose(
            job.system, inputs.sequences, job.options, stages=stages, nearer=nearer, hint=hint
        )
    outcome.diagnosis.data_faults = inputs.data_faults
    outcome.diagnosis.notes += inputs.measured
    outcome.diagnosis.model = name
    return outcome


def _with_law(job: Job, name: str) -> Job:
    """The job with another law."""
    if name == job.name:
        return job
    system, options = job.laws[name], job.options
    # effects that are defined for laws of this order
    applicable = {e.name for e in CATALOGUE.of(job.inputs.domain, system.order)}
    effects = None if options.effects is None else [e for e in options.effects if e in applicable]
    excluded = [e for e in options.exclude if e in applicable]
    return replace(
        job,
        model=law_options(name, job.model),
        groups={**job.groups, "model": name},
        system=system,
        options=replace(options, effects=effects, exclude=excluded),
        laws={},
    )
