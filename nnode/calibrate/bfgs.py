"""Projected BFGS for many runs at once, with one evaluation of an ensemble for all runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

#: ``(R, K)`` rows to ``(R,)`` costs and ``(R, K)`` gradients.
Evaluate = Callable[[Tensor], tuple[Tensor, Tensor]]

#: Sufficient decrease (Armijo), and the factor on a refused step.
DECREASE, SHORTEN = 1e-4, 0.25
#: Longest step of a parameter vector: the first step, and all other steps.
FIRST, LONGEST = 0.3, 3.0
#: Number of consecutive refused steps after which a run resets its inverse Hessian.
PATIENCE = 8


@dataclass(frozen=True)
class Minima:
    """The results of R minimisations.

    Attributes:
        rows: ``(R, K)`` parameters.
        costs: ``(R,)``; inf if the start could not be simulated.
        gradients: ``(R, K)``.
        inverses: ``(R, K, K)`` approximations of the inverse Hessians.
        evaluations: calls of the ensemble, equal for all runs.
    """

    rows: Tensor
    costs: Tensor
    gradients: Tensor
    inverses: Tensor
    evaluations: int

    @property
    def best(self) -> int:
        """Index of the run with the lowest cost."""
        return int(self.costs.argmin())


def minimise(
    evaluate: Evaluate,
    start: Tensor,
    low: Tensor,
    high: Tensor,
    *,
    iterations: int = 150,
    tolerance: float = 1e-7,
    inverse: Tensor | None = None,
) -> Minima:
    """Minimise R costs, each from a separate start, within a box.

    The inverse Hessian is a dense BFGS approximation. Parameters at a bound are fixed while the
    descent direction points out of the box, and trial points are projected onto the box. Each
    evaluation tries one point per run. A run whose point is refused shortens its step.

    Args:
        start: ``(R, K)``.
        low, high: ``(K,)`` the box.
        iterations: largest number of evaluations.
        tolerance: the minimisation ends when no cost decreases by more than this share within 20
            evaluations.
        inverse: ``(K, K)`` initial inverse Hessian, such as the result of an earlier minimisation
            of a similar cost; None starts with the steepest descent.

    Source:
        Nocedal & Wright, Numerical Optimization, 2nd ed., sections 6.1 and 16.7.
    """
    x = start.clamp(low, high)
    cost, gradient = evaluate(x)
    usable = torch.isfinite(cost) & torch.isfinite(gradient).all(1)
    cost = torch.where(usable, cost, math.inf)
    gradient = torch.where(usable[:, None], gradient, 0.0)
    unit = torch.eye(x.shape[1], dtype=x.dtype)
    inverses = (unit if inverse is None else inverse).repeat(len(x), 1, 1)
    # fresh runs have no curvature: their step is limited, and the first curvature sets the scale
    fresh = torch.full((len(x),), inverse is None)
    length, refused = torch.ones(len(x), dtype=x.dtype), torch.zeros(len(x), dtype=torch.long)
    search_direction = _direction(x, gradient, inverses, fresh, low, high)
    earlier_cost, done = cost, 0
    for done in range(1, iterations + 1):
        trial = (x + length[:, None] * search_direction).clamp(low, high)
        value, slope = evaluate(trial)
        step = trial - x
        enough = cost + DECREASE * (step * gradient).sum(1)
        taken = (value <= enough) & (value < cost) & torch.isfinite(slope).all(1)
        change = torch.where(taken[:, None], slope - gradient, 0.0)
        inverses, fresh = _updated(inverses, fresh, taken, step, change)
        x, gradient = (
            torch.where(taken[:, None], *pair) for pair in ((trial, x), (slope, gradient))
        )
        cost = torch.where(taken, value, cost)
        refused = torch.where(taken, 0, refused + 1)
        stuck = refused >= PATIENCE
        inverses = torch.where(stuck[:, None, None], unit, inverses)
        fresh |= stuck
        refused[stuck] = 0
        restarted = taken | stuck
        length = torch.where(restarted, 1.0, length * SHORTEN)
        direction = _direction(x, gradient, inverses, fresh, low, high)
        search_direction = torch.where(restarted[:, None], direction, search_direction)
        if done % 20 == 0:
            stalled = (earlier_cost - cost <= tolerance * cost.abs()) | ~torch.isfinite(cost)
            if bool(stalled.all()):
                break
            earlier_cost = cost
    return Minima(x, cost, gradient, inverses, done + 1)


def optimality_residual(
    rows: Tensor, costs: Tensor, gradients: Tensor, low: Tensor, high: Tensor
) -> Tensor:
    """``(R,)`` largest relative decrease of the cost, to first order, per relative change of a
    parameter: max_k |P(u_k - g_k) - u_k| max(|u_k|, 1) / J, with P the projection onto the box.

    It is zero at a point that satisfies the first-order optimality conditions.
    """
    away = ((rows - gradients).clamp(low, high) - rows).abs() * rows.abs().clamp(min=1.0)
    return away.amax(1) / costs


def _times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """The products of ``(R, K, K)`` matrices and ``(R, K)`` vectors."""
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _updated(
    inverses: Tensor, fresh: Tensor, taken: Tensor, step: Tensor, change: Tensor
) -> tuple[Tensor, Tensor]:
    """The BFGS update of the inverse Hessians; and which runs still have no curvature."""
    product = (step * change).sum(1)
    good = taken & (product > 1e-12 * step.norm(dim=1) * change.norm(dim=1))
    rate = torch.where(good, 1.0 / product, 0.0)[:, None, None]
    first = good & fresh
    scale = torch.where(first, product / (change * _times(inverses, change)).sum(1), 1.0)
    left = torch.eye(step.shape[1], dtype=step.dtype) - rate * step[:, :, None] * change[:, None]
    scaled = inverses * scale[:, None, None]
    update = left @ scaled @ left.mT + rate * step[:, :, None] * step[:, None]
    return torch.where(good[:, None, None], update, scaled), fresh & ~first


def _direction(
    x: Tensor, gradient: Tensor, inverses: Tensor, fresh: Tensor, low: Tensor, high: Tensor
) -> Tensor:
    free = ~(((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0)))
    direction = -_times(inverses, gradient * free) * free
    size = direction.norm(dim=1, keepdim=True)
    longest = torch.where(fresh, FIRST, LONGEST).to(size)[:, None]
    return torch.where(size > longest, direction * longest / size, direction)
