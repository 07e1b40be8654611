"""The rows of a table in SI units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from nnode.data.check.columns import Meaning, numbers
from nnode.data.check.raw import Raw
from nnode.data.check.scale import Medians, Scale, medians, scales
from nnode.data.check.source import are_pairs, is_spaced
from nnode.data.check.tracks import LAG, Tracks, tracks_of
from nnode.data.sequence import Domain
from nnode.errors import DataError

#: Columns whose names tell a unit.
_TELL: dict[str, tuple[str, ...]] = {
    "position": ("x", "x_follower", "spacing"),
    "time": (),
    "speed": ("speed", "vx", "v_follower"),
}


@dataclass(frozen=True)
class Scaled:
    """The rows of a table in the units that are most probable.

    Attributes:
        meanings: column by meaning; that of pairs' columns is found beside a leader's.
        scales: combinations of units, the most probable first.
        known: medians in the file's own units.
        tracks: rows in SI units.
        agent, time: of every row, in the file's own units.
        clock: the meaning of the column that times are from, ``time`` or ``frame``.
    """

    meanings: dict[str, Meaning]
    scales: list[Scale]
    known: Medians
    tracks: Tracks
    agent: np.ndarray
    time: np.ndarray
    clock: str

    @property
    def scale(self) -> Scale:
        """The units that are taken."""
        return self.scales[0]


def scaled(
    raw: Raw,
    found: Mapping[str, Meaning],
    domain: Domain | None,
    rate: float | None,
    told: Mapping[str, str] | None = None,
) -> Scaled:
    """Rows of a table, and its units.

    Args:
        found: column by meaning.
        domain, rate: see :func:`examine`.
        told: units by ``position``, ``time``, ``speed``, as the user tells them.

    Raises:
        DataError: a column that is needed was not recognised, or nothing moves.
    """
    table = raw.table
    assert table is not None
    found = _of_pairs(raw, dict(found))
    pairs = are_pairs(found)
    found = _counted(raw, found)
    clock = next((m for m in ("time", "frame") if m in found), None)
    lacking = [] if clock else ["a time or a frame"]
    lacking += [] if pairs or "x" in found else ["a position x"]
    lacking += [] if pairs or "agent" in found else ["an agent"]
    if lacking or clock is None:
        listed = ", ".join(map(str, table.frame.columns[:20]))
        taken = ", ".join(f"{m.column} as {meaning}" for meaning, m in found.items())
        raise DataError(
            f"{raw.path}: no column was recognised as {' nor as '.join(lacking)}; it has {listed} "
            f"(taken: {taken or 'none'}); name the columns agent, time, x (and y), see docs/data.md"
        )
    time = numbers(table.frame, found[clock].column)
    files = _agents(raw, found, pairs)
    x, speed, length, lane = _places(raw, found, pairs)
    if pairs:
        time = np.concatenate([time, time])
    tracks = tracks_of(files, time, x, speed, lane, length, None if pairs else _parts(raw, found))
    if len(tracks) < 2 or not tracks.steps.size:
        raise DataError(
            f"{raw.path}: {len(table)} row{'s' * (len(table) != 1)}, in which no agent of column "
            f"{found.get('agent', found[clock]).column!r} has numbers at two times; "
            "nothing moves that could be looked at"
        )
    units: dict[str, str] = {}
    for what, tellers in _TELL.items():
        for meaning in (*tellers, clock) if what == "time" else tellers:
            if not units.get(what) and meaning in found:
                units[what] = found[meaning].unit
    if raw.unit:
        units["position"] = raw.unit
    units |= told or {}
    if clock == "frame":
        units["time"] = "frame"
    if found[clock].column in raw.dated:
        units["time"] = "s"
    rate = rate or raw.rate
    known = {d: medians(tracks, d) for d in _domains(found, tracks, domain)}
    frames = clock == "frame" or bool((tracks.time % 1 == 0).all())
    every = scales(
        known,
        {k: v for k, v in units.items() if v},
        frames=frames,
        rate=rate,
        speeds=speed is not None,
    )
    scale = every[0]
    si = tracks.scaled(scale.metres, scale.seconds, scale.per_second)
    return Scaled(found, every, known[scale.domain], si, files, time, clock)


def _counted(raw: Raw, found: dict[str, Meaning]) -> dict[str, Meaning]:
    """Meanings without a time that is nothing but the number of the frame."""
    assert raw.table is not None
    if not {"time", "frame"} <= set(found):
        return found
    time, frame = (numbers(raw.table.frame, found[m].column) for m in ("time", "frame"))
    if not np.array_equal(time, frame, equal_nan=True):
        return found
    return {m: one for m, one in found.items() if m != "time"}


def _domains(found: Mapping[str, Meaning], tracks: Tracks, asked: Domain | None) -> list[Domain]:
    if tracks.x.shape[1] == 1:
        return ["traffic"]
    if asked:
        return [asked]
    names = {m.column.lower() for m in found.values()}
    if any(word in name for name in names for word in ("ped", "person")):
        return ["crowd"]
    return ["traffic"] if "lane" in found else ["crowd", "traffic"]


def _agents(raw: Raw, found: Mapping[str, Meaning], pairs: bool) -> np.ndarray:
    """Whose row it is: what tells recordings and sequences apart is part of the name."""
    assert raw.table is not None
    whose = ("recording", "sequence", "pair") if pairs else ("recording", "sequence", "agent")
    parts = [raw.table.names(found[m].column, empty=True) for m in whose if m in found]
    if pairs and "pair" not in found:
        own = [raw.table.names(found[m].column) for m in ("follower", "leader") if m in found]
        parts += own or [np.full(len(raw.table), "pair", dtype=object)]
    names = np.array([" ".join(cells) for cells in zip(*parts, strict=True)], dtype=object)
    blank = parts[-1] == "" if not pairs else np.zeros(len(names), dtype=bool)
    names[blank] = None
    if pairs:
        return np.concatenate([names + " follower", names + " leader"])
    return names


_Places = tuple[np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray | None]


def _places(raw: Raw, found: Mapping[str, Meaning], pairs: bool) -> _Places:
    """Positions, speeds, lengths and lanes of the rows."""
    assert raw.table is not None
    frame = raw.table.frame

    def cells(meaning: str) -> np.ndarray | None:
        return numbers(frame, found[meaning].column) if meaning in found else None

    if pairs:
        if is_spaced(found):
            both = _integrated(raw, found)
        else:
            both = [numbers(frame, found[m].column) for m in ("x_follower", "x_leader")]
        x = np.concatenate(both)[:, None]
        own, other = cells("v_follower"), cells("v_leader")
        speed = None if own is None or other is None else np.abs(np.concatenate([own, other]))
        pair = _agents(raw, found, pairs)
        both_in = np.array([name.rpartition(" ")[0] for name in pair], dtype=object)
        return x, speed, None, both_in
    axes = [m for m in ("x", "y") if m in found]
    if "lane" in found and "y" in found:
        axes = ["x"]  # along the lane
    x = np.stack([numbers(frame, found[m].column) for m in axes], -1)
    speed = cells("speed")
    lane: np.ndarray | None = None
    parts = [v for m in ("vx", "vy")[: len(axes)] if (v := cells(m)) is not None]
    if len(parts) == len(axes):
        speed = np.sqrt(sum(v**2 for v in parts))
    if "lane" in found:
        lane = raw.table.names(found["lane"].column, empty=True)
    if lane is None and len(axes) == 1:
        lane = _parts(raw, found)
    return x, None if speed is None else np.abs(speed), cells("length"), lane


def _of_pairs(raw: Raw, found: dict[str, Meaning]) -> dict[str, Meaning]:
    """Meanings with those that columns have only beside a leader's."""
    assert raw.table is not None
    if {"spacing", "v_leader", "speed"} <= set(found) and "v_follower" not in found:
        changed = {"v_follower" if m == "speed" else m: one for m, one in found.items()}
        found = changed if is_spaced(changed) else found
    if are_pairs(found) and {"pair", "split"} <= set(found) and "recording" not in found:
        both = [raw.table.names(found[m].column, empty=True) for m in ("pair", "split")]
        names = set(zip(*both, strict=True))
        if len({pair for pair, _ in names}) < len(names):  # counted anew on either side
            found = {**found, "recording": found["split"]}
    return found


def _integrated(raw: Raw, found: Mapping[str, Meaning]) -> list[np.ndarray]:
    """Positions of followers and leaders in the unit of the spacing, by the reader's rule.

    What distance a unit of speed times time is follows from how spacings change with the speeds:
    the ratio of root mean squares of both changes.
    """
    assert raw.table is not None
    clock = found["time" if "time" in found else "frame"].column
    columns = (clock, *(found[m].column for m in ("spacing", "v_follower", "v_leader")))
    time, spacing, follower, leader = (numbers(raw.table.frame, c) for c in columns)
    pair = pd.factorize(_agents(raw, found, True)[: len(time)])[0]
    order = np.lexsort((time, pair))
    same = np.diff(pair[order]) == 0

    def gone(v: np.ndarray) -> np.ndarray:
        step = np.diff(time[order]) * (v[order][1:] + v[order][:-1]) / 2
        return np.concatenate([[0.0], np.nancumsum(np.where(same, step, 0.0))])

    relative, lag = gone(leader - follower), LAG
    whole = pair[order][lag:] == pair[order][:-lag]
    change = (spacing[order][lag:] - spacing[order][:-lag])[whole]
    said = (relative[lag:] - relative[:-lag])[whole]
    known = np.isfinite(change)
    unit = float(np.sqrt((change[known] ** 2).sum() / max((said[known] ** 2).sum(), 1e-300)))
    if not (known.any() and 0 < unit < 1e6):
        unit = 1.0
    x = np.empty(len(time))
    x[order] = unit * gone(leader)
    return [x - spacing, x]


def _parts(raw: Raw, found: Mapping[str, Meaning]) -> np.ndarray | None:
    """Names of the recordings and sequences that the rows are of, where the table has such."""
    assert raw.table is not None
    whose = [
        raw.table.names(found[m].column, empty=True)
        for m in ("recording", "sequence")
        if m in found
    ]
    if not whose:
        return None
    return np.array([" ".join(one) for one in zip(*whose, strict=True)], dtype=object)
