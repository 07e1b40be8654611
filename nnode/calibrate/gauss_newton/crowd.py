"""Gauss and Newton's method for people: derivatives of compiled simulations by differences."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.cost import FOLLOWING
from nnode.calibrate.gauss_newton.method import TangentCost, pooled
from nnode.errors import ConfigError
from nnode.model.system import Crowd, System

#: Relative size of a difference: the cube root of float64's precision, where the error of central
#: differences by rounding and that by curvature are equal (Press et al. 2007, section 5.7).
_DIFFERENCE = float(np.finfo(np.float64).eps) ** (1 / 3)
#: Parameters smaller than this are varied as if they had this size, in their own units.
_LEAST = 0.01
#: Samples of the first horizon, and steps at most at each horizon before it doubles.
_FIRST, _SHORT = 4, 8


class CrowdCost(TangentCost):
    """Cost of every sequence of a batch of people with its derivatives.

    A compiled simulation of people has an exact gradient, but no exact derivatives of each
    position. Central differences of second order stand in for them. They are in float64, whatever
    the precision of the training, and stay inside the admissible set. Compared with forward-mode
    derivatives by PyTorch, the gradient of ``model=sf`` agrees to nine digits in a fortieth of the
    time.

    Raises:
        ConfigError: a network among the terms, terms that are code, or a cost of vehicles.
    """

    def _owned(self) -> dict[str, Any]:
        system: System = self.system
        law = system.formula if isinstance(system, Crowd) else None
        if law is None or any(axes is not None for _, _, axes in law.owned.values()):
            raise ConfigError(
                "optimizer=gauss_newton needs a model of people whose terms are formulas without "
                "networks, as model=sf; take another optimizer"
            )
        if self.convention in FOLLOWING:
            raise ConfigError(
                f"trainer.cost={self.convention.value} is one of vehicles that follow another; "
                "take integral or sum for people"
            )
        self._double, self.batch = (
            copy.deepcopy(system).double(),
            self.batch.to(None, torch.float64),
        )
        return law.owned

    def _errors(self, x: Tensor, v: Tensor | None) -> tuple[Tensor, Tensor]:
        """``(K, B, N D)`` errors of both coordinates, and which count."""
        seen = self.batch.valid.repeat_interleave(self.system.dim, -1)
        return torch.where(seen, x - self.batch.x.flatten(-2), 0.0), seen

    def _simulated(
        self, rows: np.ndarray, names: Sequence[str]
    ) -> tuple[Tensor, Tensor | None, Tensor, Tensor | None]:
        """Positions ``(K, B, N D)`` and their derivatives ``(P, K, B, N D)``."""
        x = self._positions(rows)
        slopes = [self._slope(rows, x, self.names.index(name)) for name in names]
        return x, None, torch.stack(slopes) if slopes else x.new_zeros(0), None

    @torch.no_grad()
    def _positions(self, row: np.ndarray) -> Tensor:
        system = self.fill_(self._double, row)
        return self.solver.unchecked(system, self.batch).x.flatten(-2)

    def _slope(self, row: np.ndarray, x: Tensor, i: int) -> Tensor:
        """``(K, B, N D)`` derivative by the i-th parameter; 0 where a simulation blows up."""
        step = _DIFFERENCE * max(abs(row[i]), _LEAST)

        def at(number: int) -> Tensor:
            other = row.copy()
            other[i] += number * step
            return self._positions(other)

        if row[i] - step < self.low[i]:
            change = 4 * at(1) - at(2) - 3 * x
        elif row[i] + step > self.high[i]:
            change = 3 * x - 4 * at(-1) + at(-2)
        else:
            change = at(1) - at(-1)
        return torch.nan_to_num(change / (2 * step), posinf=0.0, neginf=0.0)

    def begin(self, row: np.ndarray) -> np.ndarray:
        """A better start: minima of the first samples of every sequence, which are followed as the
        horizon doubles.

        Over a second, strong forces throw people metres away, and the cost has many minima. Over
        few samples nearly every start leads to the same one.
        """
        found, samples = row, _FIRST
        while samples < self.batch.n_samples:
            batch = replace(self.batch, **{k: getattr(self.batch, k)[:samples] for k in _TIMED})
            cost = CrowdCost(self._double, batch, self.solver, self.convention)
            if np.isfinite(cost.costs(found)).all():
                found = pooled(cost, found, steps=_SHORT).row
            samples *= 2
        before, after = (float(self.costs(one).mean()) for one in (row, found))
        return found if after < before else row


#: Fields of a batch with an axis of samples.
_TIMED = ("x", "v", "valid")
