"""Comparison of base laws by leave-one-cluster-out costs.

Every law is calibrated to the positions of whole sequences. The whitening is fitted to the
residuals of the best law, and all laws are recalibrated to residuals with this common whitening.
Their costs are those of left-out clusters. If another law is then the best, the whitening is fitted
to its residuals and the comparison is repeated.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Domain, Sequence
from nnode.discover.division import divide
from nnode.discover.eligibility import check_model, not_offered
from nnode.discover.judge.model_comparison import engine_of, windows_of
from nnode.discover.name.search import Selection, Step, initial_fit
from nnode.discover.options import DiscoverOptions
from nnode.discover.residuals.engine import Engine, square_of
from nnode.discover.residuals.fit import Fit, refine
from nnode.discover.result import ComparedLaw, Laws
from nnode.discover.rules import rules
from nnode.discover.statistics.paired import compare, heldout
from nnode.errors import ConfigError
from nnode.model.effects import CATALOGUE, Effect
from nnode.model.extend import effects_of, extended
from nnode.model.system import System

#: Largest number of repetitions with another law's whitening.
ROUNDS = 3


def compare_laws(
    candidates: Mapping[str, System],
    sequences: list[Sequence],
    options: DiscoverOptions,
    within: Callable[[float], None] = lambda part: None,
) -> tuple[Laws, dict[str, System]]:
    """Rank laws on the exploration clusters of a diagnosis with the same options.

    Args:
        candidates: models by name; they are not changed. Those that the diagnosis cannot simulate
            are reported as refused, with the reason.
        sequences: without faults, at least three of them.
        within: is told which part of the work is done, between 0 and 1.

    Returns:
        The ranking, and the laws, calibrated.

    Raises:
        DataError: too few sequences.
    """
    division = divide(sequences, options)
    exploration = [sequences[i] for i in division.exploration]
    label = division.label[division.exploration]
    any_system = next(iter(candidates.values()))
    whole = engine_of(any_system, exploration, label, whole=True)
    fits, refused = _calibrated(whole, candidates, within)
    if not fits:
        return Laws([], refused, 0), {}
    number = np.bincount(whole.cluster)
    errors = {name: heldout(fit, whole.cluster) / number for name, fit in fits.items()}
    if any_system.domain == "crowd":  # its residuals are not positions
        errors = {n: np.array([square_of(whole, fit.system)]) for n, fit in fits.items()}
    reference = min(errors, key=lambda name: float(errors[name].mean()))
    engine = windows_of(any_system, exploration, label)
    costs: dict[str, np.ndarray] = {}
    for _ in range(ROUNDS):
        engine.fit_whitening(fits[reference].system, ParameterVector(fits[reference].system).row)
        for place, (name, fit) in enumerate(fits.items()):
            within((1 + place / len(fits)) / 2)
            fits[name] = refine(engine, copy.deepcopy(fit.system))
        costs = {name: heldout(fit, engine.cluster) for name, fit in fits.items()}
        best = min(costs, key=lambda name: _level(costs[name]))
        if best == reference:
            break
        reference = best
    ranking = []
    for name in sorted(costs, key=lambda name: _level(costs[name])):
        comparison = compare(costs[name], costs[best])
        system = fits[name].system
        ranking.append(
            ComparedLaw(
                name=name,
                parameters=len(fits[name].row),
                error=float(errors[name].mean()),
                behind=math.exp(_level(costs[name]) - _level(costs[best])) - 1,
                p_value=1.0 if name == best else comparison.p_value,
                values={k: (float(v), unit) for k, (v, unit) in system.physical().items()},
            )
        )
    systems = {name: fit.system for name, fit in fits.items()}
    return Laws(ranking, refused, int(engine.cluster.max()) + 1), systems


def with_effects(laws: Mapping[str, System], effects: list[Effect]) -> dict[str, System]:
    """Copies of laws with those effects that apply to them, with the given start values."""
    extended_laws = {}
    for name, law in laws.items():
        offered = CATALOGUE.of(cast(Domain, law.domain), law.order)
        present = {effect.name for effect in effects_of(law)}
        for effect in effects:
            kind = type(effect)
            if kind in offered and effect.name not in present and not not_offered(kind, law):
                law, _ = extended(law, kind(**effect.options()))
        extended_laws[name] = copy.deepcopy(law)
    return extended_laws


@dataclass(frozen=True)
class BetterLaw:
    """A law that fits better than the diagnosed one, with the effects selected for it.

    Attributes:
        system: calibrated on the same exploration clusters.
    """

    name: str
    system: System


def explained_by_law(
    engine: Engine, selection: Selection, label: np.ndarray, nearer: BetterLaw
) -> tuple[list[Step], float]:
    """Selected effects that a better-fitting law does not need: they imitate that law.

    There are none if that law does not predict left-out clusters better than the diagnosed one
    with its effects. Effects that are built into laws, and those that the better law lacks too,
    are not returned.

    Args:
        label: ``(S,)`` clusters of the engine's sequences.

    Returns:
        The effects, and the one-sided p-value of that comparison.
    """
    engine_of_law = windows_of(nearer.system, engine.sequences, label)
    engine_of_law.fit_whitening(nearer.system, ParameterVector(nearer.system).row)
    costs = [
        heldout(refine(engine_of_law, copy.deepcopy(system)), engine_of_law.cluster)
        for system in (selection.fit.system, nearer.system)
    ]
    p_value = compare(*costs).p_value
    if p_value > rules().level:
        return [], p_value
    shared = {effect.name for effect in effects_of(nearer.system)}
    steps = [
        step
        for step in selection.steps
        if not step.chosen.score.effect.built_into_laws and step.chosen.name not in shared
    ]
    return steps, p_value


def _level(costs: np.ndarray) -> float:
    """Mean logarithm of the clusters' costs, so that no cluster dominates."""
    level = np.log(np.maximum(np.nan_to_num(costs, nan=np.inf), 1e-300)).mean()
    return float(level)


def _calibrated(
    engine: Engine, candidates: Mapping[str, System], within: Callable[[float], None]
) -> tuple[dict[str, Fit], dict[str, str]]:
    """Every law, calibrated from the better of two starts with the present whitening."""
    fits: dict[str, Fit] = {}
    refused: dict[str, str] = {}
    for place, (name, system) in enumerate(candidates.items()):
        within(place / len(candidates) / 2)
        try:
            check_model(system)
        except ConfigError as error:
            refused[name] = str(error)
            continue
        fit = initial_fit(engine, copy.deepcopy(system).double())
        if fit is None:
            refused[name] = "it blows up on these data"
        else:
            fits[name] = fit
    return fits, refused
