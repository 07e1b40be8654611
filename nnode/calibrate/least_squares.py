"""Damped least squares (Levenberg-Marquardt) within a box, for many problems at once.

A step consists of a descent and a search. The descent minimises the quadratic model of the cost
within the box, with damping in proportion to the curvature of each parameter. The search raises
the damping until a step lowers the cost, or tries several dampings at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

#: Damping: initial value, factors after an accepted and a refused step, smallest value, and the
#: value at which a problem ends.
DAMPING, EASE, STIFFEN, LEAST, STUCK = 1e-3, 0.2, 4.0, 1e-9, 1e8
#: Share of the cost below which a decrease is a rounding error.
ROUNDING = 1e-14
#: With a target cost (``hopeless``), a problem ends when a step gains less than this share of the
#: distance to it.
HOPE = 0.1


@dataclass(frozen=True)
class Quadratic:
    """Costs of B problems and their derivatives by P parameters.

    Attributes:
        cost: ``(B,)``; inf if a simulation blows up.
        gradient: ``(B, P)``.
        hessian: ``(B, P, P)`` Gauss-Newton approximation.
    """

    cost: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray

    def profiled(self, number: int) -> Quadratic:
        """The costs as functions of the first parameters, minimised over all others.

        The curvature is the Schur complement. Parameters without effect are ignored.

        Source: Golub & Pereyra 2003, variable projection.
        """
        bend = self.hessian
        inverse = np.linalg.pinv(bend[:, number:, number:], rcond=1e-10, hermitian=True)
        across = bend[:, :number, number:] @ inverse
        return Quadratic(
            self.cost,
            self.gradient[:, :number] - np.einsum("bpk,bk->bp", across, self.gradient[:, number:]),
            bend[:, :number, :number] - across @ bend[:, number:, :number],
        )


@dataclass(frozen=True)
class Minimum:
    """The results of B minimisations; for a single one, the first axes may be missing.

    Attributes:
        row: ``(B, P)`` parameters.
        cost: ``(B,)`` costs with the penalty.
        before: ``(B,)`` costs at the start.
        steps: number of computations of derivatives.
        damping: ``(B,)`` damping of the next step.
    """

    row: np.ndarray
    cost: np.ndarray
    before: np.ndarray
    steps: int
    damping: np.ndarray


def least_squares(
    quadratic: Callable[[np.ndarray], Quadratic],
    costs: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    *,
    steps: int = 100,
    tolerance: float = 1e-10,
    damping: float = DAMPING,
    penalty: tuple[np.ndarray, np.ndarray] | None = None,
    dampings: Sequence[float] = (),
    hopeless: float = 0.0,
) -> Minimum:
    """Minimise B sums of squares of P parameters each.

    Derivatives are computed again as soon as any problem has moved.

    Args:
        quadratic: costs and derivatives at parameters ``(B, P)``.
        costs: costs ``(T, B)`` of T trials ``(T, B, P)``; inf if a simulation blows up.
        start: ``(B, P)``; projected onto the box.
        low, high: ``(P,)`` or ``(B, P)`` the box.
        steps: largest number of computations of derivatives.
        tolerance: a problem ends when a step lowers its cost by less than this share.
        damping: damping of the first step, relative to each parameter's curvature.
        penalty: centre and weights ``(P,)`` of a sum of squares that is added.
        dampings: values that are all tried at each step, instead of one adaptive value. A problem
            ends if none lowers its cost. Only for a single problem.
        hopeless: a problem also ends when its cost is above this value and decreases too slowly
            to reach it; 0 disables this.

    Source:
        Nocedal & Wright, Numerical Optimization, 2nd ed., sections 10.3 and 16.7.
    """
    rows = np.clip(start, low, high)
    low, high = (np.broadcast_to(end, rows.shape) for end in (low, high))
    centre, weight = (rows[0], np.zeros(rows.shape[1])) if penalty is None else penalty
    each = np.arange(len(rows))
    damp, going = np.full(len(rows), damping), np.ones(len(rows), dtype=bool)
    before, steps_taken = np.empty(0), 0

    def penalty_at(at: np.ndarray) -> np.ndarray:
        value: np.ndarray = (at - centre) ** 2 @ weight
        return value

    while going.any() and steps_taken < steps:
        model = quadratic(rows)
        current = model.cost + penalty_at(rows)
        before = current if not steps_taken else before
        steps_taken += 1
        gradient = model.gradient + 2 * weight * (rows - centre)
        hessian = model.hessian + 2 * np.diag(weight)
        moved = np.zeros(len(rows), dtype=bool)
        while going.any() and not moved.any():
            tried = np.outer(dampings, np.ones(len(rows))) if dampings else damp[None]
            trials = np.repeat(rows[None], len(tried), 0)
            for b in np.flatnonzero(going):
                for trial, tried_damping in zip(trials, tried[:, b], strict=True):
                    trial[b] = box_step(
                        rows[b], gradient[b], hessian[b], tried_damping, low[b], high[b]
                    )
            values = costs(trials) + penalty_at(trials)
            best = np.argmin(values, 0)
            value = values[best, each]
            moved = going & (value < current)
            gain = np.where(moved, current - value, 0.0)
            rows = np.where(moved[:, None], trials[best, each], rows)
            large_enough = gain > max(tolerance, ROUNDING) * np.abs(current)
            if hopeless > 0:
                large_enough &= (value <= hopeless) | (gain >= HOPE * (value - hopeless))
            current = np.where(moved, value, current)
            damp = np.where(moved, np.maximum(damp * EASE, LEAST), damp * STIFFEN)
            if dampings:
                going &= moved & large_enough
                # the best damping comes first, because its simulation is reused for derivatives
                dampings = (*dampings[best[0] :], *dampings[: best[0]])
            else:
                going &= np.where(moved, large_enough, damp < STUCK)
    return Minimum(rows, current, before, steps_taken, damp)


def box_step(
    row: np.ndarray,
    gradient: np.ndarray,
    curvature: np.ndarray,
    damping: float,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """The damped step from ``row``, with parameters fixed at the bounds that the step crosses."""
    scale = np.diag(curvature)
    scale = np.maximum(scale, 1e-12 * max(scale.max(), 1e-300))
    damped = curvature + damping * np.diag(scale)
    free = ~(((row <= low) & (gradient > 0)) | ((row >= high) & (gradient < 0)))
    fixed = np.zeros(len(row))
    for _ in range(len(row) + 1):
        step = fixed.copy()
        if free.any():
            right_side = gradient[free] + damped[np.ix_(free, ~free)] @ fixed[~free]
            step[free] = -np.linalg.solve(damped[np.ix_(free, free)], right_side)
        outside = free & ((row + step < low) | (row + step > high))
        if not outside.any():
            break
        fixed[outside] = (np.clip(row + step, low, high) - row)[outside]
        free &= ~outside
    return np.clip(row + step, low, high)
