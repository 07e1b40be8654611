"""JuPedSim's databases and walkable areas: content, walls, damaged and invalid files."""

from __future__ import annotations

import math
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nnode.data.cut import Reading
from nnode.data.options import Faults
from nnode.data.prepare import prepare
from nnode.data.readers.jupedsim import (
    GEOMETRY,
    PEOPLE,
    WalkwayOptions,
    read_walkway,
    walkway_files,
    walls_of,
)
from nnode.errors import ConfigError, DataError
from tests.data.tables import damaged

ROOM = "POLYGON ((0 0, 10 0, 10 4, 0 4, 0 0), (4 1, 5 1, 5 2, 4 2, 4 1))"
ROWS = [(f, i, 1 + 0.12 * f, float(i), 1.0, 0.0) for f in range(21) for i in (1, 2)]


def database(
    path: Path,
    rows: list[tuple] = ROWS,
    *,
    fps: object = "10.0",
    areas: tuple[str, ...] = (ROOM,),
    extra: str = "",
) -> Path:
    """A database with the tables of JuPedSim's writer."""
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(
            "CREATE TABLE trajectory_data (frame, id, pos_x, pos_y, ori_x, ori_y);"
            "CREATE TABLE metadata (key TEXT PRIMARY KEY, value TEXT);"
            "CREATE TABLE geometry (hash INTEGER, wkt TEXT);"
            "CREATE TABLE frame_data (frame INTEGER, geometry_hash INTEGER);"
        )
        connection.executemany("INSERT INTO trajectory_data VALUES (?, ?, ?, ?, ?, ?)", rows)
        connection.execute("INSERT INTO metadata VALUES ('version', '2')")
        if fps is not None:
            connection.execute("INSERT INTO metadata VALUES ('fps', ?)", (fps,))
        connection.executemany("INSERT INTO geometry VALUES (?, ?)", enumerate(areas))
        connection.executescript(extra)
        connection.commit()
    return path


def read(path: Path, geometry: Path | None = None, **options: object) -> Reading:
    return read_walkway(path, WalkwayOptions(path=str(path), **options), geometry)


def test_people_times_and_walls(tmp_path: Path) -> None:
    first, second = read(database(tmp_path / "run.sqlite"))
    assert (first.name, second.name, first.agents) == ("run/000", "run/001", ("1", "2"))
    np.testing.assert_allclose(second.time, 1 + 0.1 * np.arange(11))
    np.testing.assert_allclose(
        first.x[:, 1], np.stack([1 + 0.12 * np.arange(11), 2 + 0 * first.time], -1)
    )
    assert np.shape(first.walls) == (8, 4)


def test_database_is_not_modified(tmp_path: Path) -> None:
    path = database(tmp_path / "run.sqlite")
    before = path.read_bytes()
    path.chmod(0o444)
    read(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["run.sqlite"]


def test_prepare(tmp_path: Path) -> None:
    path = database(tmp_path / "run.sqlite")
    store = prepare(WalkwayOptions(path=str(path), faults=Faults.error), tmp_path / "out")
    assert len(store) == 2
    assert store.manifest["files"][PEOPLE]["name"] == "run.sqlite"
    np.testing.assert_array_equal(store[0].walls, walls_of(ROOM, ""))


def test_separate_area_file_takes_precedence(tmp_path: Path) -> None:
    area = tmp_path / "area.wkt"
    area.write_text("POLYGON ((0 0, 9 0, 9 3, 0 0))")
    options = WalkwayOptions(path=str(database(tmp_path / "a.sqlite")), geometry=str(area))
    files = walkway_files(options)
    assert files[GEOMETRY] == area
    walls = read_walkway(files[PEOPLE], options, files[GEOMETRY])[0].walls
    np.testing.assert_array_equal(walls, [[0, 0, 9, 0], [9, 0, 9, 3], [9, 3, 0, 0]])


def test_text_file_equals_database(tmp_path: Path) -> None:
    rows = "".join(f"{i} {f} {x} {y} 0\n" for f, i, x, y, *_ in ROWS)
    text, area = tmp_path / "run.txt", tmp_path / "area.wkt"
    text.write_text("# framerate: 10\n# id frame x/m y/m z/m\n" + rows)
    area.write_text(ROOM)
    expected = read(database(tmp_path / "run.sqlite"))
    for actual, desired in zip(read(text, area), expected, strict=True):
        np.testing.assert_allclose(actual.x, desired.x)
        np.testing.assert_allclose(actual.time, desired.time)
        np.testing.assert_array_equal(actual.walls, desired.walls)


@st.composite
def rooms(draw: st.DrawFn) -> shapely.Polygon:
    """A star-shaped room with a square hole in its middle; both rings in either orientation."""
    n = draw(st.integers(3, 12))
    radii = draw(st.lists(st.floats(2.0, 9.0), min_size=n, max_size=n))
    angles = [2 * math.pi * i / n for i in range(n)]
    ring = [(r * math.cos(a), r * math.sin(a)) for r, a in zip(radii, angles, strict=True)]
    hole = [(-0.3, -0.3), (0.3, -0.3), (0.3, 0.3), (-0.3, 0.3)]
    orientation = st.sampled_from([-1, 1])
    return shapely.Polygon(ring[:: draw(orientation)], [hole[:: draw(orientation)]])


@given(rooms())
@settings(max_examples=60, deadline=None)
def test_area_is_left_of_every_wall(room: shapely.Polygon) -> None:
    walls = walls_of(room.wkt, "")
    along = walls[:, 2:] - walls[:, :2]
    normal = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=1)[:, None]
    points = (walls[:, :2] + walls[:, 2:]) / 2 + 1e-3 * normal
    assert shapely.contains_xy(room, *points.T).all()
    assert np.linalg.norm(along, axis=1).sum() == pytest.approx(room.length)


@pytest.mark.parametrize(
    ("wkt", "message"),
    [
        ("POLYGON ((0 0, 1 0", "area.wkt.*expected the walkable area as WKT"),
        ("", "expected"),
        ("LINESTRING (0 0, 1 1)", "LineString.*POLYGON|POLYGON.*LineString"),
        ("POLYGON EMPTY", "empty"),
        ("POLYGON ((0 0, 2 2, 2 0, 0 2, 0 0))", "Self-intersection"),
    ],
)
def test_invalid_areas(wkt: str, message: str) -> None:
    with pytest.raises(DataError, match=f"(?s){message}"):
        walls_of(wkt, "area.wkt")


def test_collection_of_polygons() -> None:
    polygons = "POLYGON ((0 0, 1 0, 1 1, 0 0)), POLYGON ((5 5, 6 5, 6 6, 5 5))"
    assert len(walls_of(f"GEOMETRYCOLLECTION ({polygons})", "")) == 6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": []}, "trajectory_data is empty.*closed"),
        ({"fps": None}, "metadata.*fps.*nothing"),
        ({"fps": "fast"}, "metadata.*'fast'"),
        ({"fps": "0"}, "metadata.*positive"),
        ({"rows": [*ROWS, (21, 1, "far", 0, 0, 0)]}, "row 22.*1 21 far 0"),
        ({"rows": [*ROWS, (21.5, 1, 0, 0, 0, 0)]}, r"whole numbers.*21\.5"),
        ({"rows": [*ROWS, (10**12, 1, 0, 0, 0, 0)]}, "1000000000000.*consecutive"),
        ({"rows": [*ROWS, (1e300, 1, 0, 0, 0, 0)]}, r"whole numbers.*1e\+300"),
        ({"rows": [*ROWS, ROWS[0]]}, "frame 0: agent 1 occurs a second time"),
        ({"areas": (ROOM, ROOM.replace("10", "12"))}, r"2 of them.*data\.geometry"),
        ({"areas": ("POINT (1 1)",)}, "table geometry.*Point"),
        ({"extra": "DROP TABLE metadata;"}, "no table metadata.*trajectory_data"),
        (
            {
                "extra": "PRAGMA writable_schema=ON; "
                "UPDATE sqlite_master SET name = CAST(name AS BLOB);"
            },
            "no table trajectory_data.*metadata",
        ),
        # a view is not a table
        (
            {
                "extra": "ALTER TABLE trajectory_data RENAME TO other;"
                "CREATE VIEW trajectory_data AS SELECT * FROM other;"
            },
            "no table trajectory_data",
        ),
    ],
)
def test_invalid_databases(tmp_path: Path, change: dict, message: str) -> None:
    path = database(tmp_path / "run.sqlite", **change)
    with pytest.raises(DataError, match=f"(?s){message}") as error:
        read(path)
    assert str(path) in str(error.value)


def test_rate_and_unit_of_a_database_are_not_set(tmp_path: Path) -> None:
    path = database(tmp_path / "run.sqlite")
    assert len(read(path, frame_rate=10.0)) == 2
    for options in ({"frame_rate": 25.0}, {"unit": "cm"}):
        with pytest.raises(ConfigError, match="leave both out"):
            read(path, **options)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.sqlite is not there"):
        walkway_files(WalkwayOptions(path=str(tmp_path / "none.sqlite")))


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of a valid database."""
    return database(tmp_path_factory.mktemp("valid") / "run.sqlite").read_bytes()


@given(st.data())
@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_damaged_database_is_read_or_refused(
    tmp_path: Path, content: bytes, data: st.DataObject
) -> None:
    path = tmp_path / "damaged.sqlite"
    path.write_bytes(damaged(data, content, 16, 64))
    try:
        result = read(path)
    except (DataError, ConfigError):
        return
    assert all(np.isfinite(s.x).all() for s in result)


def test_table_of_people(tmp_path: Path) -> None:
    """Columns and units are options; uneven times are interpolated, which a note states."""
    rng, parts = np.random.default_rng(6), []
    for n in range(3):
        time = 0.2 * np.arange(30) + rng.uniform(-0.03, 0.03, 30)
        parts.append(
            pd.DataFrame({"who": f"person {n}", "ms": 1000 * time, "px": 130 * time, "py": 80 * n})
        )
    path = tmp_path / "people.csv"
    pd.concat(parts).to_csv(path, index=False, sep=";")
    columns = {"agent": "who", "time": "ms", "x": "px", "y": "py"}
    result = read(path, columns=columns, position_unit="cm", time_unit="ms", t_seq=1.0)
    assert len(result) >= 4
    assert "are interpolated to steps of 0.2 s" in result.notes[0]
    for s in result[1:-1]:  # not all people are present in the first and the last sequence
        assert s.agents == ("person 0", "person 1", "person 2")
        np.testing.assert_allclose(s.x[:, :, 1], np.tile([0.0, 0.8, 1.6], (6, 1)), atol=1e-9)
        np.testing.assert_allclose(np.diff(s.x[:, :, 0], axis=0), 0.26, atol=1e-9)
