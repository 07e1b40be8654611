"""Sequences cut from trajectories: by lane, sequence, pair, spacing or presence.

By lane follows Section 4.2 of the calibration paper: every lane by itself, the lateral coordinate
dropped, and sequences in which the same vehicles are in view. All ways end in
:func:`sequence_of`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Sequence as ListLike
from dataclasses import dataclass, field, replace
from itertools import chain, compress, pairwise
from typing import Any

import numpy as np
from omegaconf import MISSING

from nnode.data.options import Agents, DataOptions, chosen, positive
from nnode.data.sequence import Sequence
from nnode.data.trajectories import (
    Grid,
    Record,
    Trajectories,
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


class Reading(list[Sequence]):
    """Sequences of a reader, with what it left out and what it changed.

    Attributes:
        left_out: ``name`` and ``why`` of each record of which there is no sequence.
        notes: sentences about what was interpolated or cut.
    """

    def __init__(
        self,
        sequences: Iterable[Sequence] = (),
        notes: Iterable[str] = (),
    ) -> None:
        super().__init__(sequences)
        self.left_out: list[dict[str, str]] = []
        self.notes = list(notes)

    def add(self, other: Reading) -> None:
        """Append what another file gave."""
        self += other
        self.left_out += other.left_out
        self.notes += other.notes


@dataclass
class LaneOptions(DataOptions):
    """How vehicles' rows become platoons, whatever file they come from."""

    domain: str = "traffic"
    path: str = MISSING  # the file; relative to data.source where that is given
    kinds: Any = field(default_factory=dict)  # {class code: name}; codes may be numbers
    lane: Any = None  # a lane or a list of lanes; null takes every lane, each by itself
    dt: float = 0.2  # reference time grid, s
    min_vehicles: int = 3  # fewest vehicles of a platoon
    min_samples: int = 3  # fewest points of the time grid
    window: float | None = None  # s; null: maximal intervals with the same vehicles in view
    # whether every follower and its leader are a sequence of their own, min_vehicles aside
    pairs: bool = False


#: Agents' records, and the first and the last time of their sequence.
_Platoon = tuple[list[Record], int, int]


@dataclass
class Member:
    """An agent of a sequence: its name, a row of the table with its properties, its records."""

    agent: str
    row: int
    records: list[Record] = field(default_factory=list)


def members(table: Trajectories, agent_records: Iterable[Record]) -> list[Member]:
    """Every agent that the rows name, in order of names as text, with its records."""
    names, rows = np.unique(table.agent.astype(str), return_index=True)
    by_name = {n: Member(n, row) for n, row in zip(names.tolist(), rows.tolist(), strict=True)}
    for record in agent_records:
        by_name[record.agent].records.append(record)
    return list(by_name.values())


def sequence_of(
    name: str,
    table: Trajectories,
    of: ListLike[Member | Record],
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


def kinds_of(codes: np.ndarray, names: Any) -> np.ndarray:
    """Names of classes by their codes; a code without a name is its own."""
    name_of = {str(code): str(name) for code, name in dict(names).items()}
    return np.array([name_of.get(str(code), str(code)) for code in codes], dtype=object)


def uneven_text(agent_records: Iterable[Record], dt: float) -> list[str]:
    """A sentence about records with uneven times, if any."""
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
    lane_names, grid = _lanes(options, table), Grid(options.dt)
    if table.kind is not None:
        table = replace(table, kind=kinds_of(table.kind, options.kinds))
    lanes: dict[str, tuple[str, Trajectories, list[Record]]] = {}
    notes: list[str] = []
    for (recording,), rows in table.parts("recording"):
        stem = recording or table.name
        reused = stem if options.agents is Agents.auto else ""
        every = records(rows, grid, fill=options.fill, smoothing=options.smooth, reused=reused)
        notes += [f"{stem}: {text}" for text in uneven_text(every, grid.dt)]
        present = {""} if rows.lane is None else set(rows.lane)
        for lane in (name for name in lane_names if name in present):
            lane_records = [r for r in every if rows.lane is None or rows.lane[r.row] == lane]
            lanes[f"{stem}_{lane_word}{lane}" if lane else stem] = stem, rows, lane_records
    lanes = {name: lanes[name] for name in chosen(options.recording, lanes)}
    sequences = []
    for name, (stem, rows, lane_records) in lanes.items():
        for number, (platoon, first, last) in enumerate(_platoons(lane_records, options)):
            full_name = f"{name}/{number:03d}"
            sequences.append(
                sequence_of(full_name, rows, platoon, first, last, grid, recording=name, site=stem)
            )
    if not sequences:
        vehicles = {r.agent for _, _, lane_records in lanes.values() for r in lane_records}
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
        reading += numbered_parts(name, rows, orders, parts, grid, **fields)
    reading.notes = uneven_text(every, table.dt) + notes[:LISTED]
    if len(notes) > LISTED:
        reading.notes.append(f"and {len(notes) - LISTED} more such sequences")
    return reading


def numbered_parts(
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
    min_agents: int = 1,
    axis: int = 0,
    view: tuple[float, float] | None = None,
) -> Iterator[_Platoon]:
    """Consecutive windows, each with those who are there throughout.

    Windows begin with the first record and share their boundary sample.

    Args:
        steps: of a window.
        min_agents: fewest agents.
        axis, view: m, whoever is there is within these ends of a coordinate at all times.
    """
    if not every:
        return
    begin = np.array([record.first for record in every])
    end = np.array([record.last for record in every])
    for first in _starts(every, steps):
        last = first + steps
        present = [every[i] for i in np.flatnonzero((begin <= first) & (end >= last))]
        if view is not None:
            low, high = view
            paths = [r.x[first - r.first : last - r.first + 1, axis] for r in present]
            inside = [low <= path.min() and path.max() <= high for path in paths]
            present = list(compress(present, inside))
        if len(present) >= min_agents:
            yield present, first, last


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
    asked = [lane] if isinstance(lane, str | int | float) else lane
    names = [f"{x:g}" if isinstance(x, int | float) else str(x) for x in asked]
    for name in names:
        if name not in present:
            raise ConfigError(f"data.lane={name}: {who} the lanes {', '.join(every_lane[:20])}")
    return names


def _platoons(lane: list[Record], options: LaneOptions) -> Iterator[_Platoon]:
    """Vehicles, first and last grid time of every sequence of one lane, in order of time."""
    if not lane:
        return
    if options.pairs:
        pieces, min_vehicles = _pairs(lane, options), 2
    else:
        pieces = _intervals(lane) if options.window is None else _windows(lane, options)
        min_vehicles = options.min_vehicles
    for platoon, first, last in pieces:
        if len(platoon) >= min_vehicles and last - first + 1 >= options.min_samples:
            yield _in_order(platoon, first), first, last


def _in_order(platoon: list[Record], at: int) -> list[Record]:
    return sorted(platoon, key=lambda r: float(r.x[at - r.first, 0]))


def _intervals(every: list[Record]) -> Iterator[_Platoon]:
    changes = sorted({r.first for r in every} | {r.last + 1 for r in every})
    for first, after in pairwise(changes):
        yield [r for r in every if r.first <= first and r.last >= after - 1], first, after - 1


def _pairs(lane: list[Record], options: LaneOptions) -> Iterator[_Platoon]:
    """Followers with their leaders, as long as nobody comes between them, in order of time."""
    stays: dict[tuple[int, int], list[tuple[list[Record], int, int]]] = {}
    for platoon, first, last in _intervals(lane):
        for pair in map(list, pairwise(_in_order(platoon, first))):
            of_pair = stays.setdefault((id(pair[0]), id(pair[1])), [])
            begin = of_pair.pop()[1] if of_pair and of_pair[-1][2] + 1 == first else first
            of_pair.append((pair, begin, last))
    for pair, first, last in sorted(chain(*stays.values()), key=lambda stay: stay[1]):
        steps = last - first if options.window is None else round(options.window / options.dt)
        for start, end in windows(first, last, max(steps, 1)):
            yield pair, start, end


def _starts(every: list[Record], steps: int) -> list[int]:
    """Starts of the consecutive windows that lie within a record.

    They count from the first record's start. All windows would be too many, as two records may lie
    years apart.
    """
    low = min(record.first for record in every)
    return sorted(
        {
            low + k * steps
            for record in every
            for k in range(-((low - record.first) // steps), (record.last - low) // steps)
        }
    )


def _windows(lane: list[Record], options: LaneOptions) -> Iterator[_Platoon]:
    assert options.window is not None
    steps = round(options.window / options.dt)
    for present, first, last in by_presence(lane, steps):
        whole = _in_order(present, first)
        x = np.stack([r.x[first - r.first : last - r.first + 1, 0] for r in whole], axis=1)
        broken: set[int] = set()
        for r in lane:
            a, b = max(first, r.first), min(last, r.last)
            if a <= b and (a, b) != (first, last):  # in view for a part of the window
                place = r.x[a - r.first : b - r.first + 1]
                behind = (x[a - first : b - first + 1] < place).sum(axis=1)
                broken.update(int(n) for n in behind)
        borders = sorted({0, len(whole)} | broken)
        for low, high in pairwise(borders):
            yield whole[low:high], first, last
