"""Trajectories as a table, one row per agent and time, and agents' records at equal times.

A reader makes :class:`Trajectories` of a file's columns, in SI units. :func:`records` makes them
equally spaced: short holes are filled, long ones end a record, uneven times are interpolated.
:mod:`nnode.data.cut` makes sequences of records.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid

from nnode.data.identity import LATEST, given_anew, numbered
from nnode.data.limits import HOLE, UNEVEN
from nnode.data.options import positive
from nnode.data.smooth import across, smooth_columns
from nnode.errors import DataError

log = logging.getLogger(__name__)


def group_numbers(*columns: np.ndarray | None) -> np.ndarray:
    """``(R,)`` number of the combination of cells in each row, in order of first appearance; None
    is no column."""
    frame = pd.DataFrame({i: column for i, column in enumerate(columns) if column is not None})
    return np.asarray(frame.groupby(list(frame), sort=False).ngroup())


def grouped_rows(*columns: np.ndarray | None, time: np.ndarray | None = None) -> list[np.ndarray]:
    """Rows of each combination of cells, in order of first appearance.

    Args:
        time: ``(R,)`` the order of the rows of a combination; None: as they stand.
    """
    number = group_numbers(*columns)
    order = np.argsort(number, kind="stable") if time is None else np.lexsort((time, number))
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1)


@dataclass(frozen=True, kw_only=True)
class Trajectories:
    """R rows in any order, in SI units, of one recording or of several.

    What belongs to an agent (``length``, ``kind``, ``group``, ``destination``) is taken from the
    first row of its record.

    Attributes:
        path: of the file, for messages.
        name: of the recording, where there is no column of it.
        where: in words, where row i stands in the file.
        agent: ``(R,)`` identifiers, text.
        time: ``(R,)`` s.
        x: ``(R, D)`` m, along the lane (growing as vehicles drive on) or in the plane; NaN where
            a sample is missing.
        v: ``(R, D)`` m/s, or ``(R, 1)`` of speeds whose direction is unknown; NaN where a sample is
            missing; or None.
        recording: ``(R,)`` names, or None: all rows are of one.
        sequence: ``(R,)`` names of the sequences or pairs that the source is cut into, or None.
        lane: ``(R,)`` names, or None: there is one.
        length: ``(R,)`` m, NaN where unknown, or None.
        kind, group, split: ``(R,)`` names, or None.
        destination: ``(R, D)`` m, or None.
        spacing: ``(R,)`` m from bumper to bumper to the vehicle in front, NaN where unknown, or
            None.
    """

    path: Path
    name: str
    where: Callable[[int], str]
    agent: np.ndarray
    time: np.ndarray
    x: np.ndarray
    v: np.ndarray | None = None
    recording: np.ndarray | None = None
    sequence: np.ndarray | None = None
    lane: np.ndarray | None = None
    length: np.ndarray | None = None
    kind: np.ndarray | None = None
    group: np.ndarray | None = None
    split: np.ndarray | None = None
    destination: np.ndarray | None = None
    spacing: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.time)

    def at(self, rows: np.ndarray) -> Trajectories:
        """Some of the rows, by number."""
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        chosen: dict[str, Any] = {
            name: column[rows] for name, column in columns.items() if isinstance(column, np.ndarray)
        }
        return replace(self, where=lambda i: self.where(int(rows[i])), **chosen)

    @cached_property
    def steps(self) -> np.ndarray:
        """``(S,)`` s from each row of an agent to its next one in time."""
        agents = grouped_rows(self.recording, self.sequence, self.agent, time=self.time)
        return np.concatenate([np.diff(self.time[rows]) for rows in agents])

    @cached_property
    def dt(self) -> float:
        """The sampling interval (s) of agents' rows; NaN where no agent has two.

        It is the mean of steps and of the parts of multiple ones, so that times which were rounded
        do not drift; of uneven times it is rounded to two or three digits.
        """
        step = self.steps[self.steps > 0]
        if not step.size:
            return float("nan")
        usual = float(np.median(step))
        step = step[step < LATEST * usual]
        number = np.maximum(np.round(step / usual), 1)
        # whatever the order of rows
        mean = math.fsum(step) / float(number.sum())
        if (np.abs(step - number * usual) <= UNEVEN * usual).all():
            return mean
        short = float(f"{mean:.2g}")
        return short if abs(short - mean) <= 2 * UNEVEN * mean else float(f"{mean:.3g}")

    def in_order(self) -> Trajectories:
        """The rows with an agent, a time and a position, in the order of agents and, of each, of
        time; no time twice."""
        code = pd.factorize(self.agent)[0]
        usable = np.isfinite(self.time) & np.isfinite(self.x).all(axis=1) & (code >= 0)
        order = np.flatnonzero(usable)
        order = order[np.lexsort((self.time[order], code[order]))]
        repeated = (np.diff(code[order]) == 0) & (np.diff(self.time[order]) == 0)
        return self.at(np.delete(order, np.flatnonzero(repeated) + 1))

    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """``(N,)`` first and last row of every agent of rows :meth:`in_order`."""
        begins = np.ones(len(self), dtype=bool)
        begins[1:] = self.agent[1:] != self.agent[:-1]
        start = np.flatnonzero(begins)
        return start, np.append(start[1:], len(self)) - 1

    def parts(self, *names: str) -> Iterator[tuple[tuple[str, ...], Trajectories]]:
        """The rows of every combination of names, such as ``recording``, in order of first rows."""
        columns = [getattr(self, name) for name in names]
        if all(column is None for column in columns):
            yield tuple("" for _ in names), self
            return
        for rows in grouped_rows(*columns):
            row = rows[0]
            yield tuple("" if c is None else str(c[row]) for c in columns), self.at(rows)


@dataclass(frozen=True)
class Grid:
    """Equally spaced times: ``origin + k * dt`` s."""

    dt: float
    origin: float = 0.0


@dataclass(frozen=True)
class Record:
    """An agent's record without a hole; sample i is at time ``first + i`` of the grid.

    Attributes:
        agent: its identifier.
        row: of the table, where the record begins.
        first: number of the first time.
        x: ``(K, D)`` m.
        v: ``(K, D)`` m/s, or None.
        filled: ``(K,)`` whether the sample was missing.
        uneven: ``(K,)`` whether it was interpolated because times are uneven.
    """

    agent: str
    row: int
    first: int
    x: np.ndarray
    v: np.ndarray | None
    filled: np.ndarray
    uneven: np.ndarray

    @property
    def last(self) -> int:
        """Number of the last time."""
        return self.first + len(self.x) - 1

    @property
    def records(self) -> list[Record]:
        """The record alone, as those of a :class:`nnode.data.cut.Member`."""
        return [self]


def driven(time: np.ndarray, v: np.ndarray) -> np.ndarray:
    """``(K,)`` m that are covered at the speeds ``v`` from the first time on.

    The trapezium rule; over holes (NaN) by the line between their ends.
    """
    measured = np.isfinite(v)
    if not measured.any():
        return np.zeros(len(v))
    whole = np.interp(time, time[measured], v[measured])
    return np.asarray(cumulative_trapezoid(whole, time, initial=0.0))


def measured_times(table: Trajectories, grid: Grid, first: int, last: int) -> np.ndarray:
    """``(K,)`` s: the times of a grid as the table writes them, where its times are those."""
    k = (table.time - grid.origin) / grid.dt
    near = np.round(k)
    at = np.arange(first, last + 1)
    if (np.abs(k - near) > UNEVEN).any():
        return grid.origin + grid.dt * at
    number, row = np.unique(near, return_index=True)
    return np.asarray(np.interp(at, number, table.time[row]))


def records(
    table: Trajectories,
    grid: Grid,
    *,
    fill: float,
    smoothing: float | None = None,
    reused: str = "",
) -> list[Record]:
    """Agents' records at the times of a grid, by agent and time.

    Holes in which no more than ``fill`` s are missing are filled by a local cubic, speeds by a
    straight line; longer ones end a record, and so does a change of lane. Where times miss those
    of the grid, positions and speeds are interpolated.

    Args:
        table: rows of one recording.
        fill: s.
        smoothing: s, window of local cubics in place of the measured positions and speeds; None:
            as they are.
        reused: name of the recording in a message; where it is given, an identifier that turns up
            where its agent cannot have got to is that of another agent.

    Raises:
        DataError: one agent twice at one time, or a time that steps cannot count; names the rows.
    """
    far = np.flatnonzero(~(np.abs(table.time - grid.origin) < LATEST * grid.dt))
    if far.size:
        raise DataError(
            f"{table.path}, {table.where(int(far[0]))}: the time is {table.time[far[0]]:g} s, "
            f"which steps of {grid.dt:g} s cannot count; correct it"
        )
    code, ids = pd.factorize(table.agent, sort=True)
    order = np.lexsort((table.time, code))
    _once(table, order, code[order])
    # infinite ones are no holes, but a fault
    measured = ~np.isnan(table.x).any(axis=1)
    if table.v is not None:
        measured &= ~np.isnan(table.v).any(axis=1)
    order = order[measured[order]]
    if not len(order):
        return []
    time, x, agent_code = table.time[order], table.x[order], code[order]
    v = None if table.v is None else table.v[order]
    step, other = np.diff(time), np.diff(agent_code) != 0
    usual = float(np.median(step[~other])) if (~other).any() else grid.dt
    hole = ~other & (step > HOLE * usual) & (step - usual > fill + 1e-6)
    number = np.ones(len(order), dtype=int)
    if reused:
        number = _numbers(ids[agent_code], time, x[:, 0], other, hole, reused)
    if smoothing is not None:
        positive("smooth", smoothing)
        x, v = _smoothed(time, x, other | hole, smoothing)
    ends = other | hole
    if table.lane is not None:
        ends |= table.lane[order][1:] != table.lane[order][:-1]
    taken, agent_records = set(map(str, ids)), []
    for rows in np.split(np.arange(len(order)), np.flatnonzero(ends) + 1):
        agent = numbered(str(ids[agent_code[rows[0]]]), int(number[rows[0]]), taken)
        made = _on_grid(time[rows], x[rows], None if v is None else v[rows], grid, usual)
        if made is not None:
            agent_records.append(Record(agent, int(order[rows[0]]), *made))
    return agent_records


def _once(table: Trajectories, order: np.ndarray, code: np.ndarray) -> None:
    """Refuse two rows of one agent at one time."""
    twice = np.flatnonzero((np.diff(code) == 0) & (np.diff(table.time[order]) <= 0))
    if twice.size:
        i, j = sorted(order[twice[0] : twice[0] + 2].tolist())
        whose = "" if table.sequence is None else f" of {table.sequence[j]}"
        raise DataError(
            f"{table.path}, {table.where(j)}: agent {table.agent[j]}{whose} occurs a second "
            f"time at {table.time[j]:g} s (first in {table.where(i)}); expected one row per agent "
            "and time: name the column that distinguishes agents of one name (data.columns)"
        )


_Made = tuple[int, np.ndarray, np.ndarray | None, np.ndarray, np.ndarray]


def _on_grid(
    time: np.ndarray, x: np.ndarray, v: np.ndarray | None, grid: Grid, usual: float
) -> _Made | None:
    """First time, positions, speeds, which were missing and which are between uneven times."""
    k = (time - grid.origin) / grid.dt
    near = np.round(k)
    if (np.abs(k - near) <= UNEVEN).all() and (np.diff(near) > 0).all():
        k = near
    first, last = int(np.ceil(k[0] - 1e-6)), int(np.floor(k[-1] + 1e-6))
    if last < first:
        return None
    at = np.arange(first, last + 1, dtype=float)
    after = np.searchsorted(k, at - 1e-6).clip(0, len(k) - 1)
    before = np.maximum(after - 1, 0)
    between = (k[after] > at + 1e-6) & (k[before] < at - 1e-6)
    filled = between & (time[after] - time[before] > HOLE * usual)
    away = np.minimum(np.abs(k[after] - at), np.abs(at - k[before]))
    places = _interpolated(at, k, x)
    for i in np.unique(before[filled]):
        inside = filled & (before == i)
        places[inside] = across(time, x, int(i), grid.origin + grid.dt * at[inside])
    speeds = None if v is None else _interpolated(at, k, v)
    return first, places, speeds, filled, between & ~filled & (away > UNEVEN)


def _interpolated(at: np.ndarray, k: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, k, column) for column in values.T], -1)


def _numbers(
    ids: np.ndarray, time: np.ndarray, x: np.ndarray, other: np.ndarray, hole: np.ndarray, name: str
) -> np.ndarray:
    """Each row's agent among those of its identifier, counted from 1."""
    new = given_anew(time, x, other, hole)
    if new.any():
        row = int(np.flatnonzero(new)[0]) + 1
        log.info(
            "%s: %d identifiers are used again for another vehicle, after a time or over a "
            "distance that are none of one vehicle (such as %s, another one from %g s on); "
            "data.agents=global takes them as they stand",
            name,
            len(set(ids[1:][new])),
            ids[row],
            time[row],
        )
    so_far = np.concatenate([[0], np.cumsum(new)])
    start = np.concatenate([[0], np.where(other, np.arange(1, len(ids)), 0)])
    return np.asarray(1 + so_far - so_far[np.maximum.accumulate(start)])


def _smoothed(
    time: np.ndarray, x: np.ndarray, ends: np.ndarray, window: float
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and speeds of local cubics, every record without a long hole by itself."""
    x, v = x.copy(), np.empty_like(x)
    for rows in np.split(np.arange(len(time)), np.flatnonzero(ends) + 1):
        x[rows], v[rows] = smooth_columns(time[rows], x[rows], window)
    return x, v
