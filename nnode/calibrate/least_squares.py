"""Levenberg and Marquardt's method for simulated trajectories, within a box.

The cost of a trajectory is a sum of squares, so that the derivatives of the simulated positions
give its curvature as well. For tens of parameters this takes far fewer simulations than methods
that learn the curvature from gradients, and it does not care about the parameters' units.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.ensemble import EnsembleCost
from nnode.errors import SimulationError

#: ``(K,)`` parameters to ``(M,)`` residuals, or None where the simulation blows up.
Residuals = Callable[[np.ndarray], Tensor | None]

#: Damping: at the start, its factors after a step that was taken or refused, and its end.
DAMPING, EASE, STIFFEN, STUCK = 1e-3, 0.2, 4.0, 1e8
#: Steps at most with corrected derivatives before they are computed anew.
CORRECTIONS = 4
#: A step with corrected derivatives that lowers the cost by less than this share is the last
#: before they are computed anew.
WORTH = 1e-3
#: Share of the first cost that is rounding.
NOTHING = 1e-13
#: Difference of a parameter, relative to its size, by precision; and the least size that counts.
DIFFERENCE = {torch.float32: 1e-3, torch.float64: 1e-6}


@dataclass(frozen=True)
class Minimum:
    """Where a minimisation ended.

    Attributes:
        row: ``(K,)`` parameters.
        cost: sum of squared residuals.
        evaluations: simulations.
        steps: accepted steps.
    """

    row: np.ndarray
    cost: float
    evaluations: int
    steps: int


def trajectory_residuals(cost: EnsembleCost, weights: np.ndarray | None = None) -> Residuals:
    """Residuals whose sum of squares is the weighted cost of a batch.

    Args:
        cost: the model, its sequences and its solver.
        weights: ``(B,)`` weight of every sequence, of sum 1; None takes the mean.
    """
    batch = cost.batch
    share = np.full(len(batch), 1 / len(batch)) if weights is None else weights
    factor = torch.from_numpy(share).to(batch.x) * (batch.dt / 2)
    seen = batch.valid[1:]
    factor = factor.sqrt()[None, :, None].expand(seen.shape)[seen][:, None]
    measured = batch.x[1:][seen]

    def residuals(row: np.ndarray) -> Tensor | None:
        system = cost.vector.fill_(row)
        try:
            with torch.no_grad():
                away = cost.solver(system, batch).x[1:][seen] - measured
        except SimulationError:
            return None
        return (away * factor).flatten().to(batch.dtype)  # it decides the size of differences

    return residuals


def least_squares(
    residuals: Residuals,
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    *,
    steps: int = 30,
    tolerance: float = 1e-6,
    least: float = 0.1,
) -> Minimum:
    """Minimise the sum of squared residuals within a box.

    Derivatives are forward differences, corrected by Broyden's formula for as long as this
    pays. Parameters at a bound that the gradient presses against are held fixed; damping is
    relative to the curvature of each parameter.

    Args:
        start: ``(K,)``; moved into the box.
        low, high: ``(K,)`` the box.
        steps: computations of all derivatives at most.
        tolerance: ends when the cost falls by less than this share from one computation of the
            derivatives to the next.
        least: parameters smaller than this are varied as if they had this size.

    Raises:
        SimulationError: the start itself cannot be simulated.

    Source:
        Nocedal & Wright, Numerical Optimization, 2nd ed., sections 10.3 and 11.1.
    """
    row = np.clip(start, low, high)
    now = residuals(row)
    if now is None:
        raise SimulationError("the start of a least-squares calibration cannot be simulated")
    cost, number, damping, taken = _square(now), 1, DAMPING, 0
    nothing = NOTHING * cost
    for _ in range(steps):
        columns = _derivatives(residuals, row, now, high, least)
        number += len(row)
        before = cost
        for correction in range(1 + CORRECTIONS):
            gradient, curvature = _normal(columns, now)
            found, value = None, math.inf
            while damping < STUCK:
                trial = box_step(row, gradient, curvature, damping, low, high)
                found = residuals(trial)
                number += 1
                value = math.inf if found is None else _square(found)
                # corrected derivatives may be wrong: rather compute them anew than stiffen
                if value < cost or correction:
                    break
                damping *= STIFFEN
            if found is None or value >= cost:
                break
            _correct(columns, trial - row, found - now)
            worth = cost - value > WORTH * cost
            row, now, cost = trial, found, value
            taken, damping = taken + 1, max(damping * EASE, 1e-9)
            if not worth or cost <= nothing:
                break
        if before - cost < tolerance * before or cost <= nothing:
            break
        damping = min(damping, 1.0)
    return Minimum(row, cost, number, taken)


def _normal(columns: Tensor, now: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Half the gradient of the sum of squares, and Gauss and Newton's half of its Hessian."""
    both = (columns @ torch.cat([columns, now[None]]).T).double().numpy()
    return both[:, -1], both[:, :-1]


def _correct(columns: Tensor, step: np.ndarray, change: Tensor) -> None:
    """Broyden's correction: the derivatives now explain the change of the last step."""
    along = torch.from_numpy(step).to(columns)
    columns += torch.outer(along / along.square().sum(), change - along @ columns)


def _square(values: Tensor) -> float:
    return float(values.square().sum(dtype=torch.float64))


def _derivatives(
    residuals: Residuals, row: np.ndarray, now: Tensor, high: np.ndarray, least: float
) -> Tensor:
    """``(K, M)`` derivatives of the residuals, by forward differences."""
    columns = now.new_zeros(len(row), len(now))
    for j, value in enumerate(row):
        away = DIFFERENCE[now.dtype] * max(abs(value), least)
        away = -away if value + away > high[j] else away
        other = row.copy()
        other[j] += away
        found = residuals(other)
        if found is not None:  # a parameter that cannot be varied is left alone in this step
            columns[j] = (found - now) / away
    return columns


def damped_step(
    cost: Callable[[np.ndarray], float], now: float, row: np.ndarray, gradient: np.ndarray,
    curvature: np.ndarray, damping: float, low: np.ndarray, high: np.ndarray,
) -> tuple[np.ndarray, float, float]:  # fmt: skip
    """The first step from ``row`` that lowers the cost from ``now``, with more and more damping.

    Returns:
        where it ends and the cost there, and the next step's damping; ``row``, ``now`` and the
        last damping where no step lowers it.
    """
    while damping < STUCK:
        trial = box_step(row, gradient, curvature, damping, low, high)
        value = cost(trial)
        if value < now:
            return trial, value, max(damping * EASE, 1e-9)
        damping *= STIFFEN
    return row, now, damping


def box_step(
    row: np.ndarray, gradient: np.ndarray, curvature: np.ndarray, damping: float,
    low: np.ndarray, high: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """The damped step from ``row``, bounds that it meets held one after the other."""
    scale = np.diag(curvature)
    scale = np.maximum(scale, 1e-12 * max(scale.max(), 1e-300))
    damped = curvature + damping * np.diag(scale)
    free = ~(((row <= low) & (gradient > 0)) | ((row >= high) & (gradient < 0)))
    fixed = np.zeros(len(row))
    for _ in range(len(row) + 1):
        step = fixed.copy()
        if free.any():
            rest = gradient[free] + damped[np.ix_(free, ~free)] @ fixed[~free]
            step[free] = -np.linalg.solve(damped[np.ix_(free, free)], rest)
        out = free & ((row + step < low) | (row + step > high))
        if not out.any():
            break
        fixed[out] = (np.clip(row + step, low, high) - row)[out]
        free &= ~out
    return np.clip(row + step, low, high)
