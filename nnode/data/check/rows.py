"""The rows of a table in SI units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from nnode.data.check.columns import Meaning, are_pairs, clock_of, is_spaced, numbers
from nnode.data.check.raw import Raw
from nnode.data.sequence import Domain
from nnode.data.trajectories import Trajectories, driven
from nnode.data.units import FAIR, LAG, LIKELY, Medians, Scale, medians, scales, share
from nnode.errors import DataError

#: Columns whose names tell a unit.
_TELL = {"position": ("x", "x_follower", "spacing"), "speed": ("speed", "vx", "v_follower")}


@dataclass(frozen=True)
class Scaled:
    """The rows of a table in the units that are most probable.

    Attributes:
        meanings: column by meaning; that of pairs' columns is found beside a leader's.
        scales: combinations of units, the most probable first.
        known: medians in the file's own units.
        table: rows as they stand, in the file's own units; of pairs the followers' and then the
            leaders'.
        rows: those that can be used, in order and in SI units.
    """

    meanings: dict[str, Meaning]
    scales: list[Scale]
    known: Medians
    table: Trajectories
    rows: Trajectories

    @property
    def scale(self) -> Scale:
        """The units that are taken."""
        return self.scales[0]

    @property
    def share(self) -> float:
        """Probability of the units, whatever the rate of frames."""
        return share(self.scales)

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
                f"times are frames of a rate that the file does not tell; {fit} frames/s fit: say "
                f"the right one, as in data.frame_rate={best.rate:g}"
            )
        return sentences


def scaled(
    raw: Raw,
    meanings: Mapping[str, Meaning],
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
    meanings = _counted(raw, _of_pairs(raw, dict(meanings)))
    table = _rows(raw, meanings)
    clock = clock_of(meanings)
    rows = table.in_order()
    if len(rows) < 2 or not rows.steps.size:
        number = len(_cells(raw))
        raise DataError(
            f"{raw.path}: {number} row{'s' * (number != 1)}, in which no agent of column "
            f"{meanings.get('agent', meanings[clock]).column!r} has numbers at two times; "
            "nothing moves that could be looked at"
        )
    units = {"time": "s" if meanings[clock].column in raw.dated else meanings[clock].unit}
    for what, tellers in _TELL.items():
        units[what] = next((u for m in tellers if m in meanings and (u := meanings[m].unit)), "")
    units |= {"position": raw.unit} if raw.unit else {}
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


def _cells(raw: Raw) -> pd.DataFrame:
    assert raw.table is not None
    return raw.table.frame


def _counted(raw: Raw, meanings: dict[str, Meaning]) -> dict[str, Meaning]:
    """Meanings without a time that is nothing but the number of the frame."""
    assert raw.table is not None
    if not {"time", "frame"} <= set(meanings):
        return meanings
    time, frame = (numbers(raw.table.frame, meanings[m].column) for m in ("time", "frame"))
    if not np.array_equal(time, frame, equal_nan=True):
        return meanings
    return {m: meaning for m, meaning in meanings.items() if m != "time"}


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


def _rows(raw: Raw, meanings_of_columns: Mapping[str, Meaning]) -> Trajectories:
    """The rows as they stand; names of recordings and sequences are part of the agents' names."""
    table, pairs = raw.table, are_pairs(meanings_of_columns)
    assert table is not None
    _check_needed(raw, meanings_of_columns, pairs)

    def cells(*meanings: str) -> list[np.ndarray]:
        return [
            numbers(table.frame, meanings_of_columns[m].column)
            for m in meanings
            if m in meanings_of_columns
        ]

    def names(*meanings: str) -> list[np.ndarray]:
        return [
            table.names(meanings_of_columns[m].column, empty=True)
            for m in meanings
            if m in meanings_of_columns
        ]

    parts = names("recording", "sequence")
    (time,) = cells(clock_of(meanings_of_columns))
    if pairs:
        pair = _pairs(raw, meanings_of_columns)
        leads = ["follower", "leader"]
        x = (
            _integrated(raw, meanings_of_columns)
            if is_spaced(meanings_of_columns)
            else cells("x_follower", "x_leader")
        )
        v = cells("v_follower", "v_leader")
        return Trajectories(
            path=raw.path,
            name=raw.path.stem,
            where=lambda i: table.row(i % len(table)),
            agent=np.concatenate([pair + f" {who}" for who in leads]),
            time=np.tile(time, 2),
            x=np.concatenate(x)[:, None],
            v=np.abs(np.concatenate(v))[:, None] if len(v) == 2 else None,
            lane=np.tile(pair, 2),
        )
    (agent,) = names("agent")
    agents = _joined([*parts, agent])
    agents[agent == ""] = None
    # along the lane where there are lanes
    x = cells("x") if "lane" in meanings_of_columns else cells("x", "y")
    v = cells("vx", "vy")[: len(x)]
    speed = [np.sqrt(sum(part**2 for part in v))] if len(v) == len(x) else cells("speed")
    part = _joined(parts) if parts else None
    lane = names("lane") or ([part] if part is not None and len(x) == 1 else [])
    return Trajectories(
        path=raw.path,
        name=raw.path.stem,
        where=table.row,
        agent=agents,
        time=time,
        x=np.stack(x, -1),
        v=np.abs(speed[0])[:, None] if speed else None,
        recording=part,
        lane=lane[0] if lane else None,
        length=next(iter(cells("length")), None),
    )


def _check_needed(raw: Raw, meanings: Mapping[str, Meaning], pairs: bool) -> None:
    """Refuse a table without the columns that are needed."""
    lacking = [] if {"time", "frame"} & set(meanings) else ["a time or a frame"]
    lacking += [] if pairs or "x" in meanings else ["a position x"]
    lacking += [] if pairs or "agent" in meanings else ["an agent"]
    if lacking:
        listed = ", ".join(map(str, _cells(raw).columns[:20]))
        taken = ", ".join(f"{m.column} as {meaning}" for meaning, m in meanings.items())
        raise DataError(
            f"{raw.path}: no column was recognised as {' nor as '.join(lacking)}; it has {listed} "
            f"(taken: {taken or 'none'}); name the columns agent, time, x (and y), see docs/data.md"
        )


def _joined(columns: list[np.ndarray]) -> np.ndarray:
    return np.array([" ".join(cells) for cells in zip(*columns, strict=True)], dtype=object)


def _pairs(raw: Raw, meanings: Mapping[str, Meaning]) -> np.ndarray:
    """``(rows,)`` names of the pairs that rows are of."""
    assert raw.table is not None
    who = ("pair",) if "pair" in meanings else ("follower", "leader")
    whose = [m for m in ("recording", "sequence", *who) if m in meanings]
    parts = [
        raw.table.names(meanings[m].column, empty=m not in ("follower", "leader")) for m in whose
    ]
    if not set(who) & set(meanings):
        parts.append(np.full(len(raw.table), "pair", dtype=object))
    return _joined(parts)


def _of_pairs(raw: Raw, meanings: dict[str, Meaning]) -> dict[str, Meaning]:
    """Meanings with those that columns have only beside a leader's."""
    assert raw.table is not None
    if {"spacing", "v_leader", "speed"} <= set(meanings) and "v_follower" not in meanings:
        changed = {"v_follower" if m == "speed" else m: meaning for m, meaning in meanings.items()}
        meanings = changed if is_spaced(changed) else meanings
    if are_pairs(meanings) and {"pair", "split"} <= set(meanings) and "recording" not in meanings:
        columns = [raw.table.names(meanings[m].column, empty=True) for m in ("pair", "split")]
        names = set(zip(*columns, strict=True))
        if len({pair for pair, _ in names}) < len(names):  # counted anew on either side
            meanings = {**meanings, "recording": meanings["split"]}
    return meanings


def _integrated(raw: Raw, meanings: Mapping[str, Meaning]) -> list[np.ndarray]:
    """Positions of followers and leaders in the unit of the spacing, by the reader's rule.

    The distance that a unit of speed covers in a unit of time follows from how spacings change
    with the speeds: the ratio of the root mean squares of both changes over LAG samples.
    """
    assert raw.table is not None
    columns = [
        meanings[m].column for m in (clock_of(meanings), "spacing", "v_follower", "v_leader")
    ]
    time, spacing, follower, leader = (numbers(raw.table.frame, c) for c in columns)
    x, measured, expected = np.full(len(time), np.nan), [], []
    names = _pairs(raw, meanings)
    for pair in pd.Series(names).groupby(names).indices.values():
        rows = pair[np.isfinite(time[pair])]
        rows = rows[np.argsort(time[rows], kind="stable")]
        x[rows] = driven(time[rows], leader[rows])
        relative = x[rows] - driven(time[rows], follower[rows])
        measured.append(spacing[rows][LAG:] - spacing[rows][:-LAG])
        expected.append(relative[LAG:] - relative[:-LAG])
    change, of_speeds = np.concatenate(measured), np.concatenate(expected)
    known = np.isfinite(change)
    squares = max(float((of_speeds[known] ** 2).sum()), 1e-300)
    unit = float(np.sqrt((change[known] ** 2).sum() / squares))
    x *= unit if known.any() and 0 < unit < 1e6 else 1.0
    return [x - spacing, x]
