"""Damped least squares (Levenberg and Marquardt) within a box, many problems side by side.

A step is a descent and a search. The descent minimises the quadratic model of the cost, damped in
proportion to the curvature of each parameter, within the box. The search raises the damping until
a step lowers the cost, or tries several dampings side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

#: Damping: at the start, its factors after a step that was taken or refused, its least, its end.
DAMPING, EASE, STIFFEN, LEAST, STUCK = 1e-3, 0.2, 4.0, 1e-9, 1e8
#: Share of the cost below which a fall is rounding.
ROUNDING = 1e-14
#: With a cost that is asked for, a search ends when a step gains less than this share of what is
#: missing.
HOPE = 0.1


@dataclass(frozen=True)
class Quadratic:
    """Costs of B problems and their derivatives by P parameters.

    Attributes:
        cost: ``(B,)``; inf where a simulation blows up.
        gradient: ``(B, P)``.
        hessian: ``(B, P, P)`` Gauss and Newton's.
    """

    cost: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray

    def profiled(self, number: int) -> Quadratic:
        """The costs as functions of the first parameters, all others at their best values.

        The curvature is the Schur complement. Parameters that nothing depends on are left out.

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
    """Where B minimisations ended; of a single one, the first axes may be left out.

    Attributes:
        row: ``(B, P)`` parameters.
        cost: ``(B,)``, penalty included.
        before: ``(B,)`` costs at the start.
        steps: computations of derivatives.
        damping: ``(B,)`` of the next step.
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

    Derivatives are computed anew as soon as any problem has moved.

    Args:
        quadratic: of parameters ``(B, P)``.
        costs: of T trials ``(T, B, P)``, ``(T, B)``; inf where a simulation blows up.
        start: ``(B, P)``; moved into the box.
        low, high: ``(P,)`` or ``(B, P)`` the box.
        steps: computations of derivatives at most.
        tolerance: a problem ends when a step lowers its cost by less than this share.
        damping: of the first step, relative to each parameter's curvature.
        penalty: centre and weights ``(P,)`` of a sum of squares that is added.
        dampings: all of them are tried at each step, instead of one that is adapted. A problem
            ends where none lowers its cost. For a single problem.
        hopeless: a problem also ends when its cost has nearly stopped to fall and is still above
            this one; 0 switches that off.

    Source:
        Nocedal & Wright, Numerical Optimization, 2nd ed., sections 10.3 and 16.7.
    """
    rows = np.clip(start, low, high)
    low, high = (np.broadcast_to(end, rows.shape) for end in (low, high))
    centre, weight = (rows[0], np.zeros(rows.shape[1])) if penalty is None else penalty
    each = np.arange(len(rows))
    damp, going = np.full(len(rows), damping), np.ones(len(rows), dtype=bool)
    before, taken = np.empty(0), 0

    def tied(at: np.ndarray) -> np.ndarray:
        found: np.ndarray = (at - centre) ** 2 @ weight
        return found

    while going.any() and taken < steps:
        model = quadratic(rows)
        now = model.cost + tied(rows)
        before = now if not taken else before
        taken += 1
        gradient = model.gradient + 2 * weight * (rows - centre)
        hessian = model.hessian + 2 * np.diag(weight)
        moved = np.zeros(len(rows), dtype=bool)
        while going.any() and not moved.any():
            tried = np.outer(dampings, np.ones(len(rows))) if dampings else damp[None]
            trials = np.repeat(rows[None], len(tried), 0)
            for b in np.flatnonzero(going):
                for trial, own in zip(trials, tried[:, b], strict=True):
                    trial[b] = box_step(rows[b], gradient[b], hessian[b], own, low[b], high[b])
            values = costs(trials) + tied(trials)
            best = np.argmin(values, 0)
            value = values[best, each]
            moved = going & (value < now)
            gain = np.where(moved, now - value, 0.0)
            rows = np.where(moved[:, None], trials[best, each], rows)
            enough = gain > max(tolerance, ROUNDING) * np.abs(now)
            if hopeless > 0:
                enough &= (value <= hopeless) | (gain >= HOPE * (value - hopeless))
            now = np.where(moved, value, now)
            damp = np.where(moved, np.maximum(damp * EASE, LEAST), damp * STIFFEN)
            if dampings:
                going &= moved & enough
                # the best one comes first: its simulation is the one that derivatives are taken of
                dampings = (*dampings[best[0] :], *dampings[: best[0]])
            else:
                going &= np.where(moved, enough, damp < STUCK)
    return Minimum(rows, now, before, taken, damp)


def box_step(
    row: np.ndarray,
    gradient: np.ndarray,
    curvature: np.ndarray,
    damping: float,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
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
