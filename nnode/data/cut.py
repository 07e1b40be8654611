"""Sequences cut from trajectories: by lane, sequence, pair, spacing or presence.

By lane follows Section 4.2 of the calibration paper: every lane by itself, the lateral coordinate
dropped, and sequences in which the same vehicles are in view. All ways end in
:func:`sequence_of`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from nnode.data.options import (
    Agents,
    DataOptions,
    Gaps,
    LaneOptions,
    OpenAccOptions,
    PairOptions,
    check_known,
    positive,
    wanted,
)
from nnode.data.sequence import UNEVEN, Sequence
from nnode.data.smooth import smooth
from nnode.data.trajectories import (
    Grid,
    Record,
    Trajectories,
    driven,
    measured_times,
    records,
)
from nnode.errors import ConfigError, DataError

log = logging.getLogger(__name__)

#: A sequence's times times its agents, present or not.
MOST_CELLS = 10**8
#: Fewest times of a part of a sequence.
LEAST = 3
#: Sequences that notes list.
LISTED = 3
#: Times of a run, with those that no row stands for.
MOST_TIMES = 10**6
#: Times and places of a run may be so many, or so many times the rows that stand there.
_CELLS, _SPARSE = 10**7, 10


class Reading(list[Sequence]):
    """Sequences of a reader that tells what it left out and what it changed.

    Attributes:
        left_out: ``name`` and ``why`` of each record of which there is no sequence.
        notes: sentences about what was interpolated or cut.
    """

    def __init__(
        self,
        sequences: Iterable[Sequence] = (),
        left_out: Iterable[dict[str, str]] = (),
        notes: Iterable[str] = (),
    ) -> None:
        super().__init__(sequences)
        self.left_out = list(left_out)
        self.notes = list(notes)

    def add(self, other: list[Sequence]) -> None:
        """Append what another file gave."""
        self += other
        if isinstance(other, Reading):
            self.left_out += other.left_out
            self.notes += other.notes


#: Agents' records, and the first and the last time of their sequence.
_Platoon = tuple[list[Record], int, int]


@dataclass
class Member:
    """An agent of a sequence: its name, a row of the table that tells what it is, its records."""

    agent: str
    row: int
    records: list[Record] = field(default_factory=list)


def members(table: Trajectories, agent_records: Iterable[Record]) -> list[Member]:
    """Every agent that the rows name, in order of names as text, with its records."""
    names, rows = np.unique(table.agent.astype(str), return_index=True)
    by_name = {name: Member(name, int(row)) for name, row in zip(names, rows, strict=True)}
    for record in agent_records:
        by_name[record.agent].records.append(record)
    return list(by_name.values())


def sequence_of(
    name: str,
    table: Trajectories,
    of: list[Member],
    first: int,
    last: int,
    grid: Grid,
    **further: Any,
) -> Sequence:
    """The sequence of some agents from one time of the grid to another one.

    Args:
        name: of the sequence.
        table: that the records are from.
        of: its agents, in their order; NaN where one has no record.
        further: further fields of :class:`~nnode.data.sequence.Sequence`.
    """
    shape = (last - first + 1, len(of), table.x.shape[1])
    x, v = np.full(shape, np.nan), np.full(shape, np.nan)
    filled = 0
    for n, member in enumerate(of):
        for record in member.records:
            low, high = max(first, record.first), min(last, record.last) + 1
            if low < high:
                part = slice(low - record.first, high - record.first)
                x[low - first : high - first, n] = record.x[part]
                if record.v is not None:
                    v[low - first : high - first, n] = record.v[part]
                filled += int(record.filled[part].sum())
    rows = np.array([member.row for member in of], dtype=int)
    length = None if table.length is None else table.length[rows]
    fields: dict[str, Any] = {
        "recording": table.name,
        "agents": tuple(member.agent for member in of),
        "length": None if length is None or np.isnan(length).all() else length,
        "kind": None if table.kind is None else tuple(table.kind[rows]),
        "group": None if table.group is None else tuple(table.group[rows]),
        "destination": None if table.destination is None else table.destination[rows],
        "split": "" if table.split is None else str(table.split[rows[0]]).lower(),
        "v": None if np.isnan(v).all() else v,
        "filled": filled,
        "time": grid.origin + grid.dt * np.arange(first, last + 1),
    }
    return Sequence(name=name, x=x, **(fields | further))


def told_uneven(agent_records: Iterable[Record], dt: float) -> list[str]:
    """A sentence about records whose times are uneven, if there are such."""
    every = list(agent_records)
    number = sum(int(r.uneven.sum()) for r in every)
    total = sum(len(r.x) for r in every)
    if not number:
        return []
    return [
        f"times are uneven, or no multiples of {dt:g} s: {number} of {total} samples "
        f"({number / total:.0%}) are interpolated to steps of {dt:g} s"
    ]


def spans(of: list[Member]) -> list[tuple[int, int]]:
    """First and last times of the maximal intervals in which all agents are there."""
    every = [record for member in of for record in member.records]
    return [
        (first, last)
        for present, first, last in _intervals(every)
        if len(present) == len(of) and of
    ]


def windows(first: int, last: int, steps: int) -> Iterator[tuple[int, int]]:
    """Consecutive windows of so many steps that share their boundary sample."""
    for start in range(first, last - steps + 1, steps):
        yield start, start + steps


def by_lane(table: Trajectories, options: LaneOptions, lane_word: str = "lane") -> Reading:
    """Cut vehicles into sequences, lane by lane.

    Without ``window`` a sequence is a maximal interval during which the same vehicles are in
    view. With it, time is cut into consecutive windows that share their boundary sample, and a
    sequence is a platoon of vehicles in view throughout; where a vehicle is in view for part of
    the window, the platoon is cut at its place, so that nobody follows a vehicle that is not
    its leader. With ``pairs`` a sequence is a vehicle and the one in front of it, as long as that
    is the same one, in whole windows where there are such.

    Args:
        table: to the names of whose recordings ``_`` and the lane are added.
        options: lanes, time grid and the way of cutting, checked by :func:`check_cutting`.
        lane_word: stands before the lane's name.

    Returns:
        Sequences named ``recording/number``. Vehicles are ordered by position, the leader last.

    Raises:
        ConfigError: an unknown lane or recording.
        DataError: one vehicle twice at one time, or no sequence at all.
    """
    chosen, grid = _lanes(options, table), Grid(options.dt)
    names_of_kinds = {str(code): str(name) for code, name in dict(options.kinds).items()}
    lanes: dict[str, tuple[str, Trajectories, list[Record]]] = {}
    notes: list[str] = []
    for (recording,), rows in table.parts("recording"):
        stem = recording or table.name
        reused = stem if options.agents is Agents.auto else ""
        every = records(rows, grid, fill=options.fill, smoothing=options.smooth, reused=reused)
        notes += [f"{stem}: {text}" for text in told_uneven(every, grid.dt)]
        present = {""} if rows.lane is None else set(rows.lane)
        for lane in (name for name in chosen if name in present):
            lane_records = [r for r in every if rows.lane is None or rows.lane[r.row] == lane]
            lanes[f"{stem}_{lane_word}{lane}" if lane else stem] = stem, rows, lane_records
    asked = wanted(options.recording)
    if asked is not None:
        check_known(asked, lanes)
        lanes = {name: lanes[name] for name in asked}
    sequences = []
    for name, (stem, rows, lane_records) in lanes.items():
        for number, (platoon, first, last) in enumerate(_platoons(lane_records, options)):
            of = [Member(record.agent, record.row, [record]) for record in platoon]
            kinds = None
            if rows.kind is not None:
                codes = (str(rows.kind[record.row]) for record in platoon)
                kinds = tuple(names_of_kinds.get(code, code) for code in codes)
            sequences.append(
                sequence_of(
                    f"{name}/{number:03d}",
                    rows,
                    of,
                    first,
                    last,
                    grid,
                    recording=name,
                    site=stem,
                    kind=kinds,
                )
            )
    if not sequences:
        vehicles = {
            record.agent for _, _, lane_records in lanes.values() for record in lane_records
        }
        raise DataError(
            f"{table.path}: no sequence; at no time are {options.min_vehicles} vehicles in one "
            f"lane for {options.min_samples} samples of {options.dt:g} s"
            + (f" throughout a window of {options.window:g} s" if options.window else "")
            + f" ({len(vehicles)} vehicles, {len(lanes)} lanes); lower data.min_vehicles, "
            "data.min_samples or data.window"
        )
    return Reading(sequences, notes=notes)


def by_sequence(
    table: Trajectories,
    options: DataOptions,
    key: Callable[[str], Any],
    *,
    ordered: bool = False,
    named: bool = True,
) -> Reading:
    """Cut rows as the source does, by recordings and sequences.

    A platoon is cut into the parts in which all its vehicles are there, with a number behind the
    name where there are several; where these are never there together, a vehicle without a
    position is NaN. A crowd is cut where nobody is there; a person who is absent at other times is
    NaN there.

    Args:
        options: ``fill`` and ``smooth`` are read.
        key: sorts names of recordings, sequences and agents.
        ordered: whether vehicles are in the order of their names, not of their positions.
        named: whether names of agents are identifiers.

    Returns:
        Sequences named ``recording/sequence``, in the order of their names.

    Raises:
        DataError: one agent twice at one time, or times that are too many.
    """
    reading, notes = Reading(), list[str]()
    every: list[Record] = []
    every_part = table.parts("recording", "sequence")
    for (run, number), rows in sorted(every_part, key=lambda part: [*map(key, part[0])]):
        dt = table.dt if np.isfinite(table.dt) else 1.0  # of single samples
        grid = Grid(dt, float(rows.time.min()))
        agent_records = records(rows, grid, fill=options.fill, smoothing=options.smooth)
        every += agent_records
        of = sorted(members(rows, agent_records), key=lambda member: key(member.agent))
        name = number if number.startswith(f"{run}/") else f"{run}/{number}"
        parts, note = _parts_of(name, rows, agent_records, of, grid, options.fill)
        notes += note
        fields = {"recording": run} | ({} if named else {"agents": ()})
        lane = not ordered and table.x.shape[1] == 1
        orders = [_in_lane(of, first) if lane else of for first, _ in parts]
        reading += _numbered(name, rows, orders, parts, grid, **fields)
    reading.notes = told_uneven(every, table.dt) + notes[:LISTED]
    if len(notes) > LISTED:
        reading.notes.append(f"and {len(notes) - LISTED} more such sequences")
    return reading


def by_pair(rows: Trajectories, dt: float, options: PairOptions) -> tuple[Reading, list[Record]]:
    """Cut a pair where either is not there, or into windows without such a gap.

    Args:
        rows: of one pair, the follower's and then as many of the leader's.
        dt: s, of the time grid; it begins at 0 where ``options.dt`` says it, otherwise with the
            pair.

    Returns:
        Sequences named ``recording/sequence``, with a number behind where there are several, and
        both records.

    Raises:
        ConfigError: a ``dt`` finer than the rows, or a ``window`` that is no whole number of steps.
        DataError: a gap, where ``gaps=error``; or one agent twice at one time.
    """
    ((run, number), _), *_ = rows.parts("recording", "sequence")
    name = f"{run}/{number}"
    if options.dt is not None and dt < rows.dt * (1 - UNEVEN):
        raise ConfigError(
            f"data.dt={dt:g} s is finer than the {rows.dt:g} s of {rows.path}: pair {number}; "
            "expected no more times than were measured"
        )
    grid = Grid(dt, 0.0 if options.dt is not None else float(rows.time.min()))
    pair_records = records(rows, grid, fill=options.fill, smoothing=options.smooth)
    vehicles = [Member(str(rows.agent[i]), i) for i in (0, len(rows) // 2)]
    for record in pair_records:
        vehicles[record.row >= len(rows) // 2].records.append(record)
    parts = spans(vehicles)
    if len(parts) > 1 and options.gaps is Gaps.error:
        end, start = (grid.origin + dt * k for k in (parts[0][1], parts[1][0]))
        row = int(np.argmin(np.where(rows.time >= start - dt / 2, rows.time, np.inf)))
        raise DataError(
            f"{rows.path}: pair {number} steps from {end:g} s to {start:g} s "
            f"({rows.where(row)}), expected steps of {dt:g} s ({len(parts) - 1} such gaps); "
            "data.gaps=cut cuts the pair there"
        )
    if options.window is not None:
        steps = whole_steps("window", options.window, dt)
        parts = [piece for part in parts for piece in windows(*part, steps)]
    parts = [(a, b) for a, b in parts if b - a + 1 >= options.min_samples]
    made = Reading(_numbered(name, rows, [vehicles] * len(parts), parts, grid, recording=run))
    if not made:
        times = f"data.min_samples={options.min_samples} times"
        if len(rows) // 2 < options.min_samples:
            why = f"fewer than {times}"
        elif options.window is not None:
            why = f"no data.window={options.window:g} s without a gap"
        else:
            why = f"no {times} without a gap"
        made.left_out.append({"name": name, "why": why})
    return made, pair_records


def _numbered(
    name: str,
    rows: Trajectories,
    of: list[list[Member]],
    parts: list[tuple[int, int]],
    grid: Grid,
    **fields: Any,
) -> list[Sequence]:
    """Parts of one sequence, with a number behind its name where there are several.

    Args:
        of: agents of every part, in their order.
    """
    return [
        sequence_of(
            name if len(parts) == 1 else f"{name}_{i:03d}",
            rows,
            agents,
            first,
            last,
            grid,
            time=measured_times(rows, grid, first, last),
            **fields,
        )
        for i, (agents, (first, last)) in enumerate(zip(of, parts, strict=True))
    ]


def _parts_of(
    name: str,
    rows: Trajectories,
    agent_records: list[Record],
    of: list[Member],
    grid: Grid,
    fill: float,
) -> tuple[list[tuple[int, int]], list[str]]:
    """First and last times of the parts of a sequence, and what was cut, in words."""
    times = 1 + round((float(rows.time.max()) - grid.origin) / grid.dt)
    if times * len(of) > MOST_CELLS:
        raise DataError(
            f"{rows.path}: sequence {name} has {times} times and {len(of)} agents in "
            f"{len(rows)} rows, expected at most {MOST_CELLS:.0e} times x agents; cut it into "
            "shorter sequences"
        )
    crowd = rows.x.shape[1] == 2
    parts = _occupied(agent_records) if crowd else spans(of)
    if crowd and any(record.uneven.any() for record in agent_records):
        # people begin and end between two times of the grid
        parts = [(a + 1, b - 1) for a, b in parts]
    parts = [(a, b) for a, b in parts if b - a + 1 >= LEAST]
    lost = times - sum(b - a + 1 for a, b in parts)
    if not parts:
        return [(0, times - 1)], []
    if lost * grid.dt <= fill + grid.dt / 2:
        return parts, []
    who = "nobody is" if crowd else "not all vehicles are"
    return parts, [
        f"sequence {name}: {who} there at {lost} of {times} times, for longer than "
        f"data.fill={fill:g} s; cut into {len(parts)} sequence{'s' * (len(parts) > 1)} without "
        "these times"
    ]


def _occupied(agent_records: list[Record]) -> list[tuple[int, int]]:
    """First and last times of the intervals in which anybody is there."""
    parts: list[tuple[int, int]] = []
    for record in sorted(agent_records, key=lambda r: r.first):
        if parts and record.first <= parts[-1][1] + 1:
            parts[-1] = parts[-1][0], max(parts[-1][1], record.last)
        else:
            parts.append((record.first, record.last))
    return parts


def _in_lane(of: list[Member], at: int) -> list[Member]:
    """Vehicles in the order of where they are at a time, or first."""

    def place(member: Member) -> float:
        for record in member.records:
            if record.last >= at:
                return float(record.x[max(at - record.first, 0), 0])
        return np.inf

    return sorted(of, key=place)


def by_presence(
    every: list[Record],
    steps: int,
    least: int = 1,
    axis: int = 0,
    view: tuple[float, float] | None = None,
) -> Iterator[_Platoon]:
    """Consecutive windows, each with those who are there throughout.

    Windows begin with the first record and share their boundary sample.

    Args:
        steps: of a window.
        least: fewest agents.
        axis, view: m, whoever is there is within these ends of a coordinate at all times.
    """
    if not every:
        return
    begin = np.array([record.first for record in every])
    end = np.array([record.last for record in every])
    low, number = int(begin.min()), end - begin
    # windows that lie within a record: two records may lie years apart
    starts = {
        low + k * steps
        for a, b in zip(begin[number >= steps], end[number >= steps], strict=True)
        for k in range(-((low - int(a)) // steps), (int(b) - low) // steps)
    }
    for first in sorted(starts):
        last = first + steps
        present = [every[i] for i in np.flatnonzero((begin <= first) & (end >= last))]
        if view is not None:
            paths = [record.x[first - record.first : last - record.first + 1] for record in present]
            inside = [
                (x[:, axis] >= view[0]).all() and (x[:, axis] <= view[1]).all() for x in paths
            ]
            present = [record for record, good in zip(present, inside, strict=True) if good]
        if len(present) >= least:
            yield present, first, last


def by_spacing(rows: Trajectories, options: OpenAccOptions) -> list[Sequence]:
    """Cut a platoon whose vehicles are known by their speeds and spacings.

    The foremost vehicle of a sequence is where its integrated speed brings it, those behind it are
    the spacings and lengths further back. Where the speed or the spacing of a vehicle has a hole
    longer than ``fill``, the platoon is cut in two at its place.

    Args:
        rows: of one run, the first vehicle in front; ``x`` is not looked at.
        options: ``dt``, ``fill``, ``max_error`` and the way of cutting.

    Returns:
        Sequences named ``run/number``, in order of time, the leader last.

    Raises:
        ConfigError: a ``dt`` or ``window`` that is no whole number of steps.
        DataError: times that are not equally spaced, or a vehicle twice at one time.
    """
    start, step, (speed, spacing) = _equally_spaced(rows, rows.v, rows.spacing)
    most = int(options.fill / step + 1e-6)  # samples that may be missing
    v = _filled(speed, most)
    sound = _sound(rows, spacing, np.diff(v, axis=1), step, options.max_error)
    gap = _filled(sound, most)
    added = (np.isfinite(v) & np.isnan(speed)) | (np.isfinite(gap) & np.isnan(sound))
    way = np.stack([driven(step * np.arange(len(v)), column) for column in v.T], 1)
    every = 1 if options.dt is None else whole_steps("dt", options.dt, step)
    v, gap, way, added = v[::every], gap[::every], way[::every], added[::every]
    grid = Grid(step * every, start)
    # with the vehicle in front; the first has nobody there
    linked = np.isfinite(v) & np.isfinite(gap)
    linked[:, 1:] &= np.isfinite(v[:, :-1])
    linked[:, 0] = False
    first_row = pd.Series(np.arange(len(rows))).groupby(rows.agent, sort=False).first()
    table = replace(rows, x=rows.x[:, :1])
    sequences: list[Sequence] = []
    for first, last in _linked_intervals(linked, grid.dt, options):
        part = slice(first, last + 1)
        heads = np.flatnonzero(~linked[part].all(axis=0))
        for i, end in pairwise([*heads.tolist(), linked.shape[1]]):
            if end - i < options.min_vehicles or not np.isfinite(v[part, i]).all():
                continue
            front, platoon = way[part, i], []
            for n in range(i, end):
                front = front - (gap[part, n] + (options.length or 0.0) if n > i else 0.0)
                x, speeds = front, v[part, n]
                if options.smooth is not None:
                    x, speeds = smooth(grid.dt * np.arange(len(x)), x, options.smooth)
                    speeds = np.maximum(speeds, 0.0)
                record = Record(
                    str(first_row.index[n]),
                    int(first_row.iloc[n]),
                    first,
                    x[:, None],
                    speeds[:, None],
                    added[part, n],
                    np.zeros(len(x), dtype=bool),
                )
                platoon.append(Member(record.agent, record.row, [record]))
            name = f"{rows.name}/{len(sequences):03d}"
            sequences.append(sequence_of(name, table, platoon[::-1], first, last, grid))
    return sequences


def _equally_spaced(
    rows: Trajectories, *columns: np.ndarray | None
) -> tuple[float, float, list[np.ndarray]]:
    """Time of the first sample, step (s), and columns ``(K, N)``, NaN where there is no row."""
    time, at = np.unique(np.round(rows.time, 6), return_inverse=True)
    agent, names = pd.factorize(rows.agent)
    if len(time) < 2:
        raise DataError(f"{rows.path}: all rows of {rows.name} stand at one time")
    step = round(float(np.median(np.diff(time))), 9)
    number = (time - time[0]) / step
    if not number[-1] < MOST_TIMES:
        raise DataError(
            f"{rows.path}: times go from {time[0]:g} to {time[-1]:g} s in steps of {step:g} s; "
            f"expected at most {MOST_TIMES:.0e} steps: look for a time that is wrong"
        )
    k = np.round(number).astype(int)
    odd = np.flatnonzero(np.abs(number - k) > 0.1)
    if odd.size:
        raise DataError(
            f"{rows.path}: the time {time[odd[0]]:g} s is no whole number of steps of {step:g} s "
            f"from the first, {time[0]:g} s"
        )
    shape = (int(k[-1]) + 1, len(names))
    if shape[0] * shape[1] > max(_CELLS, _SPARSE * len(rows)):
        raise DataError(
            f"{rows.path}: {len(rows)} rows stand at {shape[0]} equally spaced times of {shape[1]} "
            "vehicles; look for a time or a position that is wrong, or cut the file"
        )
    cell = k[at] * shape[1] + agent
    if len(np.unique(cell)) < len(cell):
        raise DataError(
            f"{rows.path}: run {rows.name} has two rows of one position at one time; expected one "
            "row per vehicle and time"
        )
    wide_columns = []
    for column in columns:
        wide = np.full(shape, np.nan)
        if column is not None:
            wide.ravel()[cell] = column.ravel()
        wide_columns.append(wide)
    return float(time[0]), step, wide_columns


def _filled(values: np.ndarray, most: int) -> np.ndarray:
    """``(K, N)`` values with holes of at most ``most`` samples interpolated."""
    full = values.copy()
    for column in full.T:
        missing, measured = (np.flatnonzero(np.isnan(column) == where) for where in (True, False))
        after = np.searchsorted(measured, missing)
        inside = (after > 0) & (after < len(measured))
        missing, after = missing[inside], after[inside]
        short = missing[measured[after] - measured[after - 1] <= most + 1]
        column[short] = np.interp(short, measured, column[measured]) if short.size else 0.0
    return full


def _sound(
    rows: Trajectories, spacing: np.ndarray, faster: np.ndarray, dt: float, most: float | None
) -> np.ndarray:
    """``(K, N)`` spacings without those that are none: not above 0, or between samples of which
    one contradicts the speeds by more than ``most`` m.

    Args:
        faster: ``(K, N - 1)`` m/s, how much faster each follower is than the vehicle in front.
    """
    sound = np.where(spacing > 0, spacing, np.nan)
    if most is not None:
        expected = -(faster[1:] + faster[:-1]) / 2 * dt
        off = np.abs(np.diff(sound[:, 1:], axis=0) - expected) > most
        sound[1:, 1:][off] = np.nan
        sound[:-1, 1:][off] = np.nan
    names = list(dict.fromkeys(rows.agent))
    bad = np.isfinite(spacing) & np.isnan(sound)
    for i in np.flatnonzero(bad.any(axis=0)):
        log.info(
            "%s: %d of %d gaps of %s to %s are not above 0, or change otherwise than their speeds "
            "tell (data.max_error); they count as unknown",
            rows.name,
            bad[:, i].sum(),
            np.isfinite(spacing[:, i]).sum(),
            names[i],
            names[i - 1],
        )
    return sound


def _linked_intervals(
    linked: np.ndarray, dt: float, options: OpenAccOptions
) -> Iterator[tuple[int, int]]:
    """First and last sample of windows, or of maximal intervals with the same links."""
    if options.window is not None:
        yield from windows(0, len(linked) - 1, whole_steps("window", options.window, dt))
        return
    changes = np.flatnonzero((linked[1:] != linked[:-1]).any(axis=1)) + 1
    for first, after in pairwise([0, *changes.tolist(), len(linked)]):
        if (after - 1 - first) * dt >= options.min_duration - 1e-6:
            yield first, after - 1


def whole_steps(option: str, seconds: float, dt: float) -> int:
    """How many steps of ``dt`` s an option is long.

    Raises:
        ConfigError: no whole number of them.
    """
    steps = round(seconds / dt)
    if steps < 1 or abs(seconds / dt - steps) > 1e-6 * steps:
        raise ConfigError(f"data.{option}={seconds:g} s is no whole number of steps of {dt:g} s")
    return steps


def check_cutting(options: LaneOptions) -> None:
    """Refuse options of the cutting that are out of their range.

    Raises:
        ConfigError: names the option.
    """
    positive("dt", options.dt)
    if options.min_vehicles < 1 or options.min_samples < 1:
        raise ConfigError("data.min_vehicles and data.min_samples must be at least 1")
    if options.window is not None:
        steps = whole_steps("window", positive("window", options.window), options.dt)
        if steps + 1 < options.min_samples:
            raise ConfigError(
                f"data.window={options.window:g} s has {steps + 1} samples, fewer than "
                f"data.min_samples={options.min_samples}"
            )


def _lanes(options: LaneOptions, table: Trajectories) -> list[str]:
    if table.lane is None and options.lane is not None:
        raise ConfigError(
            f"data.lane={options.lane}, but {table.path} has no lane column; set "
            "data.columns.lane or data.lane=null"
        )
    present = {""} if table.lane is None else set(table.lane)
    return chosen_lanes(options.lane, present, f"{table.path} has")


def chosen_lanes(lane: Any, present: set[str], who: str) -> list[str]:
    """Names of the lanes that ``data.lane`` chooses among those that there are.

    Raises:
        ConfigError: an unknown lane; ``who`` has the lanes that it lists.
    """
    every_lane = sorted(present, key=lambda name: (len(name), name))
    if lane is None:
        return every_lane
    chosen = [lane] if isinstance(lane, str | int | float) else lane
    names = [f"{x:g}" if isinstance(x, int | float) else str(x) for x in chosen]
    for name in names:
        if name not in present:
            raise ConfigError(f"data.lane={name}: {who} the lanes {', '.join(every_lane[:20])}")
    return names


def _platoons(lane: list[Record], options: LaneOptions) -> Iterator[_Platoon]:
    """Vehicles, first and last grid time of every sequence of one lane, in order of time."""
    if not lane:
        return
    if options.pairs:
        pieces, least = _pairs(lane, options), 2
    else:
        pieces = _intervals(lane) if options.window is None else _windows(lane, options)
        least = options.min_vehicles
    for platoon, first, last in pieces:
        if len(platoon) >= least and last - first + 1 >= options.min_samples:
            yield _in_order(platoon, first), first, last


def _in_order(platoon: list[Record], at: int) -> list[Record]:
    return sorted(platoon, key=lambda r: float(r.x[at - r.first, 0]))


def _intervals(every: list[Record]) -> Iterator[_Platoon]:
    changes = sorted({r.first for r in every} | {r.last + 1 for r in every})
    for first, after in pairwise(changes):
        yield [r for r in every if r.first <= first and r.last >= after - 1], first, after - 1


def _pairs(lane: list[Record], options: LaneOptions) -> Iterator[_Platoon]:
    """Followers with their leaders, as long as nobody comes between them, in order of time."""
    stays: dict[tuple[int, int], list[tuple[Record, Record, int, int]]] = {}
    for platoon, first, last in _intervals(lane):
        for follower, leader in pairwise(_in_order(platoon, first)):
            pair_stays = stays.setdefault((id(follower), id(leader)), [])
            if pair_stays and pair_stays[-1][3] + 1 == first:
                first_of_all = pair_stays.pop()[2]
                pair_stays.append((follower, leader, first_of_all, last))
            else:
                pair_stays.append((follower, leader, first, last))
    every = sorted(
        (span for every_stay in stays.values() for span in every_stay), key=lambda span: span[2]
    )
    for follower, leader, first, last in every:
        steps = last - first if options.window is None else round(options.window / options.dt)
        for start, end in windows(first, last, max(steps, 1)):
            yield [follower, leader], start, end


def _windows(lane: list[Record], options: LaneOptions) -> Iterator[_Platoon]:
    assert options.window is not None
    steps = round(options.window / options.dt)
    start, end = min(r.first for r in lane), max(r.last for r in lane)
    # only windows in which somebody is in view: two records may lie years apart
    busy = {
        k
        for r in lane
        for k in range((r.first - start) // steps - 1, (r.last - start) // steps + 1)
    }
    for first in sorted(start + k * steps for k in busy if 0 <= k <= (end - start) // steps - 1):
        last = first + steps
        in_view = [r for r in lane if r.first <= last and r.last >= first]
        whole = _in_order([r for r in in_view if r.first <= first and r.last >= last], first)
        if not whole:
            continue
        x = np.stack([r.x[first - r.first : last - r.first + 1, 0] for r in whole], axis=1)
        broken: set[int] = set()
        for r in in_view:
            if r.first > first or r.last < last:
                a, b = max(first, r.first), min(last, r.last)
                place = r.x[a - r.first : b - r.first + 1]
                behind = (x[a - first : b - first + 1] < place).sum(axis=1)
                broken.update(int(n) for n in behind)
        borders = sorted({0, len(whole)} | broken)
        for low, high in pairwise(borders):
            yield whole[low:high], first, last
