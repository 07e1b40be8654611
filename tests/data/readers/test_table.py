"""Reading tidy tables: traffic and crowds, optional columns, walls, and bad tables."""

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


def rows(sequence: object, agent: object, x: np.ndarray, t0: float = 0.0, **further: object):
    time = t0 + 0.1 * np.arange(len(x))
    return pd.DataFrame({"sequence": sequence, "time": time, "agent": agent, "x": x, **further})


def read(tmp_path: Path, *parts: pd.DataFrame, suffix: str = ".csv", **options: object) -> Reading:
    path = saved(tmp_path / f"own{suffix}", *parts)
    return tables.read(TableOptions, path, **{"domain": "traffic", **options})


LINE = np.arange(5) * 2.0


def test_traffic_is_ordered_by_position(tmp_path: Path) -> None:
    parts = [rows("s1", "ahead", LINE + 40), rows("s1", "behind", LINE), rows("s2", "only", LINE)]
    first, second = read(tmp_path, *parts)
    assert first.agents == ("behind", "ahead")
    np.testing.assert_allclose(first.x[:, :, 0], LINE[:, None] + [0, 40])
    np.testing.assert_allclose(first.time, 0.1 * np.arange(5))
    assert (first.name, second.name, second.recording) == ("own/s1", "own/s2", "own")


@pytest.mark.parametrize("domain", ["traffic", "crowd"])
def test_the_order_of_rows_changes_nothing(tmp_path: Path, domain: str) -> None:
    place = {} if domain == "traffic" else {"y": 1.0}
    parts = [
        rows(
            f"s{s}",
            f"a{n}",
            LINE + 30.0 * (n * 7 % 12),
            t0=s,
            kind=f"k{n}",
            length=4.0 + n,
            **place,
        )
        for s in range(12)
        for n in range(12)
    ]
    table = pd.concat(parts)
    result = read(tmp_path, table, domain=domain)
    assert [s.name for s in result] == [f"own/s{s}" for s in range(12)]
    for seed in range(3):
        repeated = read(tmp_path, table.sample(frac=1.0, random_state=seed), domain=domain)
        for actual, other in zip(repeated, result, strict=True):
            assert (actual.name, actual.agents, actual.kind) == (
                other.name,
                other.agents,
                other.kind,
            )
            np.testing.assert_array_equal(actual.x, other.x)
            np.testing.assert_array_equal(actual.time, other.time)
            np.testing.assert_array_equal(actual.length, other.length)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_crowd_with_everything(tmp_path: Path, suffix: str) -> None:
    parts = [
        rows(1, 7, LINE, y=1.0, length=0.3, kind="child", group="g", dest_x=20.0, dest_y=1.5),
        rows(1, 8, -LINE, y=2.0, length=np.nan, kind=None, group=None, dest_x=-20.0, dest_y=2.0),
    ]
    parts = [part.assign(recording="run") for part in parts]
    (s,) = read(tmp_path, *parts, suffix=suffix, domain="crowd")
    assert s.name == "run/1"
    assert s.agents == ("7", "8")
    assert s.x.shape == (5, 2, 2)
    np.testing.assert_allclose(s.x[:, 0], np.stack([LINE, np.ones(5)], axis=-1))
    np.testing.assert_allclose(s.destination, [[20, 1.5], [-20, 2]])
    np.testing.assert_array_equal(s.length, [0.3, np.nan])
    assert s.kind == ("child", "")
    assert s.group == ("g", "")


def test_recordings_are_chosen_by_name(tmp_path: Path) -> None:
    parts = [rows(i, "a", LINE, recording=f"r{i}") for i in range(3)]
    (s,) = read(tmp_path, *parts, recording=["r2"])
    assert s.recording == "r2"
    with pytest.raises(ConfigError, match="recording=r5: unknown recording"):
        read(tmp_path, *parts, recording="r5")


def test_a_platoon_whose_vehicles_never_meet_has_gaps(tmp_path: Path) -> None:
    early, late = rows("s", "a", LINE), rows("s", "late", LINE + 50, t0=1.0)
    (s,) = read(tmp_path, early, late)
    assert np.isnan(s.x[:5, 1, 0]).all()
    faults = find_faults(s, "traffic")
    assert {(fault.kind, fault.agents) for fault in faults} == {
        ("gap_in_time", (0,)),
        ("gap_in_time", (1,)),
    }


def test_walls(tmp_path: Path) -> None:
    walls = tmp_path / "walls.csv"
    walls.write_text("x1,y1,x2,y2\n0,0,5,0\n5,4,0,4\n")
    part = rows(1, 1, LINE, y=1.0)
    part.to_csv(tmp_path / "own.csv", index=False)
    options = TableOptions(domain="crowd", path="own.csv", walls="walls.csv", source=str(tmp_path))
    files = table_files(options)
    (s,) = read_table(files["table"], options, files["walls"])
    np.testing.assert_array_equal(s.walls, [[0, 0, 5, 0], [5, 4, 0, 4]])
    walls.write_text("x1,y1,x2,y2\n0,0,5,0\n5,4,5,4\n")
    with pytest.raises(DataError, match=r"walls.csv, line 3: a wall that begins where it ends"):
        read_table(files["table"], options, files["walls"])
    walls.write_text("x1,y1,x2\n0,0,5\n")
    with pytest.raises(DataError, match=r"no column 'y2'; it has: x1, y1, x2"):
        read_table(files["table"], options, files["walls"])


def driven(*, cars: int = 3, samples: int = 80) -> pd.DataFrame:
    """Cars that accelerate and brake by up to 1.5 m/s²."""
    time = 0.1 * np.arange(samples)
    x = 15 * time + 6 * np.sin(0.5 * time)
    parts = [rows("s", f"c{i}", x + 30 * i) for i in range(cars)]
    return pd.concat(parts, ignore_index=True)


def test_short_holes_are_filled(tmp_path: Path) -> None:
    table = driven()
    (whole,) = read(tmp_path, table)
    assert whole.filled == 0
    lacking = table.drop(index=[90, 91, 92, 93, 94])  # of one car
    lacking = lacking[~lacking.time.between(5.95, 6.25)]  # of all cars
    lacking.loc[20, "x"] = np.nan
    (s,) = read(tmp_path, lacking)
    np.testing.assert_allclose(s.time, whole.time, atol=1e-9)
    assert s.filled == 5 + 3 * 3 + 1
    np.testing.assert_allclose(s.x, whole.x, atol=2e-3)
    # a straight line would start late by half the change of speed over the hole
    np.testing.assert_allclose(np.diff(s.x, axis=0), np.diff(whole.x, axis=0), atol=2e-3)
    parts = read(tmp_path, lacking, fill=0.0)
    assert [len(part.time) for part in parts] == [10, 5, 39, 17]
    assert not any(part.filled or np.isnan(part.x).any() for part in parts)


@pytest.mark.parametrize("common", [True, False])
def test_uneven_times_are_interpolated_and_told(tmp_path: Path, common: bool) -> None:
    """Times that jitter by a fifth of a step, in all vehicles' rows alike or in each one's."""
    table, rng = driven(), np.random.default_rng(5)
    late = rng.uniform(-0.02, 0.02, 80 if common else 240)
    time = table.time + (np.tile(late, 3) if common else late)
    # the positions are those at the uneven times
    x = 15 * time + 6 * np.sin(0.5 * time) + 30 * table.agent.str[1:].astype(int)
    result = read(tmp_path, table.assign(time=time, x=x))
    assert isinstance(result, Reading)
    (s,) = result
    (note,) = result.notes
    assert "times are uneven" in note
    assert "are interpolated to steps of 0.1 s" in note
    exact = 15 * s.time + 6 * np.sin(0.5 * s.time)
    np.testing.assert_allclose(np.diff(s.time), 0.1, atol=1e-9)
    np.testing.assert_allclose(s.x[:, :, 0], exact[:, None] + [0, 30, 60], atol=3e-3)
    assert read(tmp_path, driven()).notes == []


def test_uneven_times_of_people(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    time = np.sort(0.2 * np.arange(40) + rng.uniform(-0.04, 0.04, 40))
    late = {n: time + 0.01 * n for n in range(3)}
    parts = [rows("s", f"p{n}", 1.3 * t, y=float(n)).assign(time=t) for n, t in late.items()]
    (s,) = read(tmp_path, *parts, domain="crowd")
    assert s.n_samples > 35
    np.testing.assert_allclose(s.x[:, :, 0], np.tile(1.3 * s.time[:, None], (1, 3)), atol=1e-9)


def test_a_platoon_begins_when_all_are_there(tmp_path: Path) -> None:
    late = driven().drop(index=[80, 81, 82, 239])
    (s,) = read(tmp_path, late)
    assert (s.time[0], s.time[-1]) == (pytest.approx(0.3), pytest.approx(7.8))
    assert s.filled == 0
    assert not np.isnan(s.x).any()


@pytest.mark.parametrize("whose", ["c1", "all"])
def test_a_long_hole_cuts_a_platoon_in_two(tmp_path: Path, whose: str) -> None:
    table = driven()
    hole = table.time.between(3.95, 5.05) & ((table.agent == whose) | (whose == "all"))
    result = read(tmp_path, table[~hole], table.assign(sequence="t"))
    before, behind, sound = result
    assert [s.name for s in result] == ["own/s_000", "own/s_001", "own/t"]
    assert (before.time[-1], behind.time[0]) == (pytest.approx(3.9), pytest.approx(5.1))
    assert sound.n_samples == 80
    assert not any(find_faults(s, "traffic") for s in result)
    (note,) = result.notes
    assert "sequence own/s: not all vehicles are there at 11 of 80 times" in note


def test_a_crowd_is_cut_where_nobody_is_there(tmp_path: Path) -> None:
    parts = [rows("s", n, LINE[[0] * 40] + np.arange(40) * 0.1, y=float(n)) for n in range(3)]
    table = pd.concat(parts)
    before, behind = read(tmp_path, table[~table.time.between(1.95, 3.05)], domain="crowd")
    assert (before.time[-1], behind.time[0]) == (pytest.approx(1.9), pytest.approx(3.1))
    assert before.n_agents == behind.n_agents == 3


def test_one_agent_twice(tmp_path: Path) -> None:
    part = rows("s", "a", LINE)
    with pytest.raises(DataError, match=r"line 7: agent a .* at 0 s \(first in line 2\)"):
        read(tmp_path, part, part)


def test_properties_belong_to_the_agent(tmp_path: Path) -> None:
    part = rows("s", "a", LINE, length=4.5)
    part.loc[2, "length"] = 4.6
    with pytest.raises(DataError, match=r"holds 4.6, before it 4.5; it belongs"):
        read(tmp_path, part)


@pytest.mark.parametrize(
    ("further", "domain", "error", "message"),
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
    ],
)
def test_bad_tables(
    tmp_path: Path, further: dict, domain: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        read(tmp_path, rows("s", "a", LINE, **further), domain=domain)


def test_missing_column_names_those_that_exist(tmp_path: Path) -> None:
    part = rows("s", "a", LINE).rename(columns={"agent": "agents"})
    with pytest.raises(
        DataError, match=r"it has: sequence, time, agents, x; did you mean 'agents'"
    ):
        read(tmp_path, part)
