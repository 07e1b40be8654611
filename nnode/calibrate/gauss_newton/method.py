"""Gauss and Newton's method on exact tangents: lanes whose model is a formula.

One simulation gives the states and their derivatives by all parameters, and with them the cost,
its gradient and the curvature, for every sequence by itself: pooled calibrations add those up,
calibrations of every sequence alone do not, and the spread between clusters tells how sure the
pooled ones are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.cost import FOLLOWING, Convention, changed_gap, errors, net_gaps
from nnode.calibrate.least_squares import DAMPING, EASE, STIFFEN, STUCK, box_step, damped_step
from nnode.calibrate.problem import Problem
from nnode.errors import ConfigError, SimulationError
from nnode.model.system import System, Traffic
from nnode.model.term import Interval
from nnode.simulate.base import simulated_batch, substeps
from nnode.simulate.kernels import lanes

#: Share of the cost below which a fall is rounding.
_ROUNDING = 1e-14
#: A direction is flat where the scaled curvature is this share of the largest one: the errors of
#: its derivatives, 1e-9 and less, leave nothing of it.
_FLAT = 1e-10
#: Share of a parameter's unit vector in flat directions, which is 0 but for rounding, at most 1e-5.
_PART = 1e-3


@dataclass(frozen=True)
class Curved:
    """Costs of B sequences and their derivatives by P parameters.

    Attributes:
        cost: ``(B,)``; inf where a simulation blows up.
        gradient: ``(B, P)``.
        hessian: ``(B, P, P)`` Gauss and Newton's.
    """

    cost: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray


class TangentCost(Problem):
    """Cost of every sequence of a batch with its derivatives, from one simulation.

    Attributes:
        names: symbols of the parameters that are calibrated.
        start, low, high: ``(P,)`` the system's own values, and the admissible set.

    Raises:
        ConfigError: the model is no formula of a lane.
    """

    system: Traffic  # of no other there is a lane's formula

    def __post_init__(self) -> None:
        super().__post_init__()
        system = self.system
        self._places = {s: at for s, at in self._owned().items() if at[0] in self._own}
        self.names = list(self._places)
        limits, free = system.bounds(), Interval()
        bounds = [limits.get(name, free) for name, _, _ in self._places.values()]
        self.low = np.array([b.low for b in bounds])
        self.high = np.array([b.high for b in bounds])
        self.start = np.clip(self.row(system), self.low, self.high)

    def _owned(self) -> dict[str, Any]:
        """Symbols of the formula's parameters to where they are in the model."""
        lane = lanes.supports(self.system, self.batch)
        if lane is None:
            raise ConfigError(
                "optimizer=gauss_newton needs a model of a lane whose law and effects are "
                "formulas; take another optimizer, or "
                "nnode.calibrate.least_squares, which takes differences"
            )
        self.lane = lane
        return lane.owned

    def row(self, system: System) -> np.ndarray:
        """``(P,)`` the parameters of a system of the same model."""
        own = {name: p.detach().double().flatten() for name, p in system.named_parameters()}
        return np.array([float(own[name][place]) for name, place, _ in self._places.values()])

    @torch.no_grad()
    def fill_(self, system: System, row: np.ndarray) -> System:
        """Write one row ``(P,)`` into a system of the same model."""
        own = dict(system.named_parameters())
        for value, (name, place, _) in zip(row, self._places.values(), strict=True):
            own[name].view(-1)[place] = float(value)
        return system

    def begin(self, row: np.ndarray) -> np.ndarray:
        """A better start of a minimisation, if there is one."""
        return row

    def starts(self, rows: np.ndarray) -> dict[str, list[float]]:
        """First speeds (m/s) that were fitted, by sequence and vehicle; none here."""
        return {}

    def physical(self, name: str) -> bool:
        """Whether a symbol is that of a parameter with a physical meaning, no weight."""
        return self._places[name][2] is None

    def complain(self, cost: np.ndarray) -> None:
        """Say which sequences cannot be simulated.

        Raises:
            SimulationError: always.
        """
        bad = [name for name, c in zip(self.batch.names, cost, strict=True) if not np.isfinite(c)]
        raise SimulationError(
            f"the simulation of {', '.join(bad[:5])} blew up; check the sequences, start from "
            "other parameters, or take a smaller solver.dt"
        )

    def costs(self, rows: np.ndarray) -> np.ndarray:
        """``(B,)`` costs for parameters ``(P,)``, or for those of every sequence ``(B, P)``."""
        x, v, _, _ = self._simulated(rows, ())
        return self._cost(*self._errors(x, v)).numpy()

    def __call__(self, rows: np.ndarray) -> Curved:
        """Costs and their derivatives, of parameters ``(P,)`` or ``(B, P)``."""
        return self._curved(*self._slopes(rows))

    def _slopes(self, rows: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Errors, which count, and their derivatives ``(P, ...)``."""
        x, v, dx, dv = self._simulated(rows, tuple(self.names))
        away, seen = self._errors(x, v)
        if self.convention not in FOLLOWING:
            slope = torch.where(seen, dx, 0.0)
        elif self.convention is Convention.speed:
            assert dv is not None
            slope = torch.where(seen, dv[..., :-1], 0.0)
        else:
            gap, measured = (net_gaps(p, self.batch) for p in (x, self.batch.x[..., 0]))
            with torch.enable_grad():
                own = gap.detach().requires_grad_()
                change = changed_gap(own, measured, self.convention)
                (factor,) = torch.autograd.grad(change.sum(), own)
            slope = torch.where(seen, torch.diff(dx) * factor, 0.0)
        return away.double(), seen, slope.double()

    def _curved(self, away: Tensor, seen: Tensor, slope: Tensor) -> Curved:
        number = seen.sum((0, -1)).clamp(min=1).double()
        pull = torch.einsum("kbn,pkbn->bp", away, slope)
        bend = torch.einsum("pkbn,qkbn->bpq", slope, slope)
        cost = self._cost(away, seen)
        match self.convention:
            case Convention.integral | Convention.sum:
                scale = torch.full_like(cost, self._weight)
            case Convention.spacing:
                scale = 1 / (number * cost.clamp(min=1e-12))
            case _:
                scale = 2 / number
        found = pull * scale[:, None], bend * scale[:, None, None]
        blown = ~torch.isfinite(cost)
        return Curved(cost.numpy(), *(_none(part, blown).numpy() for part in found))

    def _errors(self, x: Tensor, v: Tensor | None) -> tuple[Tensor, Tensor]:
        """``(K, B, N)`` errors of places, or ``(K, B, N - 1)`` of followers, and which count."""
        if self.convention in FOLLOWING:
            return errors(x, v, self.batch, self.convention)
        seen = self.batch.valid
        return torch.where(seen, x - self.batch.x[..., 0], 0.0), seen

    @property
    def _weight(self) -> float:
        return self.batch.dt if self.convention is Convention.integral else 1.0

    def _cost(self, away: Tensor, seen: Tensor) -> Tensor:
        total = away.double().square().sum((0, -1))
        if self.convention not in FOLLOWING:
            return self._finite(0.5 * self._weight * total)
        mean = total / seen.sum((0, -1)).clamp(min=1)
        return self._finite(mean.sqrt() if self.convention is Convention.spacing else mean)

    @staticmethod
    def _finite(cost: Tensor) -> Tensor:
        return torch.where(torch.isfinite(cost), cost, math.inf)

    def _simulated(
        self, rows: np.ndarray, names: Sequence[str]
    ) -> tuple[Tensor, Tensor | None, Tensor, Tensor | None]:
        batch, solver = self.batch, self.solver
        n = substeps(batch.dt, solver.dt, self.system)
        each = torch.from_numpy(np.atleast_2d(rows))
        near, origin = simulated_batch(self.system, batch)
        y, dy = lanes.tangents(
            self.system, self.lane, near, n, names, solver.threads, each, solver.method,
            given=self.names,
        )  # fmt: skip
        x = y[..., 0] if origin is None else y[..., 0].double() + origin
        if self.system.leader == "measured":
            lead = torch.arange(x.shape[-1]) == (batch.agent.sum(1) - 1)[:, None]
            x = torch.where(lead, batch.x[..., 0], x)
        second = self.lane.order > 1
        return x, y[..., 1] if second else None, dy[..., 0], dy[..., 1] if second else None


def _none(part: Tensor, blown: Tensor) -> Tensor:
    return torch.where(blown.reshape(-1, *[1] * (part.ndim - 1)), 0.0, part)


@dataclass(frozen=True)
class Fit:
    """Where a calibration ended.

    Attributes:
        row: ``(P,)`` or ``(B, P)`` parameters.
        cost: the weighted cost, or ``(B,)`` those of every sequence.
        steps: simulations with tangents.
        damping: of the next step.
    """

    row: np.ndarray
    cost: float | np.ndarray
    steps: int
    damping: float | np.ndarray


def pooled(
    cost: TangentCost, start: np.ndarray | None = None, weights: np.ndarray | None = None, *,
    steps: int = 100, tolerance: float = 1e-10, damping: float = DAMPING,
    penalty: tuple[np.ndarray, np.ndarray] | None = None,
) -> Fit:  # fmt: skip
    """The parameters that are best for all sequences together.

    Args:
        weights: ``(B,)`` of sum 1; None takes the mean.
        tolerance: ends when a step lowers the cost by less than this share.
        penalty: centre and weights ``(P,)`` of a sum of squares that is added.
    """
    share = np.full(len(cost.batch), 1 / len(cost.batch)) if weights is None else weights
    row = np.clip(cost.start if start is None else start, cost.low, cost.high)
    used = share > 0

    def total(values: np.ndarray, at: np.ndarray) -> float:
        found = float(share[used] @ values[used])
        return found + (0.0 if penalty is None else float(penalty[1] @ (at - penalty[0]) ** 2))

    now, number = math.inf, 0
    for _ in range(steps):
        curved = cost(row)
        number += 1
        now = total(curved.cost, row)
        gradient = np.einsum("b,bp->p", share, curved.gradient)
        hessian = np.einsum("b,bpq->pq", share, curved.hessian)
        if penalty is not None:
            gradient = gradient + 2 * penalty[1] * (row - penalty[0])
            hessian = hessian + 2 * np.diag(penalty[1])
        before = now
        row, now, damping = damped_step(
            lambda trial: total(cost.costs(trial), trial),
            now, row, gradient, hessian, damping, cost.low, cost.high,
        )  # fmt: skip
        if not before - now > max(tolerance, _ROUNDING) * now:
            break
    return Fit(row, now, number, damping)


def alone(
    cost: TangentCost, start: np.ndarray | None = None, *, steps: int = 100,
    tolerance: float = 1e-8, pool: tuple[np.ndarray, np.ndarray] | None = None,
) -> Fit:  # fmt: skip
    """The parameters that are best for every sequence by itself, all of them side by side.

    Args:
        start: ``(P,)`` or ``(B, P)``.
        pool: centre and ``(P,)`` weights of a sum of squares that is added: shrinkage towards
            the centre.
    """
    number = len(cost.batch)
    rows = np.clip(cost.start if start is None else start, cost.low, cost.high)
    rows = np.array(np.broadcast_to(rows, (number, len(cost.names))))
    damping = np.full(number, DAMPING)
    going = np.ones(number, dtype=bool)

    def total(values: np.ndarray, at: np.ndarray) -> np.ndarray:
        return values if pool is None else values + ((at - pool[0]) ** 2) @ pool[1]

    now, taken = np.full(number, math.inf), 0
    for _ in range(steps):
        curved = cost(rows)
        taken += 1
        now = total(curved.cost, rows)
        trial = rows.copy()
        for b in np.flatnonzero(going):
            gradient, hessian = curved.gradient[b], curved.hessian[b]
            if pool is not None:
                gradient = gradient + 2 * pool[1] * (rows[b] - pool[0])
                hessian = hessian + 2 * np.diag(pool[1])
            trial[b] = box_step(rows[b], gradient, hessian, damping[b], cost.low, cost.high)
        value = total(cost.costs(trial), trial)
        better = going & (value < now)
        rows[better] = trial[better]
        done = better & (now - value <= tolerance * np.abs(now))
        damping = np.where(better, np.maximum(damping * EASE, 1e-9), damping * STIFFEN)
        now = np.where(better, value, now)
        going &= ~done & (damping < STUCK)
        if not going.any():
            break
    return Fit(rows, now, taken, damping)


def sandwich(
    curved: Curved, weights: np.ndarray, cluster: np.ndarray, free: np.ndarray
) -> np.ndarray:
    """``(P, P)`` covariance of pooled parameters, from how gradients differ between clusters.

    Args:
        curved: at the minimum.
        weights: ``(B,)`` of sum 1.
        cluster: ``(B,)`` which cluster a sequence belongs to.
        free: ``(P,)`` True for parameters that are at no bound; others do not vary.

    Returns:
        The variance is infinite of a parameter that the cost does not depend on, alone or together
        with others.

    Source:
        Liang & Zeger 1986, with the factor G / (G - 1) for G clusters.
    """
    number = len(free)
    found = np.zeros((number, number))
    names = np.unique(cluster)
    if len(names) < 2 or not free.any():
        return np.where(np.eye(number, dtype=bool) & free, math.inf, found)
    hessian = np.einsum("b,bpq->pq", weights, curved.hessian)[np.ix_(free, free)]
    scores = np.stack([(weights[:, None] * curved.gradient)[cluster == g].sum(0) for g in names])[
        :, free
    ]
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    kept = values > _FLAT * values.max()
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    bread = inverse / np.outer(scale, scale)
    meat = scores.T @ scores * len(names) / (len(names) - 1)
    found[np.ix_(free, free)] = bread @ meat @ bread
    flat = np.flatnonzero(free)[(vectors[:, ~kept] ** 2).sum(1) > _PART]
    found[flat, flat] = math.inf
    return found
