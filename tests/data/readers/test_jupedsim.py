"""Reading JuPedSim's databases and walkable areas: content, walls, damaged and foreign files."""

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
from nnode.data.sequence import Sequence
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
    with closing(sqlite3.connect(path)) as base:
        base.executescript(
            "CREATE TABLE trajectory_data (frame, id, pos_x, pos_y, ori_x, ori_y);"
            "CREATE TABLE metadata (key TEXT PRIMARY KEY, value TEXT);"
            "CREATE TABLE geometry (hash INTEGER, wkt TEXT);"
            "CREATE TABLE frame_data (frame INTEGER, geometry_hash INTEGER);"
        )
        base.executemany("INSERT INTO trajectory_data VALUES (?, ?, ?, ?, ?, ?)", rows)
        base.execute("INSERT INTO metadata VALUES ('version', '2')")
        if fps is not None:
            base.execute("INSERT INTO metadata VALUES ('fps', ?)", (fps,))
        base.executemany("INSERT INTO geometry VALUES (?, ?)", enumerate(areas))
        base.executescript(extra)
        base.commit()
    return path


def read(path: Path, geometry: Path | None = None, **options: object) -> list[Sequence]:
    options = {"path": str(path), **options}
    return read_walkway(path, WalkwayOptions(**options), geometry)  # type: ignore[arg-type]


def test_people_times_and_walls(tmp_path: Path) -> None:
    first, second = read(database(tmp_path / "run.sqlite"))
    assert (first.name, second.name, first.agents) == ("run/000", "run/001", ("1", "2"))
    np.testing.assert_allclose(second.time, 1 + 0.1 * np.arange(11))
    np.testing.assert_allclose(
        first.x[:, 1], np.stack([1 + 0.12 * np.arange(11), 2 + 0 * first.time], -1)
    )
    assert np.shape(first.walls) == (8, 4)


def test_the_file_is_not_written_to(tmp_path: Path) -> None:
    path = database(tmp_path / "run.sqlite")
    before = path.read_bytes()
    path.chmod(0o444)
    read(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["run.sqlite"]


def test_prepared_as_any_other_data(tmp_path: Path) -> None:
    path = database(tmp_path / "run.sqlite")
    store = prepare(WalkwayOptions(path=str(path), faults=Faults.error), tmp_path / "out")
    assert len(store) == 2
    assert store.manifest["files"][PEOPLE]["name"] == "run.sqlite"
    np.testing.assert_array_equal(store[0].walls, walls_of(ROOM, ""))


def test_an_area_of_its_own_file_wins(tmp_path: Path) -> None:
    area = tmp_path / "area.wkt"
    area.write_text("POLYGON ((0 0, 9 0, 9 3, 0 0))")
    options = WalkwayOptions(path=str(database(tmp_path / "a.sqlite")), geometry=str(area))
    files = walkway_files(options)
    assert files[GEOMETRY] == area
    walls = read_walkway(files[PEOPLE], options, files[GEOMETRY])[0].walls
    np.testing.assert_array_equal(walls, [[0, 0, 9, 0], [9, 0, 9, 3], [9, 3, 0, 0]])


def test_text_with_header_in_metres(tmp_path: Path) -> None:
    text = "# framerate: 10\n# id frame x/m y/m z/m\n"
    text += "".join(f"{i} {f} {x} {y} 0\n" for f, i, x, y, *_ in ROWS)
    (tmp_path / "run.txt").write_text(text)
    (tmp_path / "area.wkt").write_text(ROOM)
    result = read(tmp_path / "run.txt", tmp_path / "area.wkt")
    same = read(database(tmp_path / "run.sqlite"))
    for a, b in zip(result, same, strict=True):
        np.testing.assert_allclose(a.x, b.x)
        np.testing.assert_allclose(a.time, b.time)
        np.testing.assert_array_equal(a.walls, b.walls)


@st.composite
def rooms(draw: st.DrawFn) -> shapely.Polygon:
    """A star-shaped room with a square hole in its middle, wound in any way."""
    n = draw(st.integers(3, 12))
    radii = draw(st.lists(st.floats(2.0, 9.0), min_size=n, max_size=n))
    ring = [
        (r * math.cos(2 * math.pi * i / n), r * math.sin(2 * math.pi * i / n))
        for i, r in enumerate(radii)
    ]
    hole = [(-0.3, -0.3), (0.3, -0.3), (0.3, 0.3), (-0.3, 0.3)]
    turn = draw(st.tuples(st.booleans(), st.booleans()))
    return shapely.Polygon(ring[:: -1 if turn[0] else 1], [hole[:: -1 if turn[1] else 1]])


@given(rooms())
@settings(max_examples=60, deadline=None)
def test_the_area_lies_left_of_every_edge(room: shapely.Polygon) -> None:
    walls = walls_of(room.wkt, "")
    along = walls[:, 2:] - walls[:, :2]
    left = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=1)[:, None]
    points = (walls[:, :2] + walls[:, 2:]) / 2 + 1e-3 * left
    assert shapely.contains_xy(room, *points.T).all()
    assert np.linalg.norm(along, axis=1).sum() == pytest.approx(room.length)


@pytest.mark.parametrize(
    ("wkt", "words"),
    [
        ("POLYGON ((0 0, 1 0", ["area.wkt", "expected the walkable area as WKT"]),
        ("", ["expected"]),
        ("LINESTRING (0 0, 1 1)", ["LineString", "POLYGON"]),
        ("POLYGON EMPTY", ["empty"]),
        ("POLYGON ((0 0, 2 2, 2 0, 0 2, 0 0))", ["Self-intersection"]),
    ],
)
def test_text_that_is_no_area(wkt: str, words: list[str]) -> None:
    with pytest.raises(DataError) as caught:
        walls_of(wkt, "area.wkt")
    assert all(word in str(caught.value) for word in words)


def test_several_polygons() -> None:
    collection = (
        "GEOMETRYCOLLECTION (POLYGON ((0 0, 1 0, 1 1, 0 0)), POLYGON ((5 5, 6 5, 6 6, 5 5)))"
    )
    assert len(walls_of(collection, "")) == 6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rows": []}, ["trajectory_data is empty", "closed"]),
        ({"fps": None}, ["metadata", "fps", "nothing"]),
        ({"fps": "fast"}, ["metadata", "'fast'"]),
        ({"fps": "0"}, ["metadata", "positive"]),
        ({"rows": [*ROWS, (21, 1, "far", 0, 0, 0)]}, ["row 22", "1 21 far 0"]),
        ({"rows": [*ROWS, (21.5, 1, 0, 0, 0, 0)]}, ["21.5", "whole numbers"]),
        ({"rows": [*ROWS, (10**12, 1, 0, 0, 0, 0)]}, ["1000000000000", "consecutive"]),
        ({"rows": [*ROWS, (1e300, 1, 0, 0, 0, 0)]}, ["1e+300", "whole numbers"]),
        ({"rows": [*ROWS, ROWS[0]]}, ["frame 0: agent 1 stands there a second time"]),
        ({"areas": (ROOM, ROOM.replace("10", "12"))}, ["2 of them", "data.geometry"]),
        ({"areas": ("POINT (1 1)",)}, ["table geometry", "Point"]),
        ({"extra": "DROP TABLE metadata;"}, ["no table metadata", "trajectory_data"]),
        (
            {
                "extra": "PRAGMA writable_schema=ON; "
                "UPDATE sqlite_master SET name = CAST(name AS BLOB);"
            },
            ["no table trajectory_data", "metadata"],
        ),
    ],
)
def test_one_clear_error(tmp_path: Path, change: dict, words: list[str]) -> None:
    path = database(tmp_path / "run.sqlite", **change)
    with pytest.raises(DataError) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_a_view_is_not_run(tmp_path: Path) -> None:
    extra = (
        "ALTER TABLE trajectory_data RENAME TO other;"
        "CREATE VIEW trajectory_data AS SELECT * FROM other;"
    )
    with pytest.raises(DataError, match="no table trajectory_data"):
        read(database(tmp_path / "run.sqlite", extra=extra))


def test_what_a_database_tells_itself_is_not_set(tmp_path: Path) -> None:
    path = database(tmp_path / "run.sqlite")
    assert len(read(path, frame_rate=10.0)) == 2
    with pytest.raises(ConfigError, match="leave both out"):
        read(path, frame_rate=25.0)
    with pytest.raises(ConfigError, match="leave both out"):
        read(path, unit="cm")


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.sqlite is not there"):
        walkway_files(WalkwayOptions(path=str(tmp_path / "none.sqlite")))


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return database(tmp_path_factory.mktemp("sound") / "whole.sqlite").read_bytes()


@given(st.data())
@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_damage_ends_in_an_error_of_the_package(
    tmp_path: Path, sound: bytes, data: st.DataObject
) -> None:
    path = tmp_path / "damaged.sqlite"
    path.write_bytes(damaged(data, sound, 16, 64))
    try:
        result = read(path)
    except (DataError, ConfigError):
        return
    assert all(np.isfinite(s.x).all() for s in result)


def test_a_table_of_people(tmp_path: Path) -> None:
    """Any names and units; times that jitter are interpolated to equal ones, and that is told."""
    rng, parts = np.random.default_rng(6), []
    for n in range(3):
        time = 0.2 * np.arange(30) + rng.uniform(-0.03, 0.03, 30)
        parts.append(
            pd.DataFrame({"who": f"person {n}", "ms": 1000 * time, "px": 130 * time, "py": 80 * n})
        )
    path = tmp_path / "people.csv"
    pd.concat(parts).to_csv(path, index=False, sep=";")
    columns = {"agent": "who", "time": "ms", "x": "px", "y": "py"}
    options = WalkwayOptions(
        path=str(path), columns=columns, position_unit="cm", time_unit="ms", t_seq=1.0
    )
    result = read_walkway(path, options)
    assert len(result) >= 4
    assert "are interpolated to steps of 0.2 s" in result.notes[0]
    for s in result[1:-1]:  # at both ends somebody begins later, or ends before
        assert s.agents == ("person 0", "person 1", "person 2")
        np.testing.assert_allclose(s.x[:, :, 1], np.tile([0.0, 0.8, 1.6], (6, 1)), atol=1e-9)
        np.testing.assert_allclose(np.diff(s.x[:, :, 0], axis=0), 0.26, atol=1e-9)
