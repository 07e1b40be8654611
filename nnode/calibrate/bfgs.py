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
    runs = _Runs(evaluate, start, low, high, inverse)
    earlier = runs.cost
    done = 0
    for done in range(1, iterations + 1):
        runs.advance()
        if done % 20 == 0:
            if bool(
                (earlier - runs.cost <= tolerance * runs.cost.abs())
                .logical_or(~torch.isfinite(runs.cost))
                .all()
            ):
                break
            earlier = runs.cost
    return Minima(runs.x, runs.cost, runs.gradient, runs.inverse, done + 1)


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


class _Runs:
    """State of all runs: points, costs, gradients, inverse Hessians, steps."""

    def __init__(
        self,
        evaluate: Evaluate,
        start: Tensor,
        low: Tensor,
        high: Tensor,
        inverse: Tensor | None = None,
    ) -> None:
        self.evaluate, self.low, self.high = evaluate, low, high
        self.x = start.clamp(low, high)
        cost, gradient = evaluate(self.x)
        usable = torch.isfinite(cost) & torch.isfinite(gradient).all(1)
        self.cost = torch.where(usable, cost, math.inf)
        self.gradient = torch.where(usable[:, None], gradient, 0.0)
        runs, size = start.shape
        self.unit = torch.eye(size, dtype=start.dtype)
        self.inverse = (self.unit if inverse is None else inverse).repeat(runs, 1, 1)
        # without curvature yet: the first step is cut, the first curvature scales the rest
        self.fresh = torch.full((runs,), inverse is None)
        self.length = torch.ones(runs, dtype=start.dtype)
        self.refused = torch.zeros(runs, dtype=torch.long)
        self.direction = self._direction()

    def advance(self) -> None:
        """One evaluation: every run tries its step, and learns from it."""
        trial = (self.x + self.length[:, None] * self.direction).clamp(self.low, self.high)
        cost, gradient = self.evaluate(trial)
        step = trial - self.x
        enough = self.cost + DECREASE * (step * self.gradient).sum(1)
        taken = (cost <= enough) & (cost < self.cost) & torch.isfinite(gradient).all(1)
        self._learn(taken, step, torch.where(taken[:, None], gradient - self.gradient, 0.0))
        self.x = torch.where(taken[:, None], trial, self.x)
        self.gradient = torch.where(taken[:, None], gradient, self.gradient)
        self.cost = torch.where(taken, cost, self.cost)
        self.refused = torch.where(taken, 0, self.refused + 1)
        lost = self.refused >= PATIENCE
        self.inverse = torch.where(lost[:, None, None], self.unit, self.inverse)
        self.fresh |= lost
        self.refused[lost] = 0
        new = taken | lost
        self.length = torch.where(new, 1.0, self.length * SHORTEN)
        self.direction = torch.where(new[:, None], self._direction(), self.direction)

    def _learn(self, taken: Tensor, step: Tensor, change: Tensor) -> None:
        """Update the inverse Hessians of the runs whose step was taken and met curvature."""
        product = (step * change).sum(1)
        good = taken & (product > 1e-12 * step.norm(dim=1) * change.norm(dim=1))
        rate = torch.where(good, 1.0 / product, 0.0)
        first = good & self.fresh
        quadratic = (change * _times(self.inverse, change)).sum(1)
        scale = torch.where(first, product / quadratic, 1.0)
        inverse = self.inverse * scale[:, None, None]
        self.fresh &= ~first
        left = self.unit - rate[:, None, None] * step[:, :, None] * change[:, None, :]
        update = left @ inverse @ left.mT + rate[:, None, None] * step[:, :, None] * step[:, None]
        self.inverse = torch.where(good[:, None, None], update, self.inverse)

    def _direction(self) -> Tensor:
        pressed = ((self.x <= self.low) & (self.gradient > 0)) | (
            (self.x >= self.high) & (self.gradient < 0)
        )
        free = (~pressed).to(self.x.dtype)
        found = -_times(self.inverse, self.gradient * free) * free
        size = found.norm(dim=1, keepdim=True)
        most = torch.where(self.fresh, FIRST, LONGEST).to(size)[:, None]
        return torch.where(size > most, found * most / size, found)
