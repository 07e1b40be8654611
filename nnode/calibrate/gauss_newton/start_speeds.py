"""First speeds of noisy data as a nuisance: fitted with the parameters, sequence by sequence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.cost import Convention
from nnode.calibrate.gauss_newton.crowd import CrowdCost
from nnode.calibrate.gauss_newton.method import Curved, TangentCost
from nnode.calibrate.least_squares import DAMPING, EASE, STIFFEN, STUCK
from nnode.calibrate.options import StartSpeeds
from nnode.data.sequence import Batch
from nnode.errors import ConfigError
from nnode.model.system import System
from nnode.simulate.fused import FusedSolver

#: First speeds: steps at most, the share of the cost below which a fall ends them, and the
#: difference by which their derivatives are taken, m/s.
_TURNS, _SETTLED, _DIFFERENCE = 10, 1e-12, 1e-5


class StartSpeedCost(TangentCost):
    """A cost whose first speeds are fitted, to each sequence for any parameters (profiled out).

    They are those of all vehicles that the model drives, at least 0. Derivatives by them are
    differences; gradient and curvature are those of the least cost over them: of Gauss and Newton's
    curvature the Schur complement.

    Attributes:
        fitted: ``(B, N)`` True where a first speed is fitted.

    Raises:
        ConfigError: as of the base class; or a law of first order, which has no speeds to start
            with.

    Source:
        Golub & Pereyra 2003, variable projection; Murphy & van der Vaart 2000, profile likelihood.
    """

    def __post_init__(self) -> None:
        batch = self.batch = replace(self.batch, v=self.batch.v.clone())
        super().__post_init__()
        if self.lane.order < 2:
            raise ConfigError(
                "trainer.start_speeds=fitted needs a law of second order: one of first order has "
                "no speed to start with; take trainer.start_speeds=given"
            )
        lead = torch.arange(batch.agent.shape[1]) == (batch.agent.sum(1) - 1)[:, None]
        self.fitted = batch.agent & ~lead if self.system.leader == "measured" else batch.agent
        self._given = batch.v[0].clone()

    def costs(self, rows: np.ndarray) -> np.ndarray:
        """As of the base class, at the best first speeds."""
        before = self.batch.v[0].clone()
        found, _ = self._settled(rows)
        self.batch.v[0] = before
        return found

    def starts(self, rows: np.ndarray) -> dict[str, list[float]]:
        """First speeds (m/s) that are best for parameters, by sequence and vehicle."""
        self._settled(rows)
        agents = self.batch.agent.sum(1).tolist()
        found = self.batch.v[0, ..., 0].tolist()
        names = self.batch.names
        return {name: v[:n] for name, v, n in zip(names, found, agents, strict=True)}

    def __call__(self, rows: np.ndarray) -> Curved:
        _, by_start = self._settled(rows)
        away, seen, slope = self._slopes(rows)
        number = slope.shape[0]
        both = self._curved(away, seen, torch.cat([slope, by_start]))
        bend, pull = both.hessian, both.gradient
        own = self._inverse(bend[:, number:, number:])
        across = np.einsum("bpj,bjk->bpk", bend[:, :number, number:], own)
        return Curved(
            both.cost,
            pull[:, :number] - np.einsum("bpk,bk->bp", across, pull[:, number:]),
            bend[:, :number, :number]
            - np.einsum("bpk,bkq->bpq", across, bend[:, number:, :number]),
        )

    def _settled(self, rows: np.ndarray) -> tuple[np.ndarray, Tensor]:
        """Move first speeds to the best ones; costs ``(B,)``, and derivatives of errors by them.

        Each sequence begins from the better of the last ones and of those that were given: speeds
        that other parameters asked for may be far from the best, where no step helps. A step that
        does not lower the cost is tried again with more damping.
        """
        start = self.batch.v[0]  # changed in place
        last = start.clone()
        start.copy_(self._given)
        x, v, _, _ = self._simulated(rows, ())
        given, seen = self._errors(x, v)
        start.copy_(last)
        x, v, _, _ = self._simulated(rows, ())
        away, _ = self._errors(x, v)
        now, before = self._cost(away, seen), self._cost(given, seen)
        better = before < now
        start.copy_(torch.where(better[:, None, None], self._given, start))
        away = torch.where(better[:, None], given, away)
        now = torch.where(better, before, now)
        going = torch.ones(len(now), dtype=torch.bool)
        damping = torch.full((len(now),), DAMPING, dtype=torch.float64)
        for turn in range(_TURNS + 1):
            by_start = self._by_start(rows, away)
            if turn == _TURNS or not going.any():
                break
            found = self._curved(away.double(), seen, by_start)
            own = np.einsum("bjj->bj", found.hessian) * damping.numpy()[:, None]
            stiff = found.hessian + own[:, :, None] * np.eye(own.shape[1])
            step = -np.einsum("bjk,bk->bj", self._inverse(stiff), found.gradient)
            before = start.clone()
            moved = torch.from_numpy(step)[..., None].to(start) * self.fitted[..., None]
            start += torch.where(going[:, None, None], moved, 0.0)
            start.clamp_(min=0.0).copy_(torch.where(self.fitted[..., None], start, before))
            x, v, _, _ = self._simulated(rows, ())
            new, _ = self._errors(x, v)
            value = self._cost(new, seen)
            worse = ~(value < now)
            start.copy_(torch.where(worse[:, None, None], before, start))
            away = torch.where(worse[:, None], away, new)
            damping = torch.where(worse, damping * STIFFEN, damping * EASE)
            going &= torch.where(worse, damping < STUCK, now - value > _SETTLED * now)
            now = torch.where(worse, now, value)
        return now.numpy(), by_start

    def _by_start(self, rows: np.ndarray, away: Tensor) -> Tensor:
        """``(N, K, B, ...)`` slopes of errors by the first speed of every vehicle."""
        start, found = self.batch.v[0], []
        for i in range(start.shape[1]):
            before = start[:, i].clone()
            start[:, i] += _DIFFERENCE * self.fitted[:, i, None]
            x, v, _, _ = self._simulated(rows, ())
            start[:, i] = before
            found.append((self._errors(x, v)[0] - away).double() / _DIFFERENCE)
        return torch.nan_to_num(torch.stack(found))

    def _inverse(self, bend: np.ndarray) -> np.ndarray:
        """Of the curvature by first speeds; 0 for those that nothing depends on."""
        return np.linalg.pinv(bend, rcond=1e-10, hermitian=True)


def cost_of(
    starts: StartSpeeds, system: System, batch: Batch, solver: FusedSolver, convention: Convention
) -> TangentCost:
    """The cost by ``trainer.start_speeds``, of a lane or of people.

    Raises:
        ConfigError: a model without exact tangents, or people whose first speeds are to be fitted.
    """
    if system.domain == "crowd":
        if starts is StartSpeeds.fitted:
            raise ConfigError(
                "trainer.start_speeds=fitted is for vehicles in lanes; take "
                "trainer.start_speeds=given for people"
            )
        return CrowdCost(system, batch, solver, convention)
    kind = StartSpeedCost if starts is StartSpeeds.fitted else TangentCost
    return kind(system, batch, solver, convention)
