"""Traffic: whole platoons are simulated behind their measured leader."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import Sequence, collate
from nnode.discover.engine import Ensemble
from nnode.discover.smooth import noise_variance, smooth, velocity
from nnode.discover.whiten import PlatoonFilter
from nnode.models.system import System

#: Longest step of the simulation, s; and where terms own states that may be fast.
STEP, FAST_STEP = 0.25, 0.1
#: Parts of a sequence of this length, s, count as independent.
BLOCK = 10.0
#: Most past samples that a filter looks at.
ORDER = 4


class TrafficEngine:
    """Residuals of platoons; see :class:`~nnode.discover.engine.Engine`.

    Only the leader's path and the start are taken from the measurement, smoothed. Followers are
    simulated behind each other, so that no follower's noise enters the right-hand side.

    Args:
        sequences: at least one, of the same sampling interval.
    """

    def __init__(self, sequences: list[Sequence]) -> None:
        self.sequences = sequences
        self.batch = collate(sequences)
        self.smoothed = collate([_smoothed(sequence) for sequence in sequences])
        leader = self.batch.agent.sum(1) - 1
        index = torch.arange(self.batch.x.shape[2])
        follower = self.batch.agent & (index != leader[:, None])
        self.seen = self.batch.valid & follower
        # the start is given
        self.seen = torch.cat([torch.zeros_like(self.seen[:1]), self.seen[1:]])
        self.filter = PlatoonFilter.none()
        k, b, _ = (axis.numpy() for axis in torch.nonzero(self.seen, as_tuple=True))
        self.sequence = b
        part = (k * self.batch.dt // BLOCK).astype(int)
        # a short rest belongs to the part before it
        last = np.array([max(1, round(s.dt * (s.n_samples - 1) / BLOCK)) - 1 for s in sequences])
        part = np.minimum(part, last[b])
        self.block = np.unique(b * 10_000 + part, return_inverse=True)[1]

    def noise_floor(self) -> float:
        """Mean square error of positions that is noise of the measurement, m²."""
        found = [noise_variance(s.x[:, :-1]) for s in self.sequences if s.n_samples > 4]
        weight = [s.n_samples * (s.n_agents - 1) for s in self.sequences if s.n_samples > 4]
        return float(np.average(found, weights=weight)) if found else float("nan")

    def simulate(self, system: System, rows: Tensor) -> Tensor:
        """``(R, K, B, N)`` positions, m."""
        batch = self.smoothed
        runs = Ensemble(system, rows, system.scene(batch))
        longest = FAST_STEP if any(term.memory for term in system.terms) else STEP
        steps = max(1, math.ceil(batch.dt / longest - 1e-9))
        h = batch.dt / steps
        y = runs.start(batch)
        found = [y[..., 0]]
        for k in range(batch.n_samples - 1):
            for part in range(steps):
                y = runs.runge_kutta(torch.tensor(k * batch.dt + part * h).double(), y, h)
            found.append(y[..., 0])
        return torch.stack(found, 1)

    def deviations(self, system: System, rows: Tensor) -> Tensor:
        """``(R, K, B, N)`` measured minus simulated positions, m; 0 where nothing is compared."""
        with torch.no_grad():
            away = self.batch.x[..., 0] - self.simulate(system, rows)
        return torch.where(self.seen, away, 0.0)

    def residuals(self, system: System, rows: Tensor) -> Tensor:
        """``(R, n)`` whitened residuals."""
        return self.filter(self.deviations(system, rows))[:, self.seen]

    def positions(self, system: System, rows: Tensor) -> Tensor:
        """``(R, n)`` measured minus simulated positions, m."""
        return self.deviations(system, rows)[:, self.seen]

    def settle(self, system: System, row: Tensor) -> None:
        """Fit the filter to the residuals that a model leaves."""
        shortest = min(s.n_samples for s in self.sequences)
        order = min(ORDER, max(0, (shortest - 2) // 3))
        away = self.deviations(system, row[None])[0]
        self.filter = PlatoonFilter.fitted(away, self.seen, order)


def _smoothed(sequence: Sequence) -> Sequence:
    x = smooth(sequence.x)
    return replace(sequence, x=x, v=velocity(x, sequence.dt) if len(x) > 1 else None)
