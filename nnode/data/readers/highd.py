"""Reader of highD's tables: a recording's tracks, and what is known of tracks and recording.

Positions in the tracks are corners of boxes; here a vehicle is where its front is, at positions
that grow as it drives on, whichever way that is.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nnode.data.cut import LaneOptions, Reading, by_lane, check_cutting
from nnode.data.readers.columns import Table
from nnode.data.readers.recordings import table_path
from nnode.data.trajectories import Trajectories
from nnode.errors import ConfigError, DataError

#: How the names of a recording's three tables end.
TRACKS, TRACKS_META, RECORDING_META = "_tracks.csv", "_tracksMeta.csv", "_recordingMeta.csv"

#: drivingDirection of tracks that drive towards smaller, and towards larger positions.
LEFT, RIGHT = 1, 2


@dataclass
class HighDOptions(LaneOptions):
    """highD's tracks, with the tables ``tracksMeta`` and ``recordingMeta`` beside them."""

    name: str = "highd"


def highd_files(options: HighDOptions) -> dict[str, Path]:
    """The three tables of a recording, of which ``data.path`` names the tracks.

    Raises:
        ConfigError: ``data.path`` names no tracks.
        DataError: a table that is not there.
    """
    tracks = table_path(options)
    if not tracks.name.endswith(TRACKS):
        raise ConfigError(f"data.path={options.path}: expected a file NAME{TRACKS}")
    stem = tracks.name.removesuffix(TRACKS)
    files = {end: tracks.with_name(stem + end) for end in (TRACKS, TRACKS_META, RECORDING_META)}
    for path in files.values():
        if not path.is_file():
            raise DataError(f"there is no file {path}; {tracks.name} needs it beside it")
    return files


def read_highd(files: dict[str, Path], options: HighDOptions) -> Reading:
    """Read a recording and cut it as a vehicle table.

    Args:
        files: see :func:`highd_files`.
        options: lanes, time grid and the way of cutting.

    Returns:
        Sequences named ``recording/number``, recording being the file's name without its ending
        and the lane. Length and class are those of the tracks.

    Raises:
        ConfigError: an option out of its range, an unknown lane or recording.
        DataError: columns or cells that are missing or hold no number (names the row), a track
            that ``tracksMeta`` lacks, one vehicle twice in a frame, or no sequence at all.

    Source: Krajewski, Bock, Kloeker & Eckstein 2018, The highD Dataset, and its format.
    """
    check_cutting(options)
    tracks = Table(files[TRACKS])
    names = tracks.choose(("frame", "id", "x", "width", "laneId"), ("xVelocity",))
    vehicle = tracks.names(names["id"])
    direction, kind = _tracks(files[TRACKS_META], tracks, vehicle)
    corner, length = tracks.numbers(names["x"]), tracks.numbers(names["width"])
    x = np.where(direction == RIGHT, corner + length, -corner)
    speed = np.abs(tracks.numbers(names["xVelocity"])) if "xVelocity" in names else None
    rows = Trajectories(
        path=tracks.path,
        name=files[TRACKS].name.removesuffix(TRACKS),
        where=tracks.row,
        agent=vehicle,
        time=tracks.numbers(names["frame"]) / _rate(files[RECORDING_META]),
        x=x[:, None],
        v=None if speed is None else speed[:, None],
        lane=tracks.names(names["laneId"]),
        length=length,
        kind=kind,
    )
    return by_lane(rows, options)


def _rate(path: Path) -> float:
    table = Table(path)
    (rate, *further) = table.numbers(table.choose(("frameRate",))["frameRate"])
    if further or not rate > 0:
        raise DataError(
            f"{path}: expected one row with a positive frameRate (1/s), found "
            f"{1 + len(further)} rows, the first with {rate:g}"
        )
    return float(rate)


def _tracks(path: Path, tracks: Table, vehicle: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Driving direction and class of the track that every row belongs to."""
    table = Table(path)
    names = table.choose(("id", "drivingDirection"), ("class",))
    direction = table.numbers(names["drivingDirection"])
    table.refuse(
        ~np.isin(direction, (LEFT, RIGHT)),
        lambda i: f"drivingDirection is {direction[i]:g}, expected {LEFT} or {RIGHT}",
    )
    place = {name: i for i, name in enumerate(table.names(names["id"]))}
    tracks.refuse(
        np.array([name not in place for name in vehicle]),
        lambda i: f"track {vehicle[i]} is not in {path.name}; take both files of one recording",
    )
    at = np.array([place[name] for name in vehicle])
    kind = table.names(names["class"], empty=True)[at] if "class" in names else None
    return direction[at], kind
