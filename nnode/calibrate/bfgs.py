"""Projected BFGS for many runs side by side, as one evaluation of an ensemble serves all."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

#: ``(R, K)`` rows to ``(R,)`` costs and ``(R, K)`` gradients.
Evaluate = Callable[[Tensor], tuple[Tensor, Tensor]]

#: Sufficient decrease (Armijo), and the factor of a step that was not good enough.
DECREASE, SHORTEN = 1e-4, 0.25
#: Longest step of a parameter vector: the first one, and all others.
FIRST, LONGEST = 0.3, 3.0
#: So many refused steps in a row make a run forget its curvature.
PATIENCE = 8


@dataclass(frozen=True)
class Minima:
    """Where R minimisations ended.

    Attributes:
        rows: ``(R, K)`` parameters.
        costs: ``(R,)``; inf where not even the start could be simulated.
        gradients: ``(R, K)``.
        inverses: ``(R, K, K)`` approximations of the inverse Hessians.
        evaluations: calls of the ensemble, the same for all runs.
    """

    rows: Tensor
    costs: Tensor
    gradients: Tensor
    inverses: Tensor
    evaluations: int

    @property
    def best(self) -> int:
        """The run with the least cost."""
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
    """Minimise R costs, each from a start of its own, within a box.

    Dense BFGS approximations of the inverse Hessian; parameters at a bound that the gradient
    presses against are held fixed; trial points are projected onto the box. All runs try one
    point per evaluation: a run that is refused shortens its step while the others go on.

    Args:
        start: ``(R, K)``.
        low, high: ``(K,)`` the box.
        iterations: evaluations at most.
        tolerance: ends when within 20 evaluations no cost fell by more than this share.
        inverse: ``(K, K)`` inverse Hessian to start from, as found by an earlier minimisation
            of nearly the same cost; None starts from the steepest descent.

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
    # without curvature yet: the first step is cut, the first curvature scales the rest
    fresh = torch.full((len(x),), inverse is None)
    length, refused = torch.ones(len(x), dtype=x.dtype), torch.zeros(len(x), dtype=torch.long)
    along = _direction(x, gradient, inverses, fresh, low, high)
    earlier, done = cost, 0
    for done in range(1, iterations + 1):
        trial = (x + length[:, None] * along).clamp(low, high)
        value, slope = evaluate(trial)
        step = trial - x
        enough = cost + DECREASE * (step * gradient).sum(1)
        taken = (value <= enough) & (value < cost) & torch.isfinite(slope).all(1)
        change = torch.where(taken[:, None], slope - gradient, 0.0)
        inverses, fresh = _updated(inverses, fresh, taken, step, change)
        x, gradient = (
            torch.where(taken[:, None], *both) for both in ((trial, x), (slope, gradient))
        )
        cost = torch.where(taken, value, cost)
        refused = torch.where(taken, 0, refused + 1)
        lost = refused >= PATIENCE
        inverses = torch.where(lost[:, None, None], unit, inverses)
        fresh |= lost
        refused[lost] = 0
        new = taken | lost
        length = torch.where(new, 1.0, length * SHORTEN)
        turned = _direction(x, gradient, inverses, fresh, low, high)
        along = torch.where(new[:, None], turned, along)
        if done % 20 == 0:
            still = (earlier - cost <= tolerance * cost.abs()) | ~torch.isfinite(cost)
            if bool(still.all()):
                break
            earlier = cost
    return Minima(x, cost, gradient, inverses, done + 1)


def optimality_residual(
    rows: Tensor, costs: Tensor, gradients: Tensor, low: Tensor, high: Tensor
) -> Tensor:
    """``(R,)`` largest relative fall of the cost, to first order, per relative change of a
    parameter: max_k |P(u_k - g_k) - u_k| max(|u_k|, 1) / J, with P the projection onto the box.

    Zero at a point that satisfies the first-order optimality conditions.
    """
    away = ((rows - gradients).clamp(low, high) - rows).abs() * rows.abs().clamp(min=1.0)
    return away.amax(1) / costs


def _times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """``(R, K, K)`` times ``(R, K)``."""
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _updated(
    inverses: Tensor, fresh: Tensor, taken: Tensor, step: Tensor, change: Tensor
) -> tuple[Tensor, Tensor]:
    """Inverse Hessians after the steps that were taken and met curvature, and which runs have met
    none yet."""
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
    found = -_times(inverses, gradient * free) * free
    size = found.norm(dim=1, keepdim=True)
    most = torch.where(fresh, FIRST, LONGEST).to(size)[:, None]
    return torch.where(size > most, found * most / size, found)
