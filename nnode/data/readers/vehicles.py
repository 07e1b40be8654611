"""Reader of vehicle tables: one row per vehicle and time, as video recordings give them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from nnode.data.cut import LaneOptions, Reading, by_lane, check_cutting
from nnode.data.readers.columns import ColumnOptions, Table, opened, table_rows
from nnode.data.readers.recordings import table_path
from nnode.data.sequence import check_interval
from nnode.errors import ConfigError

REQUIRED = ("vehicle", "time", "x")
OPTIONAL = ("lane", "speed", "length", "kind", "recording", "sequence")


@dataclass
class VehicleTableOptions(ColumnOptions, LaneOptions):
    """A table with one row per vehicle and time (CSV or Parquet).

    ``columns`` names the table's columns by what they mean: ``vehicle``, ``time``, ``x``, and
    where they exist ``lane``, ``speed``, ``length``, ``kind``, ``recording``, ``sequence``.
    Vehicles of two recordings or sequences never meet. A column that bears the name of its meaning
    need not be listed; null leaves an optional one out.
    """

    name: str = "vehicles"
    length_unit: str | None = None  # null: the unit of the positions
    speed_unit: str = "m/s"  # m/s | km/h | ft/s | mph
    direction: int = 1  # -1 where positions fall as vehicles drive on


def vehicle_files(options: LaneOptions, table: Table | None = None) -> dict[str, Path | Table]:
    """The table, or its path."""
    if table is not None:
        return {table.path.stem: table}
    path = table_path(options)
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
