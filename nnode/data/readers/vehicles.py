"""Reader of vehicle tables: one row per vehicle and time, as video recordings give them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from nnode.data.cut import Reading, by_lane, check_cutting
from nnode.data.options import (
    LaneOptions,
    PairOptions,
    TableOptions,
    VehicleTableOptions,
    WalkwayOptions,
    one_of,
    positive,
)
from nnode.data.readers.columns import Table, opened
from nnode.data.readers.recordings import table_path
from nnode.data.sequence import TIME_UNITS, check_interval
from nnode.data.trajectories import Trajectories
from nnode.errors import ConfigError

#: Metres per unit of length.
LENGTH_UNITS = {"m": 1.0, "ft": 0.3048, "cm": 0.01, "km": 1000.0}
#: Metres per second per unit of speed.
SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "ft/s": 0.3048, "mph": 0.44704}

REQUIRED = ("vehicle", "time", "x")
OPTIONAL = ("lane", "speed", "length", "kind", "recording", "sequence")


def vehicle_files(options: LaneOptions, table: Table | None = None) -> dict[str, Path | Table]:
    """The table, or its path."""
    if table is not None:
        return {table.path.stem: table}
    path = table_path(options, "path", options.path)
    return {path.stem: path}


def read_vehicles(source: Path | Table, options: VehicleTableOptions) -> Reading:
    """Read a table and cut it into sequences, see :func:`nnode.data.cut.by_lane`.

    Args:
        source: CSV or Parquet, or a table that is open.
        options: columns, units, lanes, time grid and the way of cutting.

    Raises:
        ConfigError: an option out of its range, an unknown lane or recording.
        DataError: columns or cells that are missing or hold no number (names the row), one
            vehicle twice at one time, or no sequence at all.
    """
    if options.direction not in (1, -1):
        raise ConfigError(f"data.direction={options.direction}: expected 1 or -1")
    check_cutting(options)
    table = opened(source)
    rows = table_rows(table, table.choose(REQUIRED, OPTIONAL, options.columns), options)
    rows = replace(rows, x=options.direction * rows.x)
    check_interval(rows.dt, f"{table.path}: rows of a vehicle")
    return by_lane(rows, options)


def seconds_per_unit(
    options: VehicleTableOptions | TableOptions | PairOptions | WalkwayOptions,
) -> float:
    """Seconds in a unit of a table's times.

    Raises:
        ConfigError: an unknown unit, or frames without their rate.
    """
    scale = one_of("time_unit", options.time_unit, {**TIME_UNITS, "frame": np.nan})
    if options.time_unit == "frame":
        scale = 1.0 / positive("frame_rate", options.frame_rate)
    return scale


def table_rows(
    table: Table,
    names: Mapping[str, str],
    options: VehicleTableOptions | TableOptions | WalkwayOptions,
    axes: tuple[str, ...] = ("x",),
) -> Trajectories:
    """The columns of any table, by what they mean.

    Rows of different recordings, or of different sequences, never meet: both are the name of the
    recording.

    Args:
        names: of the columns by their meaning.
        axes: meanings of the positions' columns.

    Raises:
        ConfigError: an unknown unit.
        DataError: cells that are missing or hold no number; names the row.
    """
    metres = one_of("position_unit", options.position_unit, LENGTH_UNITS)

    def words(key: str) -> np.ndarray | None:
        return table.names(names[key], empty=True) if key in names else None

    v = length = recording = None
    if "speed" in names and isinstance(options, VehicleTableOptions):
        unit = one_of("speed_unit", options.speed_unit, SPEED_UNITS)
        v = np.abs(table.numbers(names["speed"]))[:, None] * unit
    if "length" in names:
        own_unit = getattr(options, "length_unit", None) or options.position_unit
        length = table.positive(names["length"]) * one_of("length_unit", own_unit, LENGTH_UNITS)
    parts = [table.names(names[key]) for key in ("recording", "sequence") if key in names]
    if parts:
        recording = np.array([" ".join(cells) for cells in zip(*parts, strict=True)], dtype=object)
    return Trajectories(
        path=table.path,
        name=table.path.stem,
        where=table.row,
        agent=table.names(names["vehicle" if "vehicle" in names else "agent"]),
        time=table.times(names["time"], seconds_per_unit(options))[1],
        x=np.stack([table.measured(names[axis]) for axis in axes], -1) * metres,
        v=v,
        recording=recording,
        lane=table.names(names["lane"]) if "lane" in names else None,
        length=length,
        kind=words("kind"),
        group=words("group"),
    )
