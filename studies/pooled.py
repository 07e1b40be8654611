"""Least squares over all samples of several batches together, from several starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Pooled:
    """What a calibration found; the system has these parameters.

    Attributes:
        row: parameters by name.
        error: mean squared distance over agents and samples, m².
        starts: the same reached from every start that went on.
        evaluations: simulations of the first batch.
    """

    row: dict[str, float]
    error: float
    starts: list[float]
    evaluations: int


def start_of(system: System, batch: Batch) -> dict[str, float]:
    """A model's parameters by name, as it has them."""
    vector = ResidualProblem(system, batch, FusedSolver(), Convention.sum).vector
    names = [name for name, _ in system.terms[0].named_parameters()]
    return dict(zip(names, vector.row.tolist(), strict=True))


def pooled_fit(
    system: System, batches: Sequence[Batch], starts: Sequence[dict[str, float]]
) -> Pooled:
    """Calibrate a model of one term.

    Args:
        system: is filled with what is found.
        batches: all their samples count alike.
        starts: parameters by name, of which the best go on.
    """
    problems = [ResidualProblem(system, batch, FusedSolver(), Convention.sum) for batch in batches]
    first = problems[0]
    share = 2 / sum(int(batch.valid[1:].sum()) for batch in batches)

    def costs(trials: np.ndarray) -> np.ndarray:
        return np.array([[share * sum(p.costs(row).sum() for p in problems)] for (row,) in trials])

    def quadratic(rows: np.ndarray) -> Quadratic:
        each = [problem(rows[0]) for problem in problems]
        parts = zip(*((one.cost, one.gradient, one.hessian) for one in each), strict=True)
        return Quadratic(*(share * np.concatenate(part).sum(0)[None] for part in parts))

    rows = [np.array(list(start.values())) for start in starts]
    rows.sort(key=lambda row: float(costs(row[None, None])[0, 0]))
    minima = [
        least_squares(
            quadratic, costs, row[None], first.low, first.high, steps=STEPS, tolerance=1e-6
        )
        for row in rows[:BEST]
    ]
    found = min(minima, key=lambda one: float(one.cost[0]))
    ParameterVector(system).fill_(found.row[0])
    return Pooled(
        row=dict(zip(starts[0], found.row[0].tolist(), strict=True)),
        error=float(found.cost[0]),
        starts=[float(one.cost[0]) for one in minima],
        evaluations=first.simulations,
    )
