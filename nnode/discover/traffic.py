"""Traffic: whole platoons are simulated behind their measured leader."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from nnode.data.sequence import Sequence, collate
from nnode.discover.engine import Ensemble, trained
from nnode.discover.smooth import noise_variance, smooth, velocity
from nnode.discover.whiten import PlatoonFilter
from nnode.models.system import System
from nnode.models.term import Term

#: Longest step of the simulation, s; and relative to the shortest time constant of the states
#: that terms own, for which Runge and Kutta's method is stable.
STEP, STABLE = 0.4, 0.7
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
        longest = min(STEP, STABLE * fastest(system, rows))
        # several samples in a step, or several steps in a sample
        stride = max(1, math.floor(longest / batch.dt + 1e-9))
        steps = max(1, math.ceil(batch.dt / longest - 1e-9))
        h = batch.dt * stride / steps
        y = runs.start(batch)
        rate, found = runs.rate(_time(0.0), y), [y[..., 0]]
        number = math.ceil((batch.n_samples - 1) / stride) * steps
        for step in range(number):
            t = step * h
            after = runs.runge_kutta(_time(t), y, h, rate)
            slope = runs.rate(_time(t + h), after)
            found += _between(y, rate, after, slope, h, stride)
            if (step + 1) % steps == 0:
                found.append(after[..., 0])
            y, rate = after, slope
        return torch.stack(found[: batch.n_samples], 1)

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


def fastest(system: System, rows: Tensor) -> float:
    """The shortest time constant of the states that terms own, s; infinite where none do."""
    names = [name for name, p in trained(system).items() for _ in range(p.numel())]
    wanted = {f"terms.{i}.{name}" for i, term in enumerate(system.terms) for name in _fast(term)}
    found = [float(rows[:, j].min()) for j, name in enumerate(names) if name in wanted]
    return min(found, default=math.inf)


def _fast(term: nn.Module) -> tuple[str, ...]:
    assert isinstance(term, Term)
    return term.fast


def _time(t: float) -> Tensor:
    return torch.tensor(t, dtype=torch.float64)


def _between(
    before: Tensor, start: Tensor, after: Tensor, end: Tensor, h: float, stride: int
) -> list[Tensor]:
    """Positions at the samples within a step of ``h`` s, by Hermite's cubic interpolation."""
    x0, v0, x1, v1 = (part[..., 0] for part in (before, start, after, end))
    found = []
    for part in range(1, stride):
        s = part / stride
        away = h * (s * (1 - s) ** 2 * v0 - s**2 * (1 - s) * v1)
        found.append((1 + 2 * s) * (1 - s) ** 2 * x0 + s**2 * (3 - 2 * s) * x1 + away)
    return found


def _smoothed(sequence: Sequence) -> Sequence:
    x = smooth(sequence.x)
    return replace(sequence, x=x, v=velocity(x, sequence.dt) if len(x) > 1 else None)
