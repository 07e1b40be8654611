"""Bias of scores and of parameters, by parametric bootstrap.

The linearisation at the agents' modes, the errors of smoothed leaders, and people who react to each
other bias scores slightly, which is significant in large data sets. The bias is the mean score in
paths that the calibrated model simulates. An effect must be significant with and without this
correction, because simulations of a very wrong model are wrong too. Draws are antithetic pairs, in
which terms that are linear in pushes, deviations and errors cancel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from nnode.calibrate.parameters import ParameterVector, with_parameters
from nnode.data.clusters import group_sums
from nnode.diagnosis.residuals.engine import AgentsEngine, Engine
from nnode.diagnosis.residuals.fit import Fit, evaluated
from nnode.diagnosis.statistics.leverage import orthonormal, without_span
from nnode.errors import SimulationError
from nnode.model.extend import effects_of, place_of

#: Engines of simulated paths, and the model's fits to them.
SimulatedFits = list[tuple[Engine, Fit]]


def simulated_fits(engine: Engine, fit: Fit, seed: int) -> SimulatedFits:
    """Fits of a calibrated model to its own simulated paths; empty if the engine does not simulate
    any, or if the simulation diverges.

    Args:
        seed: of the draws.
    """
    if not isinstance(engine, AgentsEngine):
        return []
    try:
        engines = engine.simulated_engines(fit.system, torch.from_numpy(fit.row), seed)
    except SimulationError:
        return []
    fits: SimulatedFits = [(simulated, evaluated(simulated, fit.system)) for simulated in engines]
    finite = all(np.isfinite(simulated_fit.residual).all() for _, simulated_fit in fits)
    return fits if finite else []


def mean_scores(
    simulated: SimulatedFits, columns: Callable[[Engine, Fit], np.ndarray], label: np.ndarray
) -> np.ndarray | float:
    """``(G, k)`` mean scores of directions by cluster in simulated paths.

    Args:
        columns: the directions ``(n, k)`` of an engine and a fit.
        label: ``(n,)`` clusters.
    """
    parts = []
    for engine, fit in simulated:
        basis, effect_columns = orthonormal(fit.jacobian), columns(engine, fit)
        parts.append(group_sums(without_span(effect_columns, basis), label, fit.residual))
    return np.asarray(np.mean(parts, 0)) if parts else 0.0


def corrected_for_bias(engine: Engine, fit: Fit, seed: int) -> Fit:
    """A calibrated model, corrected for the bias of its parameters, with the standard errors of the
    correction; the same if the engine does not simulate, or if the simulations diverge.

    Residuals and derivatives remain those of the calibration, and so do the ends of intervals,
    whose confidence intervals are profiles.

    Args:
        seed: of the draws.
    """
    if not isinstance(engine, AgentsEngine):
        return fit
    try:
        biases = engine.biases(fit.system, torch.from_numpy(fit.row), seed)
    except (SimulationError, np.linalg.LinAlgError):
        return fit
    corrected = fit.free & ~np.isin(fit.names, _ends(fit))
    bias = np.where(corrected, biases.mean(0), 0.0)
    error = np.where(corrected, biases.std(0, ddof=1) / np.sqrt(len(biases)), 0.0)
    row = np.clip(fit.row - bias, *ParameterVector(fit.system).bounds)
    system = with_parameters(fit.system, row)
    return replace(fit, system=system, row=row, simulated=error)


def _ends(fit: Fit) -> list[str]:
    """Names of the parameters that are ends of intervals."""
    return [
        f"terms.{place_of(fit.system, effect.name)}.{name}"
        for effect in effects_of(fit.system)
        if effect.consecutive
        for name in effect.settings
    ]
