"""Reader of vehicle tables: one row per vehicle and time, as video recordings give them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.data.options import LaneOptions, TableOptions, VehicleTableOptions
from nnode.data.readers.columns import Table, opened
from nnode.data.readers.platoons import Vehicles, check_cutting, cut_vehicles
from nnode.data.readers.recordings import one_of, positive, table_path
from nnode.data.sequence import TIME_UNITS, Sequence, check_interval
from nnode.errors import ConfigError, DataError

#: Metres per unit of length.
LENGTH_UNITS = {"m": 1.0, "ft": 0.3048, "cm": 0.01, "km": 1000.0}
#: Metres per second per unit of speed.
SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "ft/s": 0.3048, "mph": 0.44704}

#: Times are counted in steps up to this number: it is exact, and adding to it as well.
_LATEST = 2.0**52

_REQUIRED = ("vehicle", "time", "x")
_OPTIONAL = ("lane", "speed", "length", "kind", "recording")


def vehicle_files(options: LaneOptions) -> dict[str, Path]:
    """The table's path."""
    path = table_path(options, "path", options.path)
    return {path.stem: path}


def read_vehicles(source: Path | Table, options: VehicleTableOptions) -> list[Sequence]:
    """Read a table and cut it into sequences, see :func:`nnode.data.readers.platoons.cut_vehicles`.

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
    rows = _rows(table, options)
    column = table.choose(_REQUIRED, _OPTIONAL, options.columns).get("recording")
    recording = np.zeros(len(rows.time)) if column is None else table.names(column)
    order = np.lexsort((rows.time, rows.vehicle.astype(str), recording.astype(str)))
    same = rows.vehicle[order][1:] == rows.vehicle[order][:-1]
    step = np.diff(rows.time[order])[same & (recording[order][1:] == recording[order][:-1])]
    step = step[step > 0]
    if step.size:
        check_interval(float(np.median(step)), f"{table.path}: rows of a vehicle")
    if column is None:
        return cut_vehicles({table.path.stem: rows}, options)
    parts = {name: _part(rows, recording == name) for name in pd.unique(recording)}
    return cut_vehicles(parts, options)


def _part(rows: Vehicles, chosen: np.ndarray) -> Vehicles:
    """Some of the rows."""
    number = np.flatnonzero(chosen)
    cells = ("vehicle", "time", "x", "lane", "speed", "length", "kind")
    own: dict[str, Any] = {
        key: None if getattr(rows, key) is None else getattr(rows, key)[number] for key in cells
    }
    return Vehicles(path=rows.path, row=lambda i: rows.row(int(number[i])), **own)


def seconds_per_unit(options: VehicleTableOptions | TableOptions) -> float:
    """Seconds in a unit of a table's times.

    Raises:
        ConfigError: an unknown unit, or frames without their rate.
    """
    scale = one_of("time_unit", options.time_unit, {**TIME_UNITS, "frame": np.nan})
    if options.time_unit == "frame":
        scale = 1.0 / positive("frame_rate", options.frame_rate)
    return scale


def _seconds(table: Table, column: str, options: VehicleTableOptions) -> np.ndarray:
    dates = table.instants(column)
    if dates is None:  # numbers keep their origin, with which the time grid begins
        time = table.numbers(column) * seconds_per_unit(options)
    else:
        time = (dates - dates.min()) / 1e9
    far = np.flatnonzero(~(np.abs(time) < _LATEST * options.dt))
    if far.size:
        raise DataError(
            f"{table.path}, {table.row(int(far[0]))}: column {column!r} is the time "
            f"{time[far[0]]:g} s, which steps of {options.dt:g} s cannot count; "
            "correct it, or data.time_unit"
        )
    return time


def _rows(table: Table, options: VehicleTableOptions) -> Vehicles:
    """The table's columns, by what they mean."""
    names = table.choose(_REQUIRED, _OPTIONAL, options.columns)
    metres = one_of("position_unit", options.position_unit, LENGTH_UNITS)
    length_unit = options.length_unit or options.position_unit
    speed = length = None
    if "speed" in names:
        scale = one_of("speed_unit", options.speed_unit, SPEED_UNITS)
        speed = np.abs(table.numbers(names["speed"])) * scale
    if "length" in names:
        scale = one_of("length_unit", length_unit, LENGTH_UNITS)
        length = table.positive(names["length"]) * scale
    return Vehicles(
        path=table.path,
        row=table.row,
        vehicle=table.names(names["vehicle"]),
        time=_seconds(table, names["time"], options),
        x=table.numbers(names["x"]) * metres * options.direction,
        lane=table.names(names["lane"]) if "lane" in names else None,
        speed=speed,
        length=length,
        kind=table.names(names["kind"], empty=True) if "kind" in names else None,
    )
