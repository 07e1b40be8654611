"""Reader of a tidy table: one row per sequence, time and agent."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nnode.data.exits import Exit, destinations, exits_of, read_exits
from nnode.data.options import TableOptions
from nnode.data.readers.columns import Table, opened
from nnode.data.readers.recordings import check_known, natural, one_of, table_path, wanted
from nnode.data.readers.vehicles import LENGTH_UNITS, seconds_per_unit
from nnode.data.sequence import Sequence
from nnode.data.smooth import fill
from nnode.errors import ConfigError, DataError

#: Share of the sampling interval by which sampling times may deviate from equal spacing.
UNEVEN = 0.01

#: A sequence's times times its agents, present or not.
MOST_CELLS = 10**8

_REQUIRED = ("sequence", "time", "agent", "x")
_OPTIONAL = ("y", "length", "kind", "group", "dest_x", "dest_y", "recording")
_WALL = ("x1", "y1", "x2", "y2")

#: Keys of the files of a table.
TABLE, WALLS = "table", "walls"


def table_files(options: TableOptions) -> dict[str, Path]:
    """The table's path, and that of the walls where there are such."""
    files = {TABLE: table_path(options, "path", options.path)}
    if options.walls is not None:
        files[WALLS] = table_path(options, "walls", options.walls)
    return files


def read_table(
    source: Path | Table, options: TableOptions, walls: Path | None = None
) -> list[Sequence]:
    """Read a table.

    Args:
        source: CSV or Parquet, or a table that is open, with the columns that
            :class:`TableOptions` lists.
        options: ``domain``, ``recording``, columns and units are read.
        walls: CSV or Parquet with a segment per row, x1, y1, x2, y2 (m).

    Returns:
        Sequences named ``recording/sequence``, in the order of their names, whatever that of the
        rows. An agent that is absent at some times of a sequence is NaN there (see
        :func:`nnode.data.quality.find_faults`), where no row or an empty cell tells its position
        for longer than ``max_hole``. Shorter holes are filled, see :func:`nnode.data.smooth.fill`;
        a platoon begins and ends when all vehicles are there, if that costs no more than
        ``max_hole`` at either end. Vehicles are ordered by their first position, people by name.

    Raises:
        ConfigError: no domain, or an unknown recording.
        DataError: columns or cells that are missing or hold no number (names the row), one
            agent twice at one time, time steps that are no multiples of the usual one, or values
            that change within a sequence although they belong to an agent.
    """
    table = opened(source)
    columns = _columns(table, options)
    asked = wanted(options.recording)
    if asked is not None:
        check_known(asked, columns.recording)
    segments = None if walls is None else _segments(walls)
    groups: dict[tuple[str, str], list[int]] = {}
    for i, key in enumerate(zip(columns.recording, columns.sequence, strict=True)):
        groups.setdefault(key, []).append(i)
    return [
        _sequence(table, columns, key, np.array(rows), options.max_hole, segments)
        for key, rows in sorted(groups.items(), key=lambda item: [*map(natural, item[0])])
        if asked is None or key[0] in asked
    ]


@dataclass(frozen=True)
class _Columns:
    """What the rows of a table say, in SI units.

    Attributes:
        crowd: whether positions have two coordinates.
        recording, sequence, agent: ``(R,)`` names.
        time: ``(R,)`` s.
        values: positions, destinations and lengths, m.
        words: classes and groups.
        exits: destinations of people, where the options give them.
    """

    crowd: bool
    recording: np.ndarray
    sequence: np.ndarray
    agent: np.ndarray
    time: np.ndarray
    values: dict[str, np.ndarray]
    words: dict[str, np.ndarray]
    exits: list[Exit]

    @property
    def axes(self) -> tuple[str, ...]:
        return _axes(self.crowd)


def _axes(crowd: bool) -> tuple[str, ...]:
    return ("x", "y") if crowd else ("x",)


def _columns(table: Table, options: TableOptions) -> _Columns:
    crowd, path = _is_crowd(options), table.path
    names = table.choose(_REQUIRED, _OPTIONAL, options.columns)
    metres = one_of("position_unit", options.position_unit, LENGTH_UNITS)
    if crowd != ("y" in names):
        expected = "x and y" if crowd else "x alone (drop y, or set data.domain=crowd)"
        raise DataError(f"{path}: data.domain={options.domain} needs the positions {expected}")
    goals = tuple(f"dest_{axis}" for axis in _axes(crowd))
    if any(goal in names for goal in goals) and not all(goal in names for goal in goals):
        raise DataError(f"{path}: a destination needs the columns {' and '.join(goals)}")
    exits = read_exits(options.exits)
    if exits and (not crowd or goals[0] in names):
        raise ConfigError(
            "data.exits are for crowds without the columns dest_x and dest_y; leave it out"
        )
    sequence, agent = table.names(names["sequence"]), table.names(names["agent"])
    time = table.times(names["time"], seconds_per_unit(options))[1]
    values = {axis: table.measured(names[axis]) * metres for axis in _axes(crowd)}
    values |= {name: table.numbers(names[name]) * metres for name in goals if name in names}
    if "length" in names:
        values["length"] = table.positive(names["length"]) * metres
    words: dict[str, np.ndarray] = {
        k: table.names(names[k], empty=True) for k in ("kind", "group") if k in names
    }
    if "recording" in names:
        recording = table.names(names["recording"])
    else:
        recording = np.full(len(table), path.stem, dtype=object)
    return _Columns(crowd, recording, sequence, agent, time, values, words, exits)


def _sequence(
    table: Table,
    columns: _Columns,
    key: tuple[str, str],
    index: np.ndarray,
    max_hole: float,
    segments: np.ndarray | None,
) -> Sequence:
    """One sequence of the rows ``index``; ``key`` names its recording and the sequence."""
    run, number = key
    name = number if number.startswith(f"{run}/") else f"{run}/{number}"
    grid, k = _grid(table, name, columns.time, index, max_hole)
    people, n = _people(columns.agent[index])
    if len(grid) * len(people) > MOST_CELLS:
        raise DataError(
            f"{table.path}: sequence {name} has {len(grid)} times and {len(people)} agents in "
            f"{len(index)} rows, expected at most {MOST_CELLS:.0e} times x agents; cut it into "
            "shorter sequences"
        )
    at = np.full((len(grid), len(people)), -1)
    for row, i, j in zip(index, k, n, strict=True):
        if at[i, j] >= 0:
            raise DataError(
                f"{table.path}, {table.row(row)}: agent {columns.agent[row]} of sequence {name} "
                f"stands there a second time at {columns.time[row]:g} s (first in "
                f"{table.row(at[i, j])})"
            )
        at[i, j] = row
    values, words, axes = columns.values, columns.words, columns.axes
    known = _known(at, [values[axis] for axis in axes])
    if not columns.crowd:
        order = np.argsort(values["x"][_ends(known)[0]], kind="stable")
        at, known, people = at[:, order], known[:, order], [people[j] for j in order]
    owner = np.array([column[column >= 0][0] for column in at.T])
    for meaning, column in (*values.items(), *words.items()):
        if meaning not in axes:
            _constant(table, meaning, column, at, owner)
    x = np.stack([np.where(at >= 0, values[axis][at], np.nan) for axis in axes], axis=-1)
    grid, x, filled = _filled(grid, x, max_hole, trim=not columns.crowd)
    length = values["length"][owner] if "length" in values else None
    group = tuple(words["group"][owner]) if "group" in words else None
    goal = None
    if "dest_x" in values:
        goal = np.stack([values[f"dest_{axis}"][owner] for axis in axes], axis=-1)
    elif columns.exits:
        start, end = (np.stack([values[a][i] for a in axes], -1) for i in _ends(known))
        goal = destinations(exits_of(columns.exits, start, end, people, group), start)
    return Sequence(
        name=name,
        recording=run,
        time=grid,
        x=x,
        agents=tuple(people),
        length=None if length is None or np.isnan(length).all() else length,
        kind=tuple(words["kind"][owner]) if "kind" in words else None,
        group=group,
        destination=goal,
        walls=segments,
        filled=filled,
    )


def _known(at: np.ndarray, positions: list[np.ndarray]) -> np.ndarray:
    """Rows by time and agent, -1 where none or one without a position; of an agent who has no
    position at all the rows as they are."""
    known = np.where((at >= 0) & np.isfinite([x[at] for x in positions]).all(axis=0), at, -1)
    return np.where((known >= 0).any(axis=0), known, at)


def _filled(
    grid: np.ndarray, x: np.ndarray, longest: float, trim: bool
) -> tuple[np.ndarray, np.ndarray, int]:
    """Times, positions with short holes filled, and how many were.

    Args:
        trim: whether times at either end go at which not all agents are there, if these are short.
    """
    if not np.isnan(x).any() or len(grid) < 2:
        return grid, x, 0
    step = float(np.median(np.diff(grid)))
    x, filled = fill(x, step, longest)
    present = np.flatnonzero(np.isfinite(x).all(axis=(1, 2)))
    if trim and len(present):
        low, high = int(present[0]), int(present[-1]) + 1
        most = longest / step + 1e-6
        low, high = low if low <= most else 0, high if len(grid) - high <= most else len(grid)
        grid, x, filled = grid[low:high], x[low:high], filled[low:high]
    return grid, x, int(filled.sum())


def _ends(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every agent's first and last row in the table, of those at its times (-1: none)."""
    known = [column[column >= 0] for column in at.T]
    return np.array([rows[0] for rows in known]), np.array([rows[-1] for rows in known])


def _is_crowd(options: TableOptions) -> bool:
    if options.domain not in ("traffic", "crowd"):
        raise ConfigError(
            f"data.domain={options.domain}: expected traffic (positions x) or crowd (x and y)"
        )
    return options.domain == "crowd"


def _people(agent: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Distinct agents in order of their names, and each row's number among them."""
    names = sorted(set(agent), key=natural)
    number = {name: i for i, name in enumerate(names)}
    return names, np.array([number[name] for name in agent])


def _grid(
    table: Table, name: str, time: np.ndarray, rows: np.ndarray, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sampling times of a sequence, and each row's number among them.

    Times that all agents lack are added where no more than ``longest`` s are missing. A longer hole
    stays: it is a fault of the sequence, see :func:`nnode.data.quality.find_faults`.
    """
    # Agents' rows may differ in the last digits of a time that is meant to be the same.
    unique, first, code = np.unique(np.round(time[rows], 9), return_index=True, return_inverse=True)
    step = np.diff(unique)
    if step.size:
        usual = float(np.median(step))
        uneven = np.flatnonzero(
            np.abs(step - usual * np.maximum(np.round(step / usual), 1)) > UNEVEN * usual
        )
        if uneven.size:
            k = int(uneven[0])
            raise DataError(
                f"{table.path}, {table.row(rows[first[k + 1]])}: sequence {name} steps from "
                f"{unique[k]:g} s to {unique[k + 1]:g} s, expected steps of {usual:g} s; "
                "interpolate it to equal steps or cut it there into two sequences"
            )
        number = np.round(step / usual)
        more = np.where((number - 1) * usual <= longest + 1e-6, number - 1, 0).astype(int)
        if more.any():
            place = np.arange(len(unique)) + np.concatenate([[0], np.cumsum(more)])
            return np.interp(np.arange(place[-1] + 1), place, unique), place[code]
    return unique, code


def _constant(
    table: Table, key: str, column: np.ndarray, at: np.ndarray, owner: np.ndarray
) -> None:
    """Refuse a property of an agent that changes within a sequence."""
    value, own = column[at], column[owner]
    differs = (value != own) & (at >= 0)
    if value.dtype.kind == "f":
        differs &= ~(np.isnan(value) & np.isnan(own))
    if differs.any():
        row = int(at[differs].min())
        raise DataError(
            f"{table.path}, {table.row(row)}: column {key!r} holds {column[row]!s}; it belongs "
            "to the agent and must be the same in all its rows of a sequence"
        )


def _segments(path: Path) -> np.ndarray:
    table = Table(path)
    table.choose(_WALL)
    walls = np.stack([table.numbers(name) for name in _WALL], axis=-1)
    point = (walls[:, :2] == walls[:, 2:]).all(axis=1)
    if point.any():
        row = table.row(int(np.flatnonzero(point)[0]))
        raise DataError(f"{path}, {row}: a wall that begins where it ends has no sides")
    return walls
