"""Traffic: whole platoons are simulated behind their measured leader."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from nnode.data.sequence import Sequence, collate
from nnode.discover.engine import Ensemble, Squares, trained
from nnode.discover.smooth import noise_variance, smooth, velocity
from nnode.discover.traffic_variables import traffic_variables
from nnode.discover.variables import Variable
from nnode.discover.whiten import PlatoonFilter
from nnode.models.effects import Effect, Strength
from nnode.models.extend import extended
from nnode.models.system import System
from nnode.models.term import State, Term

#: Longest step of the simulation, s; and relative to the shortest time constant of the states
#: that terms own, for which Runge and Kutta's method is stable.
STEP, STABLE = 0.4, 0.7
#: Change of a vehicle's pace by which its derivative is computed.
_PACE = 1e-3
#: Sequences are simulated in windows of about this length, s.
WINDOW = 10.0
#: Whitened residuals beyond this count less.
LARGE = 6.0
#: Most past samples that a filter looks at.
ORDER = 4


class TrafficEngine:
    """Residuals of platoons; see :class:`~nnode.discover.engine.Engine`.

    Only the leader's path and the starts are taken from the measurement, smoothed. Followers are
    simulated behind each other, so that no follower's noise enters the right-hand side. A law of
    following forgets its start within some seconds: windows keep the simulated paths near the
    measured ones, also where the model is quite wrong, and lose little.

    Args:
        sequences: at least one, of the same sampling interval.
        window: length of a window, s; infinite simulates whole sequences.

    Attributes:
        unit: ``(n,)`` agents whose own numbers are estimated together: those of a sequence.
        people: of each unit, per direction the sequence and the place of its agent.
        half: ``(n,)`` 0 or 1: the two halves of a sequence's time.
    """

    def __init__(self, sequences: list[Sequence], window: float = WINDOW) -> None:
        self.sequences = sequences
        self.names = [sequence.name for sequence in sequences]
        parts = [_windows(sequence, window) for sequence in sequences]
        self.batch = collate(part for each in parts for part in each)
        smoothed = [_windows(_smoothed(sequence), window) for sequence in sequences]
        self.smoothed = collate(part for each in smoothed for part in each)
        owner = np.repeat(np.arange(len(parts)), [len(each) for each in parts])
        leader = self.batch.agent.sum(1) - 1
        index = torch.arange(self.batch.x.shape[2])
        follower = self.batch.agent & (index != leader[:, None])
        self.seen = self.batch.valid & follower
        # the start is given
        self.seen = torch.cat([torch.zeros_like(self.seen[:1]), self.seen[1:]])
        self.filter = PlatoonFilter.none()
        k, b, _ = (axis.numpy() for axis in torch.nonzero(self.seen, as_tuple=True))
        self.block, self.sequence = b, owner[b]
        middle = np.array([(s.time[0] + s.time[-1]) / 2 for s in sequences])
        clock = self.batch.start.numpy()[b] + k * self.batch.dt
        self.half = (clock > middle[self.sequence] + 1e-6).astype(int)
        self.unit = self.sequence
        self.people = [
            [(i, n) for n in range(self.batch.agent.shape[1])] for i in range(len(sequences))
        ]

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
        """``(R, n)`` whitened residuals, the largest drawn in."""
        return drawn_in(self.filter(self.deviations(system, rows))[:, self.seen])

    def squares(self, system: System, row: Tensor) -> Squares:
        """Squared errors of the followers' positions."""
        away = self.deviations(system, row[None])[0][self.seen].numpy()
        return Squares(away**2, self.sequence, self.half)

    def variables(self) -> list[Variable]:
        """What deviations of vehicles may depend on."""
        return traffic_variables(self.smoothed)

    def individual(
        self, system: System, row: Tensor, effect: type[Effect], options: dict[str, Any]
    ) -> Tensor:
        """``(N, n)``: derivatives of the residuals with respect to the pace of the vehicle at
        each place of the platoon, in all sequences at once."""
        places = self.batch.agent.shape[1]
        pace, _ = extended(system, _Pace(places))
        own = trained(pace)
        base = torch.zeros(1 + places, sum(p.numel() for p in own.values()), dtype=torch.float64)
        column, before = 0, 0
        for name, p in own.items():
            if name.endswith(".pace"):
                base[1:, column : column + places] = _PACE * torch.eye(places, dtype=torch.float64)
            else:
                base[:, column] = row[before]
                before += 1
            column += p.numel()
        found = self.residuals(pace, base)
        return (found[1:] - found[0]) / _PACE

    def settle(self, system: System, row: Tensor) -> None:
        """Fit the filter to the residuals that a model leaves."""
        shortest = int(self.batch.valid.any(-1).sum(0).min())
        order = min(ORDER, max(0, (shortest - 2) // 3))
        away = self.deviations(system, row[None])[0]
        self.filter = PlatoonFilter.fitted(away, self.seen, order)


class _Pace(Effect):
    """The vehicle at each place of the platoon drives slower or faster by a share of its own."""

    name = "pace"
    domain = "traffic"
    strengths: ClassVar[dict[str, Strength]] = {}
    rank = 13

    def __init__(self, places: int) -> None:
        super().__init__()
        self.pace = nn.Parameter(torch.zeros(places, dtype=torch.float64))

    def forward(self, state: State) -> Tensor:
        assert state.rate is not None
        change = torch.where(state.scene.follower, self.pace, 0.0)
        return change[..., None] * state.rate


def drawn_in(residual: Tensor) -> Tensor:
    """Residuals whose squares are Huber's loss: a vehicle that breaks down does not outweigh
    all others.

    Source: Huber 1964.
    """
    size = residual.abs()
    large = torch.sqrt((2 * LARGE * size - LARGE**2).clamp(min=0)).copysign(residual)
    return torch.where(size <= LARGE, residual, large)


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


def _windows(sequence: Sequence, length: float) -> list[Sequence]:
    """Windows of equal length that share their boundary sample."""
    intervals = sequence.n_samples - 1
    number = max(1, round(intervals * sequence.dt / length)) if intervals else 1
    ends = np.linspace(0, intervals, number + 1).round().astype(int)
    return [
        replace(
            sequence,
            time=sequence.time[first : last + 1],
            x=sequence.x[first : last + 1],
            v=None if sequence.v is None else sequence.v[first : last + 1],
        )
        for first, last in pairwise(ends)
    ]


def _smoothed(sequence: Sequence) -> Sequence:
    x = smooth(sequence.x)
    return replace(sequence, x=x, v=velocity(x, sequence.dt) if len(x) > 1 else None)
