"""Scores of effects where there are none, by simulation.

The linearisation at drivers' estimates and the errors of smoothed leaders shift scores a little,
which many data would tell from nothing. So the calibrated model makes paths of its own; what is
scored there is the shift. What is found must stand out with and without it: where a model is quite
wrong, its paths are so, too. Draws come in pairs of opposite signs, in which what is linear in
pushes, deviations and errors cancels.
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

#: Engines of paths that a model has made, and what it leaves of them.
SimulatedFits = list[tuple[Engine, Fit]]


def simulated_fits(engine: Engine, fit: Fit, seed: int) -> SimulatedFits:
    """What a calibrated model leaves of paths that it has made; nothing where the engine makes
    none, or where the model blows up.

    Args:
        seed: of the draws.
    """
    if not isinstance(engine, FollowersEngine):
        return []
    try:
        engines = engine.drawn(fit.system, torch.from_numpy(fit.row), seed)
    except SimulationError:
        return []
    fits: SimulatedFits = [(simulated, evaluated(simulated, fit.system)) for simulated in engines]
    finite = all(np.isfinite(simulated_fit.residual).all() for _, simulated_fit in fits)
    return fits if finite else []


def mean_scores(
    simulated: SimulatedFits, columns: Callable[[Engine, Fit], np.ndarray], label: np.ndarray
) -> np.ndarray | float:
    """``(G, k)`` mean scores of directions by cluster in paths that a model has made.

    Args:
        columns: of an engine and a fit the directions ``(n, k)``.
        label: ``(n,)`` clusters.
    """
    parts = []
    for engine, fit in simulated:
        basis, effect_columns = orthonormal(fit.tangents), columns(engine, fit)
        parts.append(sums(effect_columns - basis @ (basis.T @ effect_columns), label, fit.residual))
    return np.asarray(np.mean(parts, 0)) if parts else 0.0
