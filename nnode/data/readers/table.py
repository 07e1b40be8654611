"""Reader of a tidy table: one row per sequence, time and agent."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import MISSING

from nnode.data.cut import Reading, by_sequence
from nnode.data.exits import exits_of, read_exits
from nnode.data.options import DataOptions, chosen
from nnode.data.readers.columns import ColumnOptions, Table, opened, table_rows
from nnode.data.readers.recordings import natural, table_path
from nnode.data.sequence import LENGTH_UNITS
from nnode.data.trajectories import Trajectories, group_numbers, grouped_rows
from nnode.errors import ConfigError, DataError

REQUIRED = ("sequence", "time", "agent", "x")
OPTIONAL = ("y", "length", "kind", "group", "dest_x", "dest_y", "recording")
_WALL = ("x1", "y1", "x2", "y2")

#: Keys of the files of a table.
TABLE, WALLS = "table", "walls"


@dataclass
class TableOptions(ColumnOptions, DataOptions):
    """A user's own tidy table (CSV or Parquet), one row per sequence, time and agent.

    ``columns`` names the table's columns by what they mean: ``sequence``, ``time``, ``agent``,
    ``x``, and where they exist ``y``, ``length``, ``kind``, ``group``, ``dest_x``, ``dest_y``,
    ``recording``. A column that bears the name of its meaning need not be listed; null leaves an
    optional one out.
    """

    name: str = "table"
    path: str = MISSING  # the table; relative to data.source where that is given
    walls: str | None = None  # CSV with x1, y1, x2, y2 (m), the walkable side on the left
    # {name: {line: [x1, y1, x2, y2], direction: +x, group: NAME}}, m: destinations on exit lines,
    # in place of the columns dest_x, dest_y
    exits: Any = None


def table_files(options: TableOptions, table: Table | None = None) -> dict[str, Path | Table]:
    """The table, or its path, and the path of the walls where there are such."""
    files = {TABLE: table or table_path(options)}
    if options.walls is not None:
        files[WALLS] = table_path(options, "walls")
    return files


def read_table(source: Path | Table, options: TableOptions, walls: Path | None = None) -> Reading:
    """Read a table.

    Args:
        source: CSV or Parquet, or a table that is open, with the columns that
            :class:`TableOptions` lists.
        options: ``domain``, ``recording``, columns and units are read.
        walls: CSV or Parquet with a segment per row, x1, y1, x2, y2 (m).

    Returns:
        Sequences named ``recording/sequence``, in the order of their names, whatever that of the
        rows. Samples without a row, or with an empty cell, are filled where no more than ``fill`` s
        are missing, and uneven times are interpolated, see
        :func:`nnode.data.trajectories.records`. A platoon is cut into the parts in which all its
        vehicles are there, with a number behind the name where there are several; where these are
        never there together, a vehicle without a position is NaN. A crowd is cut where nobody is
        there; a person who is absent at other times is NaN there (see
        :func:`nnode.data.quality.find_faults`). Vehicles are ordered by position, people by name.

    Raises:
        ConfigError: no domain, or an unknown recording.
        DataError: columns or cells that are missing or hold no number (names the row), one
            agent twice at one time, or values that change within a sequence although they belong
            to an agent.
    """
    rows = _rows(opened(source), options)
    assert rows.recording is not None
    asked = chosen(options.recording, rows.recording)
    rows = rows.at(np.flatnonzero(np.isin(rows.recording, asked)))
    segments = None if walls is None else _segments(walls)
    sequences = by_sequence(rows, options, natural)
    sequences[:] = [replace(s, walls=segments) for s in sequences]
    return sequences


def _rows(table: Table, options: TableOptions) -> Trajectories:
    """The table's columns, by what they mean."""
    crowd, path = _is_crowd(options), table.path
    axes = ("x", "y") if crowd else ("x",)
    names = table.choose(REQUIRED, OPTIONAL, options.columns)
    if crowd != ("y" in names):
        expected = "x and y" if crowd else "x alone (drop y, or set data.domain=crowd)"
        raise DataError(f"{path}: data.domain={options.domain} needs the positions {expected}")
    goals = tuple(f"dest_{axis}" for axis in axes)
    if any(goal in names for goal in goals) and not all(goal in names for goal in goals):
        raise DataError(f"{path}: a destination needs the columns {' and '.join(goals)}")
    sequence = table.names(names.pop("sequence"))
    recording = names.pop("recording", "")
    rows = table_rows(table, names, options, axes)
    destination = None
    if goals[0] in names:
        metres = LENGTH_UNITS[options.position_unit]
        destination = np.stack([table.numbers(names[goal]) for goal in goals], -1) * metres
    rows = replace(
        rows,
        recording=table.names(recording)
        if recording
        else np.full(len(table), path.stem, dtype=object),
        sequence=sequence,
        destination=destination,
    )
    belongings = {key: getattr(rows, key) for key in ("length", "kind", "group")}
    if destination is not None:
        belongings |= dict(zip(goals, destination.T, strict=True))
    whose = rows.recording, sequence, rows.agent
    owner = group_numbers(*whose)
    rule = "it belongs to the agent and must be the same in all its rows of a sequence"
    for key, values in belongings.items():
        if values is not None:
            table.check_constant(names[key], values, owner, rule)
    if options.exits:
        if not crowd or destination is not None:
            raise ConfigError(
                "data.exits are for crowds without the columns dest_x and dest_y; leave it out"
            )
        destination, people = np.empty_like(rows.x), grouped_rows(*whose, time=rows.time)
        exits = exits_of(read_exits(options.exits), rows, people)
        for of_person, (start, exit_) in zip(people, exits, strict=True):
            destination[of_person] = exit_.point(rows.x[start])
        rows = replace(rows, destination=destination)
    return rows


def _is_crowd(options: TableOptions) -> bool:
    if options.domain not in ("traffic", "crowd"):
        raise ConfigError(
            f"data.domain={options.domain}: expected traffic (positions x) or crowd (x and y)"
        )
    return options.domain == "crowd"


def _segments(path: Path) -> np.ndarray:
    table = Table(path)
    table.choose(_WALL)
    walls = np.stack([table.numbers(name) for name in _WALL], axis=-1)
    point = (walls[:, :2] == walls[:, 2:]).all(axis=1)
    table.refuse(point, lambda _: "a wall that begins where it ends has no sides")
    return walls
