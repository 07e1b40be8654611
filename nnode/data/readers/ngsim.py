"""Reader of NGSIM's public vehicle trajectories, as they are published.

One row per vehicle and tenth of a second: feet, feet per second, milliseconds. The file of the
U.S. DOT's portal names its columns and holds several locations; the older files of single
quarters of an hour have the same columns without names, and no location.

Source: U.S. Department of Transportation, Next Generation Simulation (NGSIM) Vehicle Trajectories
and Supporting Data, doi 10.21949/1504477, with its dictionary of columns.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nnode.data.cut import LaneOptions, Reading, by_lane, check_cutting
from nnode.data.readers.columns import EXACT, Table
from nnode.data.readers.vehicles import VehicleTableOptions, read_vehicles
from nnode.data.sequence import LENGTH_UNITS
from nnode.data.trajectories import Trajectories
from nnode.errors import DataError

log = logging.getLogger(__name__)

FOOT = LENGTH_UNITS["ft"]

_HEAD = [
    *("Vehicle_ID", "Frame_ID", "Total_Frames", "Global_Time"),
    *("Local_X", "Local_Y", "Global_X", "Global_Y"),
    *("v_Length", "v_Width", "v_Class", "v_Vel", "v_Acc", "Lane_ID"),
]
_TAIL = ["Preceding", "Following", "Space_Headway", "Time_Headway"]
#: What only streets with intersections have, which are not read.
_STREET = ["O_Zone", "D_Zone", "Int_ID", "Section_ID", "Direction", "Movement"]

#: Columns of a file without a line of names, by their number.
LAYOUTS = {
    len(names): names
    for names in (
        [*_HEAD, *_TAIL],
        [*_HEAD, *_TAIL, "Location"],
        [*_HEAD, *_STREET, *_TAIL],
        [*_HEAD, *_STREET, *_TAIL, "Location"],
    )
}

#: Columns by their name in small letters: files differ in capitals.
_KNOWN = {name.lower(): name for names in LAYOUTS.values() for name in names}
_NEEDED = ("Vehicle_ID", "Frame_ID", "Global_Time", "Local_Y", "Lane_ID")
_USED = ("v_Vel", "v_Length", "v_Class", "Direction", "Location")

#: Columns of the reconstructed table that some have in place of the public file, in SI units.
RECONSTRUCTED = {
    "vehicle": "veh",
    "time": "t",
    "lane": "lane",
    "x": "x",
    "speed": "v",
    "length": "length",
    "kind": "cls",
}

#: The starts of a location's periods are a quarter of an hour apart or more, those that the rows
#: of one period tell differ by rounding: half of it (ms) parts them.
APART = 7.5 * 60e3

#: Hours by which the clocks of both freeways, in April and June, were behind UTC.
BEHIND_UTC = 7


@dataclass
class NgsimOptions(LaneOptions):
    """NGSIM's public trajectories of freeways, in feet and ms, as they are published."""

    name: str = "ngsim"


def read_ngsim(path: Path, options: NgsimOptions) -> Reading:
    """Read a file and cut it, see :func:`nnode.data.cut.by_lane`.

    Args:
        path: CSV, Parquet, or text with blanks between the cells.
        options: lanes, time grid, way of cutting, smoothing.

    Returns:
        Sequences named ``recording/number``. A recording is a lane of one period of one location,
        ``i-80_1600_lane2``: identifiers and frames start again in every period, which is called
        by the local time of its first frame, to five minutes. Times are those since that frame
        0, in s. Files without locations bear their own name there. Rows of streets with
        intersections are left out, as the signals there are not in the data.

    Raises:
        ConfigError: an option out of its range, an unknown lane or recording.
        DataError: columns or cells that are missing or hold no number (names the row), one
            vehicle twice at one time in different places, or no sequence at all.
    """
    path = Path(path)
    check_cutting(options)
    table = _table(path)
    if set(RECONSTRUCTED.values()) <= set(table.frame.columns):
        return read_vehicles(
            path, VehicleTableOptions(**{**vars(options), "columns": dict(RECONSTRUCTED)})
        )
    return by_lane(_periods(table), options)


def _table(path: Path) -> Table:
    """The file as a table, its columns named as in ``LAYOUTS`` whatever their capitals."""
    names: list[str] | None = None
    how: dict[str, Any] = {}
    cells: list[str] = []
    if path.suffix.lower() not in (".parquet", ".pq") and path.is_file():
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            first = next((line for line in file if line.strip()), "")
        separated = "," in first
        cells = first.split(",") if separated else first.split()
        how = {"sep": ","} if separated else {"sep": r"\s+"}
        if cells and _is_number(cells[0]):
            names = LAYOUTS.get(len(cells))
            if names is None:
                raise DataError(
                    f"{path} has {len(cells)} columns without names; NGSIM's files have "
                    f"{', '.join(map(str, LAYOUTS))}: set data=vehicles for a table of your own"
                )
    if set(_NEEDED) <= {_KNOWN.get(cell.strip().lower(), "") for cell in names or cells}:
        how["usecols"] = lambda name: _KNOWN.get(name.strip().lower()) in (*_NEEDED, *_USED)
    # the portal has written 6042842.1 as "6,042,842.1" at times
    table = Table(path, names, thousands=",", **how)
    table.rename([_KNOWN.get(name.lower(), name) for name in table.frame.columns])
    return table


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _periods(table: Table) -> Trajectories:
    """The rows, every period of every location a recording."""
    held = set(table.frame.columns)
    lacking = [name for name in _NEEDED if name not in held]
    if lacking:
        raise DataError(
            f"{table.path} lacks {', '.join(lacking)} of NGSIM's columns; it has: "
            f"{', '.join(table.frame.columns)}; for a table of your own set data=vehicles and "
            "data.columns"
        )
    number = {name: table.numbers(name) for name in _NEEDED}
    for name in ("v_Vel", "v_Length", "v_Class", "Direction"):
        if name in held:
            number[name] = table.numbers(name, empty=True)
    if np.isnan(number.get("v_Vel", np.nan)).any():
        number.pop("v_Vel", None)
    place = (
        table.names("Location")
        if "Location" in held
        else np.full(len(table), table.path.stem, dtype=object)
    )
    roads = _roads(table, place, number.pop("Direction", None))
    start = number["Global_Time"] - 100 * number["Frame_ID"]  # ms at frame 0
    odd = np.flatnonzero(~(np.abs(start) < EXACT))
    if odd.size:
        raise DataError(
            f"{table.path}, {table.row(int(odd[0]))}: Global_Time and Frame_ID put frame 0 at "
            f"{start[odd[0]]:g} ms since 1970; correct them"
        )
    periods: dict[str, np.ndarray] = {}
    for location in dict.fromkeys(place[roads]):
        at_location = roads[place[roads] == location]
        at_location = at_location[np.argsort(start[at_location], kind="stable")]
        breaks = np.flatnonzero(np.diff(start[at_location]) > APART) + 1
        for rows in np.split(at_location, breaks):
            name = called = f"{location}_{_clock(start[rows[0]])}"
            while name in periods:  # of another day
                name = f"{called}-{1 + sum(period.startswith(called) for period in periods)}"
            rows = np.sort(rows)
            same = np.stack([number[needed][rows] for needed in _NEEDED], axis=1)
            # rows that stand there twice are taken once
            periods[name] = rows[np.sort(np.unique(same, axis=0, return_index=True)[1])]
    return _vehicles(table, number, periods, start)


def _roads(table: Table, place: np.ndarray, direction: np.ndarray | None) -> np.ndarray:
    """Rows of freeways; only streets tell in which direction a vehicle drives."""
    if direction is None:
        return np.arange(len(table))
    street = direction > 0
    names = ", ".join(dict.fromkeys(place[street]))
    if street.all():
        raise DataError(
            f"{table.path} holds streets with intersections alone ({names}); only NGSIM's "
            "freeways, i-80 and us-101, are read"
        )
    if street.any():
        log.info(
            "%s: %d rows of streets with intersections (%s) are left out",
            table.path.name,
            street.sum(),
            names,
        )
    return np.flatnonzero(~street)


def _clock(start: float) -> str:
    minutes = round(start / 60e3 / 5) * 5 - 60 * BEHIND_UTC
    return f"{minutes // 60 % 24:02d}{minutes % 60:02d}"


def _vehicles(
    table: Table, number: dict[str, np.ndarray], periods: dict[str, np.ndarray], start: np.ndarray
) -> Trajectories:
    """Periods in SI units, times since frame 0 of each.

    Args:
        periods: rows by the period's name.
        start: ms, of frame 0 by the row.
    """
    rows = np.concatenate(list(periods.values()))
    origin = np.concatenate(
        [np.full(len(values_of), start[values_of].min()) for values_of in periods.values()]
    )
    values_of = {name: values[rows] for name, values in number.items()}
    speed, length, kind = (values_of.get(name) for name in ("v_Vel", "v_Length", "v_Class"))
    return Trajectories(
        path=table.path,
        name=table.path.stem,
        where=lambda i: table.row(int(rows[i])),
        recording=np.repeat(
            np.array(list(periods), dtype=object), [len(o) for o in periods.values()]
        ),
        agent=_text(values_of["Vehicle_ID"]),
        time=(values_of["Global_Time"] - origin) * 1e-3,
        x=values_of["Local_Y"][:, None] * FOOT,
        lane=_text(values_of["Lane_ID"]),
        v=None if speed is None else np.abs(speed)[:, None] * FOOT,
        length=None if length is None else length * FOOT,
        kind=None if kind is None else _text(kind),
    )


def _text(values: np.ndarray) -> np.ndarray:
    """Whole numbers as they are written, empty where there is none."""
    whole = [f"{value:.0f}" if np.isfinite(value) else "" for value in np.unique(values)]
    words = np.array(whole, dtype=object)
    return words[np.unique(values, return_inverse=True)[1]]
