"""Comparison of base laws.

Where agents may differ, laws are compared by their marginal likelihoods, each with agents, pushes
and parameters of its own, minus a price of parameters (BIC). A common parameter for agents who
differ would favour laws that imitate differences. The test is that of Vuong 1989, by cluster.

Otherwise every law is calibrated to the positions of whole sequences, and laws are compared by
leave-one-cluster-out costs. The whitening is fitted to the residuals of the best law, and all laws
are recalibrated to residuals with this common whitening. If another law is then the best, the
whitening is fitted to its residuals and the comparison is repeated.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from nnode.calibrate.parameters import ParameterVector
from nnode.data.clusters import better
from nnode.data.sequence import Sequence
from nnode.diagnosis import thresholds
from nnode.diagnosis.crowds.engine import CrowdEngine
from nnode.diagnosis.division import divide, spacing
from nnode.diagnosis.eligibility import check_model, not_offered
from nnode.diagnosis.lanes.followers import FollowersEngine
from nnode.diagnosis.model_comparison import engine_of, windows_of
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.residuals.engine import AgentsEngine, Engine, square_of
from nnode.diagnosis.residuals.fit import Fit, refine
from nnode.diagnosis.result import ComparedLaw, Laws
from nnode.diagnosis.search import Selection, Step, initial_fit
from nnode.diagnosis.statistics.paired import compare, heldout
from nnode.errors import ConfigError, SimulationError
from nnode.model.effects import CATALOGUE, Effect
from nnode.model.extend import with_missing
from nnode.model.system import System
from nnode.population.followers import drivers_differ, follower_formula, without_errors

#: Why a law is not compared where drivers may differ.
NO_FORMULA = (
    "it is no formula of the positions and speeds of a driver and of the vehicles ahead, and has "
    "no likelihood where drivers differ; diagnose it by itself with discover.compare=[]"
)
BLOWS_UP = "it blows up on these data"
#: Largest number of repetitions with another law's whitening.
ROUNDS = 3


def compare_laws(
    candidates: Mapping[str, System],
    name: str,
    sequences: list[Sequence],
    options: DiscoverOptions,
    within: Callable[[float], None] = lambda part: None,
) -> tuple[Laws, dict[str, System]]:
    """Rank laws on the exploration clusters of a diagnosis with the same options.

    Args:
        candidates: models by name; they are not changed. Those that the diagnosis cannot simulate
            are reported as refused, with the reason.
        name: of the law that is diagnosed.
        sequences: without faults, at least three of them.
        within: is told which part of the work is done, between 0 and 1.

    Returns:
        The ranking, and the laws, calibrated.

    Raises:
        DataError: too few sequences.
    """
    asked = candidates[name]
    differ = drivers_differ(asked, sequences)
    skip_starts = differ and without_errors(sequences)
    part = divide(sequences, options, skip_starts=skip_starts).exploration
    formulas, refused = dict(candidates), dict[str, str]()
    engine: Engine
    if differ:
        formulas = {key: law for key, law in candidates.items() if follower_formula(law)}
        refused = {key: NO_FORMULA for key in candidates if key not in formulas}
        apart = spacing(sequences, options)
        engine = FollowersEngine(part.sequences, part.label, large=np.inf, apart=apart)
    else:
        engine = engine_of(asked, part.sequences, part.label, whole=True)
    formulas, failed = _simulable(formulas)
    refused |= failed
    if isinstance(engine, CrowdEngine):
        compared = _by_likelihood(
            engine, {k: [law] for k, law in formulas.items()}, refused, within
        )
        errors = {}
        for key, system in compared.systems.items():
            engine.fit_whitening(system, ParameterVector(system).row)
            errors[key] = square_of(engine, system)
    else:
        fits, failed = _calibrated(engine, formulas, within)
        refused |= failed
        if not fits:
            return Laws([], refused, 0), {}
        number = np.bincount(engine.cluster)
        errors = {k: float((heldout(f, engine.cluster) / number).mean()) for k, f in fits.items()}
        if isinstance(engine, FollowersEngine):
            starts = {
                key: [fit.system, formulas[key], engine.regression_start(formulas[key])]
                for key, fit in fits.items()
            }
            compared = _by_likelihood(engine, starts, refused, within)
        else:
            engine = windows_of(asked, part.sequences, part.label)
            compared = _by_cost(engine, fits, errors, within)
    ranking = [
        ComparedLaw(
            name=key,
            parameters=len(ParameterVector(compared.systems[key]).row),
            error=errors[key],
            behind=behind,
            p_value=p_value,
            values={
                n: (float(v), unit) for n, (v, unit) in compared.systems[key].physical().items()
            },
        )
        for key, (behind, p_value) in compared.ranks.items()
    ]
    likelihood = isinstance(engine, AgentsEngine)
    return Laws(ranking, refused, compared.clusters, likelihood=likelihood), compared.systems


@dataclass(frozen=True)
class _Ranks:
    """Laws by their likelihoods or costs.

    Attributes:
        ranks: by name, ``behind`` and ``p_value`` of a
            :class:`~nnode.diagnosis.result.ComparedLaw`, the best law first.
        systems: the laws, calibrated. clusters: their number.
    """

    ranks: dict[str, tuple[float, float]]
    systems: dict[str, System]
    clusters: int


def _by_likelihood(
    engine: AgentsEngine,
    starts: Mapping[str, list[System]],
    refused: dict[str, str],
    within: Callable[[float], None],
) -> _Ranks:
    """Rank laws by their marginal likelihoods.

    Args:
        starts: the laws by name with different parameters. Those of a calibration with the same
            ones for all agents may be far from those of the typical one.
        refused: laws whose paths diverge are added.
    """
    values, systems = dict[str, np.ndarray](), dict[str, System]()
    for place, (name, laws) in enumerate(starts.items()):
        within((1 + place / len(starts)) / 2)
        try:
            value, system = engine.log_likelihoods(*laws)
        except (SimulationError, np.linalg.LinAlgError):
            value = np.array([np.nan])
        if np.isfinite(value).all():
            values[name], systems[name] = value, system
        else:
            refused[name] = BLOWS_UP
    names = sorted(values, key=lambda name: -float(values[name].sum()))
    best = values[names[0]] if names else np.zeros(0)
    ranks = {
        name: (
            math.expm1((best.sum() - values[name].sum()) / len(engine.cluster)),
            1.0 if name == names[0] else better(best - values[name]),
        )
        for name in names
    }
    return _Ranks(ranks, systems, len(best))


def _by_cost(
    engine: Engine,
    fits: dict[str, Fit],
    errors: Mapping[str, float],
    within: Callable[[float], None],
) -> _Ranks:
    """Rank laws by their costs of left-out clusters.

    Args:
        fits: laws, calibrated; they are replaced. errors: of positions; the whitening is first
            fitted to the law with the smallest one.
    """
    reference = min(errors, key=lambda name: errors[name])
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
    ranks = {
        name: (
            math.exp(_level(costs[name]) - _level(costs[best])) - 1,
            1.0 if name == best else compare(costs[name], costs[best]).p_value,
        )
        for name in sorted(costs, key=lambda name: _level(costs[name]))
    }
    systems = {name: fit.system for name, fit in fits.items()}
    return _Ranks(ranks, systems, int(engine.cluster.max()) + 1)


def with_effects(laws: Mapping[str, System], effects: list[Effect]) -> dict[str, System]:
    """Copies of laws with those effects that apply to them, with the given start values."""
    extended_laws = {}
    for name, law in laws.items():
        offered = CATALOGUE.of(law.domain, law.order)
        for effect in effects:
            kind = type(effect)
            if kind in offered and not not_offered(kind, law):
                law = with_missing(law, [effect])
        extended_laws[name] = copy.deepcopy(law)
    return extended_laws


@dataclass(frozen=True)
class BetterLaw:
    """A law that fits better than the diagnosed one, with the effects selected for it.

    Attributes:
        system: calibrated on the same exploration clusters.
        named: names of the effects that its diagnosis named.
    """

    name: str
    system: System
    named: frozenset[str] = frozenset()


def explained_by_law(
    engine: Engine, selection: Selection, label: np.ndarray, nearer: BetterLaw
) -> tuple[list[Step], float]:
    """Selected effects that a better-fitting law does not need: they imitate that law.

    There are none if that law does not predict left-out clusters better than the diagnosed one
    with its effects. Effects that are built into laws, and those that are named for the better
    law too, are not returned.

    Args:
        label: ``(S,)`` clusters of the engine's sequences.

    Returns:
        The effects, and the one-sided p-value of that comparison.
    """
    p_value = 1.0
    if not isinstance(engine, AgentsEngine):
        engine_of_law = windows_of(nearer.system, engine.sequences, label)
        engine_of_law.fit_whitening(nearer.system, ParameterVector(nearer.system).row)
        costs = [
            heldout(refine(engine_of_law, copy.deepcopy(system)), engine_of_law.cluster)
            for system in (selection.fit.system, nearer.system)
        ]
        p_value = compare(*costs).p_value
    elif isinstance(engine, CrowdEngine) or follower_formula(nearer.system):
        systems = nearer.system, selection.fit.system
        with suppress(SimulationError, np.linalg.LinAlgError):
            of_law, of_effects = (engine.log_likelihoods(system)[0] for system in systems)
            p_value = better(of_law - of_effects)
    if p_value > thresholds.LEVEL:
        return [], p_value
    steps = [
        step
        for step in selection.steps
        if not step.chosen.score.effect.built_into_laws and step.chosen.name not in nearer.named
    ]
    return steps, p_value


def _level(costs: np.ndarray) -> float:
    """Mean logarithm of the clusters' costs, so that no cluster dominates."""
    level = np.log(np.maximum(np.nan_to_num(costs, nan=np.inf), 1e-300)).mean()
    return float(level)


def _simulable(candidates: Mapping[str, System]) -> tuple[dict[str, System], dict[str, str]]:
    """The laws that a diagnosis can simulate, and why it cannot simulate the others."""
    laws, refused = dict[str, System](), dict[str, str]()
    for name, system in candidates.items():
        try:
            check_model(system)
            laws[name] = system
        except ConfigError as error:
            refused[name] = str(error)
    return laws, refused


def _calibrated(
    engine: Engine, candidates: Mapping[str, System], within: Callable[[float], None]
) -> tuple[dict[str, Fit], dict[str, str]]:
    """Every law, calibrated from the better of two starts with the present whitening."""
    fits: dict[str, Fit] = {}
    refused: dict[str, str] = {}
    for place, (name, system) in enumerate(candidates.items()):
        within(place / len(candidates) / 2)
        fit = initial_fit(engine, copy.deepcopy(system).double())
        if fit is None:
            refused[name] = BLOWS_UP
        else:
            fits[name] = fit
    return fits, refused
