"""Tidy tables: traffic and crowds, optional columns, walls, and invalid tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode.data.cut import Reading
from nnode.data.quality import find_faults
from nnode.data.readers.table import TableOptions, read_table, table_files
from nnode.errors import ConfigError, DataError
from tests.data import tables
from tests.data.tables import saved


def rows(
    sequence: object, agent: object, x: np.ndarray, t0: float = 0.0, **columns: object
) -> pd.DataFrame:
    """Positions of an agent every 0.1 s."""
    time = t0 + 0.1 * np.arange(len(x))
    return pd.DataFrame({"sequence": sequence, "time": time, "agent": agent, "x": x, **columns})


def read(tmp_path: Path, *parts: pd.DataFrame, suffix: str = ".csv", **options: object) -> Reading:
    path = saved(tmp_path / f"t{suffix}", *parts)
    return tables.read(TableOptions, path, **{"domain": "traffic", **options})


LINE = np.arange(5) * 2.0


def test_vehicles_are_ordered_by_position(tmp_path: Path) -> None:
    parts = [rows("s1", "ahead", LINE + 40), rows("s1", "behind", LINE), rows("s2", "only", LINE)]
    first, second = read(tmp_path, *parts)
    assert first.agents == ("behind", "ahead")
    np.testing.assert_allclose(first.x[:, :, 0], LINE[:, None] + [0, 40])
    np.testing.assert_allclose(first.time, 0.1 * np.arange(5))
    assert (first.name, second.name, second.recording) == ("t/s1", "t/s2", "t")


@pytest.mark.parametrize("domain", ["traffic", "crowd"])
def test_row_order_does_not_matter(tmp_path: Path, domain: str) -> None:
    place = {} if domain == "traffic" else {"y": 1.0}
    numbers = range(12)
    table = pd.concat(
        rows(f"s{s}", f"a{n}", LINE + 30.0 * (n * 7 % 12), s, kind=f"k{n}", length=4.0 + n, **place)
        for s in numbers
        for n in numbers
    )
    expected = read(tmp_path, table, domain=domain)
    assert [s.name for s in expected] == [f"t/s{s}" for s in numbers]
    for seed in range(3):
        result = read(tmp_path, table.sample(frac=1.0, random_state=seed), domain=domain)
        assert len(result) == len(expected)
        for actual, desired in zip(result, expected, strict=True):
            for field in ("name", "agents", "kind", "x", "time", "length"):
                np.testing.assert_array_equal(getattr(actual, field), getattr(desired, field))


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_crowd_with_all_columns(tmp_path: Path, suffix: str) -> None:
    parts = [
        rows(1, 7, LINE, y=1.0, length=0.3, kind="child", group="g", dest_x=20.0, dest_y=1.5),
        rows(1, 8, -LINE, y=2.0, length=np.nan, kind=None, group=None, dest_x=-20.0, dest_y=2.0),
    ]
    table = pd.concat(parts).assign(recording="run")
    (s,) = read(tmp_path, table, suffix=suffix, domain="crowd")
    assert (s.name, s.agents, s.kind, s.group) == ("run/1", ("7", "8"), ("child", ""), ("g", ""))
    assert s.x.shape == (5, 2, 2)
    np.testing.assert_allclose(s.x[:, 0], np.stack([LINE, np.ones(5)], axis=-1))
    np.testing.assert_allclose(s.destination, [[20, 1.5], [-20, 2]])
    np.testing.assert_array_equal(s.length, [0.3, np.nan])


def test_recordings_are_chosen_by_name(tmp_path: Path) -> None:
    parts = [rows(i, "a", LINE, recording=f"r{i}") for i in range(3)]
    (s,) = read(tmp_path, *parts, recording=["r2"])
    assert s.recording == "r2"
    with pytest.raises(ConfigError, match="recording=r5: unknown recording"):
        read(tmp_path, *parts, recording="r5")


def test_vehicles_that_are_never_present_together_have_gaps(tmp_path: Path) -> None:
    (s,) = read(tmp_path, rows("s", "a", LINE), rows("s", "late", LINE + 50, t0=1.0))
    assert np.isnan(s.x[:5, 1, 0]).all()
    faults = [(fault.kind, fault.agents) for fault in find_faults(s, "traffic")]
    assert set(faults) == {("gap_in_time", (0,)), ("gap_in_time", (1,))}


def test_walls(tmp_path: Path) -> None:
    saved(tmp_path / "t.csv", rows(1, 1, LINE, y=1.0))
    options = TableOptions(domain="crowd", path="t.csv", walls="walls.csv", source=str(tmp_path))
    path = tmp_path / "walls.csv"

    def walls(text: str) -> np.ndarray:
        path.write_text(text)
        (s,) = read_table(tmp_path / "t.csv", options, table_files(options)["walls"])
        return s.walls

    result = walls("x1,y1,x2,y2\n0,0,5,0\n5,4,0,4\n")
    np.testing.assert_array_equal(result, [[0, 0, 5, 0], [5, 4, 0, 4]])
    with pytest.raises(DataError, match=r"walls.csv, line 3: a wall that begins where it ends"):
        walls("x1,y1,x2,y2\n0,0,5,0\n5,4,5,4\n")
    with pytest.raises(DataError, match=r"no column 'y2'; it has: x1, y1, x2"):
        walls("x1,y1,x2\n0,0,5\n")


def position(time: np.ndarray) -> np.ndarray:
    """Position (m) of a car that accelerates and brakes by up to 1.5 m/s²."""
    return 15 * time + 6 * np.sin(0.5 * time)


def driven() -> pd.DataFrame:
    """Three cars on the same path, 30 m apart."""
    x = position(0.1 * np.arange(80))
    return pd.concat([rows("s", f"c{i}", x + 30 * i) for i in range(3)], ignore_index=True)


def test_short_holes_are_filled(tmp_path: Path) -> None:
    table = driven()
    (complete,) = read(tmp_path, table)
    assert complete.filled == 0
    table = table.drop(index=[90, 91, 92, 93, 94])  # of one car
    table = table[~table.time.between(5.95, 6.25)]  # of all cars
    table.loc[20, "x"] = np.nan
    (s,) = read(tmp_path, table)
    np.testing.assert_allclose(s.time, complete.time, atol=1e-9)
    assert s.filled == 5 + 3 * 3 + 1
    np.testing.assert_allclose(s.x, complete.x, atol=2e-3)
    # Linear interpolation would start late by half the change of speed over the hole.
    np.testing.assert_allclose(np.diff(s.x, axis=0), np.diff(complete.x, axis=0), atol=2e-3)
    parts = read(tmp_path, table, fill=0.0)
    assert [len(part.time) for part in parts] == [10, 5, 39, 17]
    assert not any(part.filled or np.isnan(part.x).any() for part in parts)


@pytest.mark.parametrize("common", [True, False])
def test_uneven_times_are_interpolated(tmp_path: Path, common: bool) -> None:
    """Times that jitter by a fifth of a step, equally for all vehicles or for each separately."""
    table = driven()
    jitter = np.random.default_rng(5).uniform(-0.02, 0.02, 80 if common else 240)
    time = table.time + (np.tile(jitter, 3) if common else jitter)
    x = position(time) + 30 * table.agent.str[1:].astype(int)
    result = read(tmp_path, table.assign(time=time, x=x))
    (s,), (note,) = result, result.notes
    assert "times are uneven" in note
    assert "are interpolated to steps of 0.1 s" in note
    np.testing.assert_allclose(np.diff(s.time), 0.1, atol=1e-9)
    np.testing.assert_allclose(s.x[:, :, 0], position(s.time)[:, None] + [0, 30, 60], atol=3e-3)
    assert read(tmp_path, driven()).notes == []


def test_uneven_times_of_people(tmp_path: Path) -> None:
    jitter = np.random.default_rng(5).uniform(-0.04, 0.04, 40)
    time = np.sort(0.2 * np.arange(40) + jitter)
    times = {n: time + 0.01 * n for n in range(3)}
    parts = [rows("s", f"p{n}", 1.3 * t, y=float(n)).assign(time=t) for n, t in times.items()]
    (s,) = read(tmp_path, *parts, domain="crowd")
    assert s.n_samples > 35
    np.testing.assert_allclose(s.x[:, :, 0], np.tile(1.3 * s.time[:, None], (1, 3)), atol=1e-9)


def test_platoon_begins_when_all_vehicles_are_present(tmp_path: Path) -> None:
    (s,) = read(tmp_path, driven().drop(index=[80, 81, 82, 239]))
    assert (s.time[0], s.time[-1]) == (pytest.approx(0.3), pytest.approx(7.8))
    assert s.filled == 0
    assert not np.isnan(s.x).any()


@pytest.mark.parametrize("agents", [["c1"], ["c0", "c1", "c2"]])
def test_long_hole_divides_a_platoon(tmp_path: Path, agents: list[str]) -> None:
    table = driven()
    hole = table.time.between(3.95, 5.05) & table.agent.isin(agents)
    result = read(tmp_path, table[~hole], table.assign(sequence="t"))
    before, after, complete = result
    assert [s.name for s in result] == ["t/s_000", "t/s_001", "t/t"]
    assert (before.time[-1], after.time[0]) == (pytest.approx(3.9), pytest.approx(5.1))
    assert complete.n_samples == 80
    assert not any(find_faults(s, "traffic") for s in result)
    (note,) = result.notes
    assert "sequence t/s: not all vehicles are there at 11 of 80 times" in note


def test_crowd_is_divided_where_nobody_is_present(tmp_path: Path) -> None:
    table = pd.concat(rows("s", n, np.arange(40) * 0.1, y=float(n)) for n in range(3))
    before, after = read(tmp_path, table[~table.time.between(1.95, 3.05)], domain="crowd")
    assert (before.time[-1], after.time[0]) == (pytest.approx(1.9), pytest.approx(3.1))
    assert before.n_agents == after.n_agents == 3


@pytest.mark.parametrize(
    ("columns", "domain", "error", "message"),
    [
        ({"y": 1.0}, "traffic", DataError, "needs the positions x alone"),
        ({}, "crowd", DataError, "needs the positions x and y"),
        ({}, "road", ConfigError, "domain=road: expected traffic .* or crowd"),
        ({"y": 1.0, "dest_x": 3.0}, "crowd", DataError, "needs the columns dest_x and dest_y"),
        (
            {"y": np.nan},
            "crowd",
            DataError,
            r"line 2: column 'y' holds nothing \(and 4 more rows\)",
        ),
        ({"y": "here"}, "crowd", DataError, r"line 2: column 'y' holds 'here'"),
        (
            {"length": [4.5, 4.5, 4.6, 4.5, 4.5]},
            "traffic",
            DataError,
            "holds 4.6, before it 4.5; it belongs",
        ),
        (
            {"time": [0.0, 0.1, 0.2, 0.3, 0.0]},
            "traffic",
            DataError,
            r"line 6: agent a .* at 0 s \(first in line 2\)",
        ),
    ],
)
def test_invalid_tables(
    tmp_path: Path, columns: dict, domain: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        read(tmp_path, rows("s", "a", LINE).assign(**columns), domain=domain)


def test_missing_column_lists_the_columns(tmp_path: Path) -> None:
    table = rows("s", "a", LINE).rename(columns={"agent": "agents"})
    message = "it has: sequence, time, agents, x; did you mean 'agents'"
    with pytest.raises(DataError, match=message):
        read(tmp_path, table)
