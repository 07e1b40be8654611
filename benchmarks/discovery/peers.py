"""Peers of the diagnosis on its own library, residuals and split: reports like its own."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
from omegaconf import OmegaConf

from benchmarks.synthetic_cases.regression import PEERS, Library
from nnode.calibrate.parameters import ParameterVector
from nnode.config import SCHEMAS
from nnode.data.options import Faults
from nnode.data.readers.table import TableOptions
from nnode.data.sequence import Domain
from nnode.discover.division import divide
from nnode.discover.inputs import read_inputs
from nnode.discover.judge.model_comparison import engine_of, windows_of
from nnode.discover.name.search import converged_fit
from nnode.discover.options import DiscoverOptions
from nnode.discover.residuals.engine import Engine, square_of
from nnode.discover.residuals.fit import Fit, refine
from nnode.discover.statistics.score import Trace, traces
from nnode.errors import SimulationError
from nnode.model import build_model
from nnode.model.effects import CATALOGUE, Effect
from nnode.model.extend import extended
from nnode.model.system import System

#: A cell belongs to an interval where its coefficient is at least this share of the largest one.
_CELL = 0.3


@dataclass(frozen=True)
class Column:
    """One column of the library.

    Attributes:
        trace: it belongs to.
        number: its place in the trace.
    """

    trace: Trace
    number: int

    @property
    def effect(self) -> type[Effect]:
        return self.trace.effect


def peers_on_table(
    path: Path,
    domain: str,
    *,
    model: Mapping[str, Any],
    walls: Path | None,
    leader: str,
    seed: int,
) -> dict[str, dict[str, Any]]:
    """The peers' reports by name, with what :func:`benchmarks.synthetic_cases.score.score` reads.

    Effects with a number per agent are no columns and are not offered to the peers.

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
    with TemporaryDirectory(prefix="nnode-peers-") as scratch:
        sequences = read_inputs(data, Path(scratch)).sequences
    division = divide(sequences, DiscoverOptions(seed=seed))
    exploration, confirmation = division.exploration, division.confirmation
    engine = windows_of(system, [sequences[i] for i in exploration], division.label[exploration])
    fit = converged_fit(engine, copy.deepcopy(system).double())
    offered = [e for e in CATALOGUE.of(cast(Domain, domain)) if not e.individual]
    found = [trace for effect in offered for trace in traces(engine, fit, effect)]
    columns = [Column(trace, i) for trace in found for i in range(trace.columns.shape[1])]
    values = np.concatenate([trace.columns for trace in found], axis=1)
    library = Library(values, -fit.residual, fit.tangents, engine.cluster)

    whole = engine_of(system, [sequences[i] for i in confirmation], whole=True)
    whole.fit_whitening(fit.system, ParameterVector(fit.system).row)
    before, floor = square_of(whole, fit.system), whole.noise_floor()
    split = {"sealed": [sequences[i].name for i in confirmation]}
    reports = {}
    for name, choose in PEERS.items():
        theta = choose(library, seed)
        names = list(dict.fromkeys(columns[j].effect.name for j in np.flatnonzero(theta)))
        after = before
        if names:
            after = square_of(whole, _calibrated(engine, _with(fit, columns, values, theta)))
        reports[name] = {
            "verdict": "named" if names else "none",
            "effects": [{"name": n, "coefficients": {}, "alternatives": []} for n in names],
            "gap": {"before": before, "after": after, "noise_floor": floor},
            "split": split,
        }
    return reports


def _calibrated(engine: Engine, system: System) -> System:
    """The chosen effects are calibrated as those of the diagnosis: only the choice differs."""
    try:
        return refine(engine, system).system
    except SimulationError:
        return system


def _with(fit: Fit, columns: list[Column], values: np.ndarray, theta: np.ndarray) -> System:
    """The base model with the chosen effects, its own parameters moved as they ask for."""
    system = copy.deepcopy(fit.system)
    if theta.any():
        rest = fit.residual + values @ theta
        row = fit.row.copy()
        row[fit.free] -= np.linalg.lstsq(fit.tangents, rest, rcond=None)[0]
        system = ParameterVector(system).fill_(row)
        system.project_()
    traces_by_id = {id(columns[j].trace): columns[j].trace for j in np.flatnonzero(theta)}
    for key, trace in traces_by_id.items():
        own = np.array([t for t, c in zip(theta, columns, strict=True) if id(c.trace) == key])
        system, _ = extended(system, _effect(trace, own))
    return system


def _effect(trace: Trace, theta: np.ndarray) -> Effect:
    """An effect with the strengths that a regression gave its columns."""
    kind = trace.effect
    if kind.consecutive:
        strong = int(np.argmax(np.abs(theta)))
        like = theta * np.sign(theta[strong]) >= _CELL * abs(theta[strong])
        first = last = strong
        while first > 0 and like[first - 1]:
            first -= 1
        while last + 1 < len(theta) and like[last + 1]:
            last += 1
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
