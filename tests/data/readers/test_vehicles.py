"""Vehicle tables: units, lanes, time grid, and the division into sequences."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode.data.readers.vehicles import VehicleTableOptions, vehicle_files
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError, DataError
from tests.data import tables
from tests.data.tables import saved


def drive(vehicle: object, start: float, end: float, x0: float, **columns: object) -> pd.DataFrame:
    """A vehicle observed from ``start`` to ``end`` s at 10 m/s, at x0 + 10 t, every 0.1 s."""
    time = np.round(np.arange(start, end + 0.05, 0.1), 6)
    return pd.DataFrame({"vehicle": vehicle, "time": time, "x": x0 + 10 * time, **columns})


def cars(end: float, **columns: object) -> pd.DataFrame:
    """Three vehicles observed from the start, 30 m apart."""
    places = (("a", 60), ("b", 30), ("c", 0))
    return pd.concat([drive(name, 0, end, x0, **columns) for name, x0 in places])


read = partial(tables.read, VehicleTableOptions)


@pytest.fixture
def platoon(tmp_path: Path) -> Path:
    return saved(tmp_path / "road.csv", cars(4))


def spans(sequences: list[Sequence]) -> list[tuple[tuple[str, ...], float, float]]:
    """The agents, the first and the last time of each sequence."""
    return [(s.agents, round(s.time[0], 6), round(s.time[-1], 6)) for s in sequences]


def test_order_times_and_positions(platoon: Path) -> None:
    (s,) = read(platoon)
    assert s.name == "road/000"
    assert s.agents == ("c", "b", "a")
    np.testing.assert_allclose(s.time, 0.2 * np.arange(21), atol=1e-9)
    np.testing.assert_allclose(s.x[:, :, 0], s.time[:, None] * 10 + [0, 30, 60], atol=1e-9)


def test_row_order_does_not_matter(platoon: Path) -> None:
    result = read(platoon, window=1.0)
    saved(platoon, pd.read_csv(platoon).sample(frac=1.0, random_state=0))
    for actual, other in zip(read(platoon, window=1.0), result, strict=True):
        assert (actual.name, actual.agents) == (other.name, other.agents)
        np.testing.assert_array_equal(actual.x, other.x)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_units_columns_and_attributes(tmp_path: Path, suffix: str) -> None:
    names = {"vehicle": "id", "time": "frame", "x": "pos", "length": "len", "kind": "cls"}
    parts = [
        drive(name, 0, 4, x0, length=15.0, kind=kind)
        for name, x0, kind in ((1, 0.0, 2), (2, 50.0, 2), (3, 90.0, 3))
    ]
    table = pd.concat(parts).assign(speed_kmh=-36.0)
    table = table.assign(x=-table.x / 0.3048, time=(10 * table.time).round().astype(int))
    (s,) = read(
        saved(tmp_path / f"t{suffix}", table.rename(columns=names)),
        columns={**names, "speed": "speed_kmh"},
        position_unit="ft",
        speed_unit="km/h",
        time_unit="frame",
        frame_rate=10.0,
        direction=-1,
        kinds={"2": "car", "3": "truck"},
    )
    assert s.kind == ("car", "car", "truck")
    assert s.agents == ("1", "2", "3")
    np.testing.assert_allclose(s.length, 15 * 0.3048)
    np.testing.assert_allclose(s.x[:, 1, 0], 50 + 10 * s.time)
    np.testing.assert_allclose(s.v, 10.0)


def test_interpolation_without_extrapolation(tmp_path: Path) -> None:
    parts = [drive(n, 0.13, 1.93, x0) for n, x0 in (("a", 0), ("b", 20))]
    (s,) = read(saved(tmp_path / "t.csv", *parts), min_vehicles=2)
    assert (s.time[0], s.time[-1]) == (pytest.approx(0.2), pytest.approx(1.8))
    np.testing.assert_allclose(s.x[:, 0, 0], 10 * s.time)


def test_uneven_times_and_a_fine_grid_are_noted(tmp_path: Path) -> None:
    table = cars(4)
    path = saved(tmp_path / "road.csv", table)
    assert read(path).notes == []  # the grid of 0.2 s is coarser than the file
    assert "no multiples of 0.05 s" in read(path, dt=0.05).notes[0]
    jitter = np.random.default_rng(1).uniform(-0.02, 0.02, len(table))
    (note,) = read(saved(path, table.assign(time=table.time + jitter))).notes
    assert note.startswith("road: times are uneven")
    assert note.endswith("are interpolated to steps of 0.2 s")


def test_recording_and_sequence_columns(tmp_path: Path) -> None:
    parts = [cars(4, recording=r, sequence=s) for r in "xy" for s in (1, 2)]
    result = read(saved(tmp_path / "road.csv", *parts))
    assert [s.recording for s in result] == ["x 1", "x 2", "y 1", "y 2"]


def test_sequences_are_maximal_intervals(tmp_path: Path) -> None:
    path = saved(
        tmp_path / "t.csv",
        drive("lead", 0, 6, 60),
        drive("mid", 0, 6, 30),
        drive("late", 2, 6, 0),
        drive("later", 4.1, 6, -30),
    )
    assert spans(read(path)) == [
        (("late", "mid", "lead"), 2.0, 4.0),
        (("later", "late", "mid", "lead"), 4.2, 6.0),
    ]
    assert len(read(path, min_vehicles=2)) == 3


def test_lanes_are_recordings(tmp_path: Path) -> None:
    path = saved(
        tmp_path / "t.csv",
        *(drive(f"l{i}", 0, 2, 30 * i, lane=1) for i in range(3)),
        *(drive(f"r{i}", 0, 2, 30 * i + 10, lane=2) for i in range(4)),
    )
    assert [(s.recording, s.n_agents) for s in read(path)] == [("t_lane1", 3), ("t_lane2", 4)]
    assert [s.recording for s in read(path, lane=2)] == ["t_lane2"]
    assert [s.recording for s in read(path, recording="t_lane1")] == ["t_lane1"]
    with pytest.raises(ConfigError, match=r"lane=7: .* has the lanes 1, 2"):
        read(path, lane=[1, 7])
    with pytest.raises(ConfigError, match="recording=t_lane3: unknown recording"):
        read(path, recording="t_lane3")


def test_lane_changes_divide_sequences(tmp_path: Path) -> None:
    changer = drive("x", 0, 4, 30).assign(lane=lambda d: np.where(d.time.between(1.95, 3), 2, 1))
    others = [drive(n, 0, 4, x0, lane=1) for n, x0 in (("a", 0), ("b", 60), ("c", 90))]
    assert spans(read(saved(tmp_path / "t.csv", changer, *others))) == [
        (("a", "x", "b", "c"), 0.0, 1.8),
        (("a", "b", "c"), 2.0, 3.0),
        (("a", "x", "b", "c"), 3.2, 4.0),
    ]


def test_long_holes_divide_sequences(tmp_path: Path) -> None:
    table = cars(4)
    hole = (table.vehicle == "b") & table.time.between(1.05, 2.95)
    path = saved(tmp_path / "t.csv", table[~hole])
    assert [s.n_samples for s in read(path, fill=1.0)] == [6, 6]
    assert [s.n_samples for s in read(path, fill=2.0)] == [21]


def test_empty_position_is_a_missing_sample(platoon: Path) -> None:
    table = pd.read_csv(platoon)
    expected = read(platoon)[0]
    table.loc[[10, 12, 61], "x"] = np.nan
    saved(platoon, table)
    (s,) = read(platoon)
    assert s.filled == 3
    np.testing.assert_allclose(s.x, expected.x, atol=1e-9)
    (*_, last) = read(platoon, fill=0.0)
    assert last.filled == 0


def test_windows_share_their_boundary_sample(platoon: Path) -> None:
    first, second = read(platoon, window=2.0)
    assert first.n_samples == second.n_samples == 11
    assert first.time[-1] == second.time[0] == pytest.approx(2.0)


def test_vehicle_present_for_a_part_divides_a_window(tmp_path: Path) -> None:
    complete = [drive(f"v{i}", 0, 4, 30 * i) for i in range(7)]
    entering = drive("x", 2.5, 4, 30 * 2 + 15)  # between v2 and v3
    ahead = drive("y", 0, 1, 30 * 6 + 15)  # ahead of all others
    path = saved(tmp_path / "t.csv", *complete, entering, ahead)
    rear, front = ("v0", "v1", "v2"), ("v3", "v4", "v5", "v6")
    assert [s.agents for s in read(path, window=4.0)] == [rear, front]
    assert [s.agents for s in read(path, window=4.0, min_vehicles=4)] == [front]


@pytest.mark.real
def test_reconstructed_motorway(real_data: Path) -> None:
    path = real_data / "ngsim/i80_lanes_1_2.csv"
    columns = {"vehicle": "veh", "time": "t", "speed": "v", "kind": "cls"}
    sequences = read(path, columns=columns, window=10.0)
    raw = pd.read_csv(path)
    assert len(sequences) > 20
    for s in sequences:
        inside = raw[
            (raw.lane == int(s.recording[-1]))
            & (raw.t > s.time[0] - 1e-6)
            & (raw.t < s.time[-1] + 1e-6)
        ]
        # No vehicle of the raw table is ever between a follower and its leader.
        paths = inside.pivot(index="t", columns="veh", values="x")
        for follower, leader in pairwise(s.agents):
            rear, front = paths[int(follower)], paths[int(leader)]
            assert not (paths.gt(rear, axis=0) & paths.lt(front, axis=0)).to_numpy().any()
        last = inside[inside.veh == int(s.agents[0])]
        np.testing.assert_allclose(s.x[:, 0, 0], np.interp(s.time, last.t, last.x), atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dt": 0.0}, "dt=0.0: expected a positive number"),
        ({"window": 1.1}, "window=1.1 s is no whole number of steps"),
        ({"window": 0.2}, "window=0.2 s has 2 samples, fewer than"),
        ({"window": -1.0}, "window=-1.0: expected a positive number"),
        ({"direction": 2}, "direction=2: expected 1 or -1"),
        ({"position_unit": "yd"}, "position_unit=yd: expected one of m, ft, cm, km"),
        ({"time_unit": "h"}, "time_unit=h: expected one of s, ms, us, ns, frame"),
        ({"time_unit": "frame"}, "frame_rate=None: expected a positive number"),
        ({"time_unit": "frame", "frame_rate": -5.0}, "frame_rate=-5.0"),
        ({"min_vehicles": 0}, "must be at least 1"),
        ({"lane": 1}, "has no lane column"),
        ({"columns": {"velocity": "v"}}, "data.columns.velocity is unknown; expected vehicle"),
        ({"columns": {"x": None}}, "data.columns.x is null, but x is needed"),
    ],
)
def test_invalid_options(platoon: Path, options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read(platoon, **options)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty; expected a line of column names"),
        ("vehicle,time,x\n", "has no rows below its columns vehicle, time, x"),
        ("vehicle,t,x\n1,0,0\n", r"no column 'time'; it has: vehicle, t, x.*data.columns.time="),
        ("vehicle,time,x\n1,0,0\n\n1,0.1,abc\n", r"line 4: column 'x' holds 'abc'"),
        ("vehicle,time,x\n1,0,0\n1,,2\n", r"line 3: column 'time' holds nothing"),
        ("vehicle,time,x\n1,0,inf\n", r"line 2: column 'x' holds 'inf'"),
        ("vehicle,time,x\n1,0,0\n,0.1,2\n", r"line 3: column 'vehicle' is empty"),
        (
            "vehicle,time,x\n1,0,0\n2,0,9\n1,0,1\n",
            r"line 4: agent 1 occurs .* at 0 s .*in line 2",
        ),
        ("vehicle,time,x\n1,0,0\n1,0.1,1\n1,0.2,2\n", r"no sequence; at no time are 3 vehicles"),
        ("vehicle,time,x\n1,0,0,5,6\n1,0\n1,2,3,4,5,6,7\n", "cannot be read as a comma-separated"),
    ],
)
def test_invalid_tables(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        read(path)


def test_damaged_parquet_table(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    path.write_bytes(b"PAR1 no table")
    with pytest.raises(DataError, match="cannot be read as a Parquet table"):
        read(path)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"path": "none.csv"}, DataError, r"data\.path: .* is not there"),
        ({}, ConfigError, r"data\.path is not set"),
        (
            {"path": "t.csv", "source": "https://example.org"},
            ConfigError,
            "tables are read from a folder",
        ),
    ],
)
def test_missing_table(options: dict[str, str], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        vehicle_files(VehicleTableOptions(**options))


def test_too_few_vehicles(platoon: Path) -> None:
    with pytest.raises(DataError, match=r"4 vehicles in one lane .*\(3 vehicles, 1 lanes\)"):
        read(platoon, min_vehicles=4)


def test_pairs_end_where_a_vehicle_cuts_in(tmp_path: Path) -> None:
    # d is in lane 2 except from 4 s to 6 s, between b and a; e enters late
    d = drive("d", 0, 10, 45, lane=2)
    d.loc[(d.time > 3.95) & (d.time < 6.05), "lane"] = 1
    path = saved(tmp_path / "road.csv", cars(10, lane=1), d, drive("e", 8, 10, -30, lane=1))
    assert set(spans(read(path, pairs=True))) == {
        (("b", "a"), 0.0, 3.8),
        (("c", "b"), 0.0, 10.0),
        (("b", "d"), 4.0, 6.0),
        (("d", "a"), 4.0, 6.0),
        (("b", "a"), 6.2, 10.0),
        (("e", "c"), 8.0, 10.0),
    }
    windows = read(path, pairs=True, window=3.0)
    assert {s.n_samples for s in windows} == {16}
    agents = [s.agents for s in windows]
    assert (agents.count(("c", "b")), agents.count(("b", "a"))) == (3, 2)


def test_lane_changer_divides_its_platoon(tmp_path: Path) -> None:
    d = drive("d", 0, 10, 45, lane=2)
    d.loc[d.time > 5.95, "lane"] = 1
    path = saved(tmp_path / "road.csv", cars(10, lane=1), d)
    assert spans(read(path, lane=1)) == [
        (("c", "b", "a"), 0.0, 5.8),
        (("c", "b", "d", "a"), 6.0, 10.0),
    ]
    windows = read(path, lane=1, window=5.0, min_vehicles=2)
    assert [s.agents for s in windows] == [("c", "b", "a"), ("c", "b")]
