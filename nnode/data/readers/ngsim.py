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
from nnode.data.readers.columns import EXACT, NUMBER, Table, beginning, is_parquet, layout
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
_NUMBERS = ("v_Vel", "v_Length", "v_Class", "Direction")
_USED = (*_NEEDED, *_NUMBERS, "Location")

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
    # the portal has written 6042842.1 as "6,042,842.1" at times
    how: dict[str, Any] = {"thousands": ","}
    form = layout(beginning(path)) if path.is_file() and not is_parquet(path) else None
    if form is not None:
        number, how["sep"] = len(form.cells), form.options["sep"]
        if NUMBER.fullmatch(form.cells[0]):
            names = LAYOUTS.get(number)
            if names is None:
                raise DataError(
                    f"{path} has {number} columns without names; NGSIM's files have "
                    f"{', '.join(map(str, LAYOUTS))}: set data=vehicles for a table of your own"
                )
        if set(_NEEDED) <= {_KNOWN.get(cell.lower(), "") for cell in names or form.cells}:
            how["usecols"] = lambda name: _KNOWN.get(name.strip().lower()) in _USED
    table = Table(path, names, **how)
    table.rename([_KNOWN.get(name.lower(), name) for name in table.frame.columns])
    return table


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
    number |= {name: table.numbers(name, empty=True) for name in _NUMBERS if name in held}
    place = np.full(len(table), table.path.stem, dtype=object)
    if "Location" in held:
        place = table.names("Location")
    roads = _roads(table, place, number.get("Direction"))
    start = number["Global_Time"] - 100 * number["Frame_ID"]  # ms at frame 0
    table.refuse(
        ~(np.abs(start) < EXACT),
        lambda i: (
            f"Global_Time and Frame_ID put frame 0 at {start[i]:g} ms since 1970; correct them"
        ),
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
    recording = np.full(len(table), "", dtype=object)
    origin = np.zeros(len(table))
    for name, of_period in periods.items():
        recording[of_period], origin[of_period] = name, start[of_period].min()
    speed, length = number.get("v_Vel"), number.get("v_Length")
    return Trajectories(
        path=table.path,
        name=table.path.stem,
        where=table.row,
        recording=recording,
        agent=table.names("Vehicle_ID"),
        time=(number["Global_Time"] - origin) * 1e-3,
        x=number["Local_Y"][:, None] * FOOT,
        lane=table.names("Lane_ID"),
        v=None if speed is None or np.isnan(speed).any() else np.abs(speed)[:, None] * FOOT,
        length=None if length is None else length * FOOT,
        kind=table.names("v_Class", empty=True) if "v_Class" in number else None,
    ).at(np.concatenate(list(periods.values())))
