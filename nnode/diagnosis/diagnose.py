"""The diagnosis of a model on data: laws are compared, the best-fitting law and the requested one
are diagnosed, and laws are compared again with the missing effects."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

from nnode.diagnosis import thresholds
from nnode.diagnosis.compare import BetterLaw, compare_laws, with_effects
from nnode.diagnosis.inputs import Inputs
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.result import Laws
from nnode.diagnosis.single_law import STAGES, diagnose_law
from nnode.model.effects import CATALOGUE, Effect
from nnode.model.extend import effects_of
from nnode.model.system import System
from nnode.progress import Stages


@dataclass(frozen=True)
class _Diagnosed:
    """A law, and what its diagnosis says."""

    name: str
    system: System
    outcome: DiagnosisOutcome

    @property
    def added(self) -> list[Effect]:
        """Effects that the search added to the law."""
        present = {effect.name for effect in effects_of(self.system)}
        searched = effects_of(self.outcome.searched)
        return [effect for effect in searched if effect.name not in present]

    def as_better_law(self) -> BetterLaw:
        """This law as one that fits better than another one."""
        named = frozenset(effect.name for effect in self.outcome.diagnosis.effects)
        return BetterLaw(self.name, self.outcome.searched, named)


def diagnose(
    name: str,
    system: System,
    laws: Mapping[str, System],
    inputs: Inputs,
    options: DiscoverOptions,
) -> list[DiagnosisOutcome]:
    """Diagnose the requested law, and the best-fitting law if it is another one.

    Laws are compared without effects, then with the effects that the best-fitting law lacks, and
    then with further effects that the requested law lacks. The repetition is necessary because a
    law that imitates a strong effect may first seem to fit best.

    Args:
        name: of the requested law.
        system: the requested law, not calibrated.
        laws: the compared laws by name, not calibrated, including the requested one; empty without
            a comparison.
        inputs: the data.
        options: they suit the requested law.

    Returns:
        One outcome or two, that of the requested law first.

    Raises:
        ConfigError, DataError, SimulationError: see
            :func:`~nnode.diagnosis.single_law.diagnose_law`.
    """
    seconds = 0.0

    def compared(effects: list[Effect]) -> tuple[Laws, dict[str, System]]:
        nonlocal seconds
        start = time.monotonic()
        with Stages("laws", {"comparing laws": 10.0}) as stages:
            stages.begin("comparing laws")
            ranking, calibrated = compare_laws(
                with_effects(laws, effects), name, inputs.sequences, options, stages.within
            )
        ranking.effects = [effect.name for effect in effects]
        seconds += time.monotonic() - start
        return ranking, calibrated

    def diagnosed(
        law: str, hint: System | None = None, better: BetterLaw | None = None
    ) -> _Diagnosed:
        requested = law == name
        chosen = system if requested else laws[law]
        applicable = options if requested else _applicable(options, chosen)
        with Stages(f"diagnosis of {law}", STAGES) as stages:
            outcome = diagnose_law(
                chosen, inputs.sequences, applicable, stages=stages, nearer=better, hint=hint
            )
        outcome.diagnosis.data_faults = inputs.data_faults
        outcome.diagnosis.notes += inputs.measured
        outcome.diagnosis.model = law
        return _Diagnosed(law, chosen, outcome)

    def requested_law(nearest: _Diagnosed, calibrated: Mapping[str, System]) -> _Diagnosed:
        """The requested law, which may be the best-fitting one."""
        if nearest.name == name:
            return nearest
        return diagnosed(name, calibrated.get(name), nearest.as_better_law())

    first_comparison = compared([])[0] if laws else None
    nearest = diagnosed(_nearest(first_comparison, name) if first_comparison else name)
    effects, second_comparison = nearest.added, None
    calibrated: dict[str, System] = {}
    if laws and effects:
        second_comparison, calibrated = compared(effects)
        best = _nearest(second_comparison, nearest.name)
        if best != nearest.name:
            nearest = diagnosed(best, calibrated[best])
    requested = requested_law(nearest, calibrated)
    # effects that are built into other laws are excluded, because they would favour laws that
    # imitate those
    names = {effect.name for effect in effects}
    further = [e for e in requested.added if not e.built_into_laws and e.name not in names]
    if requested is not nearest and further:
        last, calibrated = compared(effects + further)
        if last.p_values.get(nearest.name, 1.0) <= thresholds.LEVEL:
            second_comparison = last
            nearest = diagnosed(last.best, calibrated[last.best])
            requested = requested_law(nearest, calibrated)
    diagnosis = requested.outcome.diagnosis
    diagnosis.laws, diagnosis.laws_again = first_comparison, second_comparison
    for comparison in filter(None, (first_comparison, second_comparison)):
        comparison.nearest = nearest.name
    diagnosis.seconds = {"laws": round(seconds, 3), **diagnosis.seconds}
    return [requested.outcome, *([] if requested is nearest else [nearest.outcome])]


def _nearest(laws: Laws, name: str) -> str:
    """The name of the best law; the named law, if the comparison does not reject it."""
    if laws.p_values.get(name, 0.0) > thresholds.STRICT:
        return name
    return laws.best or name


def _applicable(options: DiscoverOptions, law: System) -> DiscoverOptions:
    """The options with the effects that are defined for laws of this order."""
    names = {effect.name for effect in CATALOGUE.of(law.domain, law.order)}
    effects = options.effects and [e for e in options.effects if e in names]
    return replace(options, effects=effects, exclude=[e for e in options.exclude if e in names])
