"""Regression baselines on the columns, residuals and split of the diagnosis."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
from omegaconf import OmegaConf

from benchmarks.discovery.regression import BASELINES, Library
from nnode.calibrate.parameters import ParameterVector, with_parameters
from nnode.config import SCHEMAS
from nnode.data.options import Faults
from nnode.data.readers.table import TableOptions
from nnode.data.sequence import Domain
from nnode.diagnosis.division import divide
from nnode.diagnosis.inputs import read_inputs
from nnode.diagnosis.model_comparison import engine_of, windows_of
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.residuals.engine import Engine, square_of
from nnode.diagnosis.residuals.fit import Fit, refine
from nnode.diagnosis.search import converged_fit
from nnode.diagnosis.statistics.score import Trace, traces
from nnode.errors import SimulationError
from nnode.model import build_model
from nnode.model.effects import CATALOGUE, Effect, IndividualEffect
from nnode.model.extend import extended
from nnode.model.system import System

#: A cell belongs to an interval where its coefficient is at least this share of the largest one.
_CELL = 0.3


def baselines_on_table(
    path: Path,
    domain: str,
    *,
    model: Mapping[str, Any],
    walls: Path | None,
    leader: str,
    seed: int,
) -> dict[str, dict[str, Any]]:
    """The baselines' reports by name, with the parts that the score reads.

    Effects with a number per agent are not offered to the baselines.

    Raises:
        NNodeError: as :func:`nnode.app.discover.diagnose_table`.
    """
    schema = SCHEMAS[("model", f"{model['term']}_schema")]
    given = dict(model) if domain == "crowd" else {"leader": leader, **model}
    merged = OmegaConf.merge(OmegaConf.structured(schema), given)
    built = OmegaConf.to_container(merged, enum_to_str=True)
    system = build_model(cast(dict[str, Any], built), seed)
    data = TableOptions(
        domain=domain,
        path=str(path),
        walls=None if walls is None else str(walls),
        name="table",
        faults=Faults.drop,
    )
    with TemporaryDirectory(prefix="nnode-baselines-") as scratch:
        sequences = read_inputs(data, Path(scratch)).sequences
    division = divide(sequences, DiscoverOptions(seed=seed))
    exploration, confirmation = division.exploration, division.confirmation
    engine = windows_of(system, exploration.sequences, exploration.label)
    fit = converged_fit(engine, copy.deepcopy(system).double())
    offered = [e for e in CATALOGUE.of(cast(Domain, domain)) if not issubclass(e, IndividualEffect)]
    columns = [trace for effect in offered for trace in traces(engine, fit, effect)]
    values = np.concatenate([trace.columns for trace in columns], axis=1)
    library = Library(values, -fit.residual, fit.tangents, engine.cluster)

    whole = engine_of(system, confirmation.sequences, whole=True)
    whole.fit_whitening(fit.system, ParameterVector(fit.system).row)
    before, floor = square_of(whole, fit.system), whole.noise_floor()
    reports = {}
    for name, choose in BASELINES.items():
        theta = choose(library, seed)
        ends = np.cumsum([trace.columns.shape[1] for trace in columns])
        chosen = [
            (trace, part)
            for trace, part in zip(columns, np.split(theta, ends[:-1]), strict=True)
            if part.any()
        ]
        names = list(dict.fromkeys(trace.effect.name for trace, _ in chosen))
        after = before
        if names:
            after = square_of(whole, _calibrated(engine, _with(fit, chosen, values @ theta)))
        reports[name] = {
            "verdict": "named" if names else "none",
            "effects": [{"name": n, "coefficients": {}, "alternatives": []} for n in names],
            "gap": {
                "before": before,
                "after": after,
                "closed": (before - after) / (before - floor),
            },
        }
    return reports


def _calibrated(engine: Engine, system: System) -> System:
    """The chosen effects are calibrated as those of the diagnosis: only the choice differs."""
    try:
        return refine(engine, system).system
    except SimulationError:
        return system


def _with(fit: Fit, chosen: list[tuple[Trace, np.ndarray]], change: np.ndarray) -> System:
    """The base model with the chosen effects; its own parameters follow their ``change``, m."""
    row = fit.row.copy()
    row[fit.free] -= np.linalg.lstsq(fit.tangents, fit.residual + change, rcond=None)[0]
    system = with_parameters(fit.system, row)
    system.project_()
    for trace, theta in chosen:
        system, _ = extended(system, _effect(trace, theta))
    return system


def _effect(trace: Trace, theta: np.ndarray) -> Effect:
    """An effect with the strengths that a regression gave its columns."""
    kind = trace.effect
    if kind.consecutive:
        strong = int(np.argmax(np.abs(theta)))
        other = np.flatnonzero(theta * np.sign(theta[strong]) < _CELL * abs(theta[strong]))
        first = int(max(other[other < strong], default=-1)) + 1
        last = int(min(other[other > strong], default=len(theta))) - 1
        (name,) = kind.strengths
        ends = {"a": trace.probes[first].options["a"], "b": trace.probes[last].options["b"]}
        return kind(**{**ends, name: _plausible(kind, name, float(theta[first : last + 1].mean()))})
    (probe,) = trace.probes
    strengths = {
        name: _plausible(kind, name, float(value))
        for name, value in zip(probe.steps, theta, strict=False)
    }
    return kind(**{**probe.options, **strengths})


def _plausible(kind: type[Effect], name: str, amount: float) -> float:
    """A strength in its range."""
    strength = kind.strengths[name]
    return float(np.clip(strength.neutral + amount, strength.range.low, strength.range.high))
