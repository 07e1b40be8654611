"""The rows of a table in SI units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from nnode.data.check.columns import Meaning, are_pairs, clock_of, is_spaced, numbers
from nnode.data.check.raw import Raw
from nnode.data.readers.columns import joined
from nnode.data.sequence import Domain
from nnode.data.trajectories import Trajectories, driven, grouped_rows
from nnode.data.units import FAIR, LAG, LIKELY, Medians, Scale, medians, scales
from nnode.errors import DataError

_WHO = ("follower", "leader")
#: Columns whose names tell a unit.
_TELL = {"position": ("x", "x_follower", "spacing"), "speed": ("speed", "vx", "v_follower")}


@dataclass
class Scaled:
    """The rows of a table in the units that are most probable.

    Attributes:
        meanings: column by meaning; that of pairs' columns is found beside a leader's.
        scales: combinations of units, the most probable first.
        medians: medians in the file's own units.
        table: rows as they stand, in the file's own units; of pairs the followers' and then the
            leaders'.
        rows: those that can be used, in order and in SI units.
    """

    meanings: dict[str, Meaning]
    scales: list[Scale]
    medians: Medians
    table: Trajectories
    rows: Trajectories

    @property
    def scale(self) -> Scale:
        """The units that are taken."""
        return self.scales[0]

    @property
    def columns(self) -> dict[str, str]:
        """Names of columns by meaning."""
        return {meaning: column.column for meaning, column in self.meanings.items()}

    @property
    def share(self) -> float:
        """Probability of the units, whatever the rate of frames."""
        return sum(s.probability for s in self.scales if s.units == self.scale.units)

    def rates(self, stated: float | None) -> list[float]:
        """Frames per second that fit, where times are frames and nothing states their rate."""
        if stated is not None or self.scale.rate is None:
            return []
        same = (s for s in self.scales if s.units == self.scale.units and s.probability > FAIR)
        return sorted({s.rate for s in same if s.rate})

    def doubts(self, stated: float | None) -> dict[str, str]:
        """What may be two things, ``units`` and ``rate``, in words.

        Args:
            stated: frames per second that the file or the user states.
        """
        sentences, best = {}, self.scale
        if self.share < LIKELY:
            other = next(s for s in self.scales if s.units != best.units)
            sentences["units"] = (
                f"its numbers may be {best} or {other}; say which, with {best.options} or "
                f"{other.options}"
            )
        if rates := self.rates(stated):
            fit = " or ".join(f"{rate:g}" for rate in rates)
            sentences["rate"] = (
                f"times are frames, whose rate the file does not state; {fit} frames/s fit: set "
                f"the right one, as in data.frame_rate={best.rate:g}"
            )
        return sentences


def scaled(
    raw: Raw,
    meanings: dict[str, Meaning],
    domain: Domain | None,
    rate: float | None,
    told_units: Mapping[str, str] | None = None,
) -> Scaled:
    """Rows of a table, and its units.

    Args:
        meanings: column by meaning.
        domain, rate: see :func:`examine`.
        told_units: units by ``position``, ``time``, ``speed``, as the user states them.

    Raises:
        DataError: a column that is needed was not recognised, or nothing moves.
    """
    meanings = _of_pairs(raw, dict(meanings))
    clocks = _Columns(raw, meanings).numbers("time", "frame")
    if len(clocks) == 2 and np.array_equal(clocks[0], clocks[1], equal_nan=True):
        del meanings["time"]  # it is the number of the frame
    table = _rows(_Columns(raw, meanings))
    clock = clock_of(meanings)
    rows = table.in_order()
    if len(rows) < 2 or not rows.steps.size:
        number = len(raw.frame)
        raise DataError(
            f"{raw.path}: {number} row{'s' * (number != 1)}, in which no agent of column "
            f"{meanings.get('agent', meanings[clock]).column!r} has numbers at two times; "
            "nothing moves that could be looked at"
        )
    units = {"time": "s" if meanings[clock].column in raw.dated else meanings[clock].unit}
    for what, tellers in _TELL.items():
        units[what] = next((u for m in tellers if m in meanings and (u := meanings[m].unit)), "")
    units |= {"position": raw.layout.unit} if raw.layout.unit else {}
    units |= told_units or {}
    if clock == "frame":
        units["time"] = "frame"
    domain_medians = {d: medians(rows, d) for d in _domains(meanings, rows, domain)}
    every = scales(
        domain_medians,
        {what: unit for what, unit in units.items() if unit},
        frames=clock == "frame" or bool((rows.time % 1 == 0).all()),
        rate=rate or raw.rate,
        speeds=rows.v is not None,
    )
    scale = every[0]
    si = replace(
        rows,
        time=rows.time * scale.seconds,
        x=rows.x * scale.metres,
        v=None if rows.v is None else rows.v * scale.per_second,
        length=None if rows.length is None else rows.length * scale.metres,
    )
    return Scaled(meanings, every, domain_medians[scale.domain], table, si)


@dataclass(frozen=True)
class _Columns:
    """Cells of a table by the meaning of their column."""

    raw: Raw
    meanings: Mapping[str, Meaning]

    def numbers(self, *meanings: str) -> list[np.ndarray]:
        """Those columns of numbers that the table has."""
        held = (self.meanings[m].column for m in meanings if m in self.meanings)
        return [numbers(self.raw.frame, column) for column in held]

    def names(self, *meanings: str, empty: bool = True) -> list[np.ndarray]:
        """Those columns of names that the table has."""
        held = (self.meanings[m].column for m in meanings if m in self.meanings)
        return [self.raw.cells.names(column, empty=empty) for column in held]


def _domains(
    meanings: Mapping[str, Meaning], rows: Trajectories, asked: Domain | None
) -> list[Domain]:
    if rows.x.shape[1] == 1:
        return ["traffic"]
    if asked:
        return [asked]
    names = {m.column.lower() for m in meanings.values()}
    if any(word in name for name in names for word in ("ped", "person")):
        return ["crowd"]
    return ["traffic"] if "lane" in meanings else ["crowd", "traffic"]


def _rows(columns: _Columns) -> Trajectories:
    """The rows as they stand; names of recordings and sequences are part of the agents' names."""
    raw, meanings = columns.raw, columns.meanings
    table, pairs = raw.cells, are_pairs(meanings)
    _check_needed(raw, meanings, pairs)
    (time,) = columns.numbers(clock_of(meanings))
    if pairs:
        pair = _pairs(columns)
        x = (
            _integrated(columns, time, pair)
            if is_spaced(meanings)
            else columns.numbers("x_follower", "x_leader")
        )
        v = columns.numbers("v_follower", "v_leader")
        return Trajectories(
            path=raw.path,
            name=raw.path.stem,
            where=lambda i: table.row(i % len(table)),
            agent=np.concatenate([pair + f" {who}" for who in _WHO]),
            time=np.tile(time, 2),
            x=np.concatenate(x)[:, None],
            v=np.abs(np.concatenate(v))[:, None] if len(v) == 2 else None,
            lane=np.tile(pair, 2),
        )
    parts, (agent,) = columns.names("recording", "sequence"), columns.names("agent")
    agents = joined([*parts, agent])
    agents[agent == ""] = None
    # along the lane where there are lanes
    x = columns.numbers("x") if "lane" in meanings else columns.numbers("x", "y")
    v = columns.numbers("vx", "vy")[: len(x)]
    speed = [np.sqrt(sum(part**2 for part in v))] if len(v) == len(x) else columns.numbers("speed")
    part = joined(parts) if parts else None
    return Trajectories(
        path=raw.path,
        name=raw.path.stem,
        where=table.row,
        agent=agents,
        time=time,
        x=np.stack(x, -1),
        v=np.abs(speed[0])[:, None] if speed else None,
        recording=part,
        lane=next(iter(columns.names("lane")), part if len(x) == 1 else None),
        length=next(iter(columns.numbers("length")), None),
    )


def _check_needed(raw: Raw, meanings: Mapping[str, Meaning], pairs: bool) -> None:
    """Refuse a table without the columns that are needed."""
    lacking = [] if {"time", "frame"} & set(meanings) else ["a time or a frame"]
    lacking += [] if pairs or "x" in meanings else ["a position x"]
    lacking += [] if pairs or "agent" in meanings else ["an agent"]
    if lacking:
        listed = ", ".join(map(str, raw.frame.columns[:20]))
        taken = ", ".join(f"{m.column} as {meaning}" for meaning, m in meanings.items())
        raise DataError(
            f"{raw.path}: no column was recognised as {' nor as '.join(lacking)}; it has {listed} "
            f"(taken: {taken or 'none'}); name the columns agent, time, x (and y), see docs/data.md"
        )


def _pairs(columns: _Columns) -> np.ndarray:
    """``(rows,)`` names of the pairs that rows are of."""
    who = columns.names("pair") or columns.names(*_WHO, empty=False)
    who = who or [np.full(len(columns.raw.cells), "pair", dtype=object)]
    return joined([*columns.names("recording", "sequence"), *who])


def _of_pairs(raw: Raw, meanings: dict[str, Meaning]) -> dict[str, Meaning]:
    """Meanings with those that columns have only beside a leader's."""
    if {"spacing", "v_leader", "speed"} <= set(meanings) and "v_follower" not in meanings:
        changed = {"v_follower" if m == "speed" else m: meaning for m, meaning in meanings.items()}
        meanings = changed if is_spaced(changed) else meanings
    if are_pairs(meanings) and {"pair", "split"} <= set(meanings) and "recording" not in meanings:
        names = set(zip(*_Columns(raw, meanings).names("pair", "split"), strict=True))
        if len({pair for pair, _ in names}) < len(names):  # counted anew on either side
            meanings = {**meanings, "recording": meanings["split"]}
    return meanings


def _integrated(columns: _Columns, time: np.ndarray, pairs: np.ndarray) -> list[np.ndarray]:
    """Positions of followers and leaders in the unit of the spacing, by the reader's rule.

    The distance that a unit of speed covers in a unit of time follows from how spacings change
    with the speeds: the ratio of the root mean squares of both changes over LAG samples.
    """
    spacing, follower, leader = columns.numbers("spacing", "v_follower", "v_leader")
    x, measured, expected = np.full(len(time), np.nan), [], []
    for pair in grouped_rows(pairs, time=time):
        rows = pair[np.isfinite(time[pair])]
        x[rows] = driven(time[rows], leader[rows])
        relative = x[rows] - driven(time[rows], follower[rows])
        measured.append(spacing[rows][LAG:] - spacing[rows][:-LAG])
        expected.append(relative[LAG:] - relative[:-LAG])
    change, of_speeds = np.concatenate(measured), np.concatenate(expected)
    sampled = np.isfinite(change)
    squares = max(float((of_speeds[sampled] ** 2).sum()), 1e-300)
    unit = float(np.sqrt((change[sampled] ** 2).sum() / squares))
    x *= unit if sampled.any() and 0 < unit < 1e6 else 1.0
    return [x - spacing, x]
