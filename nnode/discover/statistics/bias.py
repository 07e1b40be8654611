"""Bias of scores under the null hypothesis, by parametric bootstrap.

The linearisation at the drivers' modes and the errors of smoothed leaders bias scores slightly,
which is significant in large data sets. The bias is the mean score in paths that the calibrated
model simulates. An effect must be significant with and without this correction, because simulations
of a very wrong model are wrong too. Draws are antithetic pairs, in which terms that are linear in
pushes, deviations and errors cancel.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from nnode.discover.lanes.followers import FollowersEngine
from nnode.discover.residuals.engine import Engine
from nnode.discover.residuals.fit import Fit, evaluated, sums
from nnode.discover.statistics.leverage import orthonormal
from nnode.errors import SimulationError

#: Engines of simulated paths, and the model's fits to them.
SimulatedFits = list[tuple[Engine, Fit]]


def simulated_fits(engine: Engine, fit: Fit, seed: int) -> SimulatedFits:
    """Fits of a calibrated model to its own simulated paths; empty if the engine does not simulate
    any, or if the simulation diverges.

    Args:
        seed: of the draws.
    """
    if not isinstance(engine, FollowersEngine):
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
        basis, effect_columns = orthonormal(fit.tangents), columns(engine, fit)
        parts.append(sums(effect_columns - basis @ (basis.T @ effect_columns), label, fit.residual))
    return np.asarray(np.mean(parts, 0)) if parts else 0.0
