"""Rows put in order: who was where when, in the file's own units or in SI units."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from nnode.data.sequence import Sequence

#: Samples over which displacements are taken: the noise of single positions is small in them.
LAG = 10


@dataclass(frozen=True)
class Moves:
    """Displacements.

    Attributes:
        first, last: ``(m,)`` rows between which they are.
        size, took: ``(m,)`` their lengths and times.
    """

    first: np.ndarray
    last: np.ndarray
    size: np.ndarray
    took: np.ndarray

    def __len__(self) -> int:
        return len(self.first)


@dataclass(frozen=True)
class Tracks:
    """Rows in the order of agents and, of each, of time; no time twice.

    Attributes:
        agent: ``(n,)`` number of the agent.
        names: by that number.
        time: ``(n,)``.
        x: ``(n, D)``.
        speed: ``(n,)`` that the file tells, at least 0, or None.
        lane: ``(n,)`` number of the lane, or None.
        length: ``(n,)``, NaN where unknown, or None.
        lanes: names of the lanes.
        part: ``(n,)`` number of the recording or sequence that the row is of, or None.
    """

    agent: np.ndarray
    names: list[str]
    time: np.ndarray
    x: np.ndarray
    speed: np.ndarray | None = None
    lane: np.ndarray | None = None
    length: np.ndarray | None = None
    lanes: tuple[str, ...] = ()
    part: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.time)

    @property
    def steps(self) -> np.ndarray:
        """``(m,)`` time between neighbouring rows of one agent."""
        found: np.ndarray = np.diff(self.time)[np.diff(self.agent) == 0]
        return found

    @property
    def dt(self) -> float:
        """The usual one of them; NaN where no agent has two rows."""
        return float(np.median(self.steps)) if self.steps.size else float("nan")

    def moves(self, lag: int = LAG) -> Moves:
        """Displacements over ``lag`` unbroken samples; over fewer where no agent has so many."""
        while lag > 1 and not self._whole(lag).any():
            lag //= 2
        first = np.flatnonzero(self._whole(lag))
        last = first + lag
        size = np.linalg.norm(self.x[last] - self.x[first], axis=1)
        return Moves(first, last, size, self.time[last] - self.time[first])

    def _whole(self, lag: int) -> np.ndarray:
        """Whether ``lag`` steps from a row on are of one agent and as long as usual."""
        if len(self) <= lag:
            return np.zeros(0, dtype=bool)
        took = self.time[lag:] - self.time[:-lag]
        found: np.ndarray = (self.agent[lag:] == self.agent[:-lag]) & (took < 1.5 * lag * self.dt)
        return found

    def scaled(self, metres: float, seconds: float, speed: float) -> Tracks:
        """The same in other units."""
        return replace(
            self,
            time=self.time * seconds,
            x=self.x * metres,
            speed=None if self.speed is None else self.speed * speed,
            length=None if self.length is None else self.length * metres,
        )


def tracks_of(
    agent: np.ndarray,
    time: np.ndarray,
    x: np.ndarray,
    speed: np.ndarray | None = None,
    lane: np.ndarray | None = None,
    length: np.ndarray | None = None,
    part: np.ndarray | None = None,
) -> Tracks:
    """Put rows in order; those without an agent, a time or a position are left out.

    Args:
        agent, lane, part: ``(rows,)`` names.
        time, speed, length: ``(rows,)``.
        x: ``(rows, D)``.
    """
    code, names = pd.factorize(agent)
    there = np.isfinite(time) & np.isfinite(x).all(axis=1) & (code >= 0)
    order = np.flatnonzero(there)
    order = order[np.lexsort((time[order], code[order]))]
    if len(order):
        again = (np.diff(code[order]) == 0) & (np.diff(time[order]) == 0)
        order = order[np.concatenate([[True], ~again])]
    lanes: tuple[str, ...] = ()
    if lane is not None:
        lane, called = pd.factorize(lane)
        lanes = tuple(map(str, called))
    if part is not None:
        part = pd.factorize(part)[0]
    cells = {"speed": speed, "lane": lane, "length": length, "part": part}
    own = {name: None if one is None else one[order] for name, one in cells.items()}
    return Tracks(code[order], list(map(str, names)), time[order], x[order], lanes=lanes, **own)


def tracks_from(sequences: Iterable[Sequence], *, cut: bool) -> Tracks:
    """Sequences that a reader made, as rows: an agent without an identifier is one of its own.

    Args:
        cut: whether positions begin anew in every sequence, so that everyone in it is one's own.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    every = list(sequences)
    for s in every:
        n, k = s.n_agents, s.n_samples
        own = s.agents or tuple(map(str, range(n)))
        whose = s.name if cut or not s.agents else s.recording
        names = np.array([f"{whose} {name}" for name in own], dtype=object)
        v = np.full((k, n), np.nan) if s.v is None else np.linalg.norm(s.v, axis=2)
        long = np.full(n, np.nan) if s.length is None else s.length
        lane = np.full(k * n, s.recording, dtype=object)
        parts.append(
            (
                np.tile(names, k),
                np.repeat(s.time, n),
                s.x.reshape(k * n, -1),
                v.ravel(),
                np.tile(long, k),
                lane,
            )
        )
    agent, time, x, v, long, lane = (np.concatenate(part) for part in zip(*parts, strict=True))
    return tracks_of(
        agent,
        time,
        x,
        None if np.isnan(v).all() else v,
        lane,
        None if np.isnan(long).all() else long,
        lane,
    )
