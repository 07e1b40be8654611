"""Least squares over all samples of several batches together, from several starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from nnode.calibrate.cost import Convention
from nnode.calibrate.least_squares import Quadratic, least_squares
from nnode.calibrate.parameters import ParameterVector
from nnode.calibrate.problem import ResidualProblem
from nnode.data.sequence import Batch
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver

#: Steps of a calibration at most, and how many of the best starts go on.
STEPS, BEST = 12, 2


def parameters_of(system: System) -> dict[str, float]:
    """The parameters of a model of one term by name."""
    return {name: value.item() for name, value in system.terms[0].named_parameters()}


def filled(system: System, row: Mapping[str, float]) -> System:
    """The same model with other parameters."""
    return ParameterVector(system).fill_(np.array([row[name] for name in parameters_of(system)]))


def pooled_fit(
    system: System, batches: Sequence[Batch], starts: Sequence[Mapping[str, float]]
) -> tuple[dict[str, float], float]:
    """Calibrate a model of one term.

    Args:
        system: is filled with the result.
        batches: all their samples count alike.
        starts: parameters by name, of which the best go on.

    Returns:
        Parameters by name, and the mean squared distance over agents and samples, m².
    """
    problems = [ResidualProblem(system, batch, FusedSolver(), Convention.sum) for batch in batches]
    first = problems[0]
    share = 2 / sum(int(batch.valid[1:].sum()) for batch in batches)

    def costs(trials: np.ndarray) -> np.ndarray:
        return np.array([[share * sum(p.costs(row).sum() for p in problems)] for (row,) in trials])

    def quadratic(rows: np.ndarray) -> Quadratic:
        each = [problem(rows[0]) for problem in problems]
        parts = zip(*((part.cost, part.gradient, part.hessian) for part in each), strict=True)
        return Quadratic(*(share * np.concatenate(part).sum(0)[None] for part in parts))

    rows = [np.array(list(start.values())) for start in starts]
    rows.sort(key=lambda row: float(costs(row[None, None])[0, 0]))
    minima = [
        least_squares(
            quadratic, costs, row[None], first.low, first.high, steps=STEPS, tolerance=1e-6
        )
        for row in rows[:BEST]
    ]
    best = min(minima, key=lambda part: float(part.cost[0]))
    values = dict(zip(starts[0], best.row[0].tolist(), strict=True))
    filled(system, values)
    return values, float(best.cost[0])
