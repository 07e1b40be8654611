"""Reader of one file of walking people: JuPedSim's SQLite database, or PedPy's text.

Both end in the same cutting as the Jülich archive's files. Walls are the edges of a walkable
area in WKT: the database's own, or that of a text file beside the trajectories.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import shapely
from omegaconf import MISSING
from shapely.geometry.polygon import orient

from nnode.data.cut import Reading
from nnode.data.readers.columns import (
    PARQUET,
    ColumnOptions,
    Table,
    beginning,
    opened,
    table_rows,
)
from nnode.data.readers.juelich import JuelichOptions, People, cut_people, load_people, people_of
from nnode.data.readers.recordings import table_path
from nnode.data.sequence import check_interval
from nnode.errors import ConfigError, DataError

#: First bytes of every SQLite database.
MAGIC = b"SQLite format 3\x00"

#: Keys of the files.
PEOPLE, GEOMETRY = "trajectories", "geometry"

#: Endings of files that are tables.
TABLES = (".csv", *PARQUET)

#: Rows that are converted together.
_AT_ONCE = 100_000


#: Columns of a table.
REQUIRED, OPTIONAL = ("agent", "time", "x", "y"), ("recording", "sequence")


@dataclass
class WalkwayOptions(ColumnOptions, JuelichOptions):
    """One file of walking people: PedPy's text, JuPedSim's SQLite database, or a table."""

    name: str = "pedpy"
    fill: float = 0.5  # s of missing frames of a person that are interpolated; 0: none
    path: str = MISSING  # the file; relative to data.source where that is given
    geometry: str | None = None  # text file with the walkable area as WKT, m


def walkway_files(options: WalkwayOptions, table: Table | None = None) -> dict[str, Path | Table]:
    """The trajectories, or their path, and the path of the walkable area where it has a file of
    its own."""
    files = {PEOPLE: table or table_path(options)}
    if options.geometry is not None:
        files[GEOMETRY] = table_path(options, "geometry")
    return files


def read_walkway(
    path: Path | Table, options: WalkwayOptions, geometry: Path | None = None
) -> Reading:
    """Read one file and cut it, see :func:`nnode.data.readers.juelich.read_juelich`.

    Args:
        path: SQLite database as JuPedSim's writer makes it; text ``id frame x y z``; or a table
            (CSV, Parquet, in memory, or any text whose ``columns`` are given).
        options: those of the Jülich reader. ``frame_rate`` and ``unit`` are for texts without a
            header; a database states its own, and a table has units.
        geometry: text file with the walkable area as WKT (m); it takes the place of the area
            that a database holds.

    Returns:
        Sequences named ``recording/number`` after the file. Where neither file has an area,
        walls are those of ``options.walls``.

    Raises:
        ConfigError: an option out of its range, or one that contradicts the file.
        DataError: a file that is not of its format, or no sequence at all.
    """
    area = None
    if isinstance(path, Path) and path.is_file() and beginning(path).startswith(MAGIC):
        table, rate, area = _read_database(path)
        if options.frame_rate not in (None, rate) or options.unit not in (None, "m"):
            raise ConfigError(
                f"{path} is in m at {rate:g} frames/s, but data.frame_rate={options.frame_rate}, "
                f"data.unit={options.unit}; leave both out for a database"
            )
        people = people_of(table, rate)
    elif isinstance(path, Table) or options.columns or path.suffix.lower() in TABLES:
        people = _of_table(opened(path), options)
    else:
        people = load_people(path, options)
    walls = None
    if geometry is not None:
        try:
            text = geometry.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise DataError(f"{geometry} cannot be read as text with WKT: {error}") from error
        walls = walls_of(text, str(geometry))
    elif area is not None and not options.walls:
        walls = walls_of(area, f"{path}, table geometry")
    return cut_people(people, options, walls)


def _of_table(table: Table, options: WalkwayOptions) -> People:
    """Rows agent, time, x, y of any table, and their sampling interval."""
    names = table.choose(REQUIRED, OPTIONAL, options.columns)
    rows = table_rows(table, names, options, ("x", "y"))
    dt = rows.dt
    if not np.isfinite(dt):
        raise DataError(f"{table.path}: nobody has rows at two times; nothing moves here")
    check_interval(dt, f"{table.path}: rows of a person")
    return rows, dt


def walls_of(wkt: str, where: str) -> np.ndarray:
    """Edges of a walkable area, with the area on the left of each.

    Args:
        wkt: a polygon, or several of them, in m.
        where: names the text in errors.

    Returns:
        ``(W, 4)`` segments x1, y1, x2, y2, those of holes included.

    Raises:
        DataError: no valid WKT, or something other than areas.
    """
    try:
        shape = shapely.from_wkt(wkt)
    except shapely.errors.ShapelyError as error:
        raise DataError(
            f"{where}: expected the walkable area as WKT, such as 'POLYGON ((0 0, 9 0, 9 4, "
            f"0 4, 0 0))', found {wkt.strip()[:60]!r}: {error}"
        ) from error
    segments: list[np.ndarray] = []
    for area in _polygons(shape, where):
        if area.is_empty or not area.is_valid:
            reason = "it is empty" if area.is_empty else shapely.is_valid_reason(area)
            raise DataError(f"{where}: the walkable area is no area ({reason}); mend its polygon")
        whole = orient(area)  # the outer ring turns left, the holes turn right
        for ring in (whole.exterior, *whole.interiors):
            corners = np.asarray(ring.coords)[:, :2]
            edges = np.hstack([corners[:-1], corners[1:]])
            segments.append(edges[(edges[:, :2] != edges[:, 2:]).any(axis=1)])
    return np.concatenate(segments)


def _polygons(shape: object, where: str) -> Iterator[shapely.Polygon]:
    if isinstance(shape, shapely.Polygon):
        yield shape
    elif isinstance(shape, shapely.MultiPolygon | shapely.GeometryCollection) and shape.geoms:
        for part in shape.geoms:
            yield from _polygons(part, where)
    else:
        raise DataError(
            f"{where}: expected a POLYGON, MULTIPOLYGON or a collection of them, found "
            f"{getattr(shape, 'geom_type', 'nothing')}"
        )


def _read_database(path: Path) -> tuple[Table, float, str | None]:
    """A table id, frame, x, y (m), frames per second, and the walkable area as WKT."""
    # immutable: neither a lock nor a journal is written beside the file, and none is played back
    address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(address, uri=True)) as base:
            base.execute("PRAGMA trusted_schema=OFF")
            kinds = dict(base.execute("SELECT name, type FROM sqlite_master"))
            for name in ("trajectory_data", "metadata"):
                if kinds.get(name) != "table":
                    # a view would run whatever query the file has brought along
                    held = [str(n) for n, kind in kinds.items() if kind == "table"]
                    raise DataError(
                        f"{path} has no table {name}, as JuPedSim's databases have; it has the "
                        f"tables: {', '.join(held) or 'none'}"
                    )
            rate = _rate(path, base)
            people = _people(path, base)
            area = _area(path, base) if kinds.get("geometry") == "table" else None
    except (sqlite3.Error, pd.errors.DatabaseError, UnicodeDecodeError) as error:
        raise DataError(
            f"{path} cannot be read as a JuPedSim database: {error}; it is damaged or was written "
            "by another program"
        ) from error
    return people, rate, area


def _rate(path: Path, base: sqlite3.Connection) -> float:
    row = base.execute("SELECT value FROM metadata WHERE key = 'fps'").fetchone()
    try:
        rate = float(row[0]) if row else math.nan
    except (TypeError, ValueError):
        rate = math.nan
    if not 0 < rate < math.inf:
        shown = "nothing" if row is None else repr(row[0])
        raise DataError(
            f"{path}, table metadata: expected key 'fps' with a positive number of frames per "
            f"second, found {shown}"
        )
    return rate


def _people(path: Path, base: sqlite3.Connection) -> Table:
    query = "SELECT id, frame, pos_x AS x, pos_y AS y FROM trajectory_data ORDER BY id, frame"
    frame = pd.concat(pd.read_sql_query(query, base, chunksize=_AT_ONCE))
    if frame.empty:
        raise DataError(
            f"{path}: the table trajectory_data is empty; a simulation's trajectories are in its "
            "file only after the writer was closed"
        )
    table = Table(frame)
    table.path = path
    return table


def _area(path: Path, base: sqlite3.Connection) -> str | None:
    areas = {row[0] for row in base.execute("SELECT wkt FROM geometry")}
    if len(areas) > 1:
        raise DataError(
            f"{path}, table geometry: the walkable area changes, it holds {len(areas)} of them; "
            "walls are fixed here: set data.geometry to a file with the WKT of the one to take"
        )
    return str(areas.pop()) if areas else None
