"""Reading NGSIM's public file as it is published, with its path as the only option."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode.data.options import Agents
from nnode.data.prepare import prepare
from nnode.data.readers.ngsim import NgsimOptions
from nnode.data.readers.vehicles import VehicleTableOptions, read_vehicles
from nnode.errors import ConfigError, DataError
from tests.data import tables
from tests.data.readers.ngsim_file import COLUMNS, FOOT, STREET, period, published, quarter

read = partial(tables.read, NgsimOptions, window=10.0)


def test_the_published_file(tmp_path: Path) -> None:
    table = period("i-80", "1600")
    s = read(published(tmp_path / "NGSIM.csv", table))[0]
    assert (s.name, s.recording) == ("i-80_1600_lane1/000", "i-80_1600_lane1")
    assert s.agents == ("5", "4", "3", "2", "1")
    assert s.kind == ("2", "2", "3", "2", "2")
    np.testing.assert_allclose(s.length, 15 * FOOT)
    np.testing.assert_allclose(np.diff(s.time), 0.2)
    rows = table[table.Vehicle_ID == 4].set_index("Frame_ID").loc[(10 * s.time).round().astype(int)]
    np.testing.assert_allclose(s.x[:, 1, 0], rows.Local_Y * FOOT, atol=1e-9)
    np.testing.assert_allclose(s.v[:, 1, 0], rows.v_Vel * FOOT, atol=1e-9)


def test_locations_and_periods_are_recordings(tmp_path: Path) -> None:
    periods = [("i-80", "1600"), ("i-80", "1700"), ("us-101", "0750"), ("us-101", "0805")]
    tables = [period(*which, seed=i) for i, which in enumerate(periods)]
    path = published(tmp_path / "all.csv", *tables)
    names = {s.recording for s in read(path)}
    assert names == {f"{a}_{b}_lane{lane}" for a, b in periods for lane in (1, 2)}
    (only,) = {s.recording for s in read(path, recording="us-101_0805_lane2")}
    assert only == "us-101_0805_lane2"
    assert {s.recording[-5:] for s in read(path, lane=2)} == {"lane2"}
    with pytest.raises(ConfigError, match=r"lane=9: .* has the lanes 1, 2"):
        read(path, lane=9)
    with pytest.raises(ConfigError, match="recording=i-80: unknown recording; nearest first"):
        read(path, recording="i-80")


@pytest.mark.parametrize("name", ["trajectories-0400-0415.txt", "trajectories-0400-0415.csv"])
def test_older_files_have_neither_names_nor_location(tmp_path: Path, name: str) -> None:
    table = period("i-80", "1600")
    old, new = read(quarter(tmp_path / name, table)), read(published(tmp_path / "new.csv", table))
    assert old[0].recording == "trajectories-0400-0415_1600_lane1"
    assert len(old) == len(new)
    for sequence, other in zip(old, new, strict=True):
        np.testing.assert_array_equal(sequence.x, other.x)
        assert sequence.agents == other.agents


def test_capitals_thousands_and_rows_that_stand_there_twice(tmp_path: Path) -> None:
    table = period("i-80", "1600")
    expected = read(published(tmp_path / "a.csv", table))
    table.columns = [name.lower() for name in COLUMNS]
    for column in ("global_x", "local_y"):
        table[column] = [f"{value:,.3f}" for value in table[column]]
    result = read(published(tmp_path / "b.csv", table, table.iloc[:50]))
    assert len(result) == len(expected)
    np.testing.assert_allclose(result[0].x, expected[0].x, atol=1e-9)


def test_streets_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    road, street = period("i-80", "1600"), period("us-101", "0750").assign(Location="lankershim")
    street[STREET] = 2
    with caplog.at_level(logging.INFO):
        names = {s.recording for s in read(published(tmp_path / "a.csv", road, street))}
    assert names == {"i-80_1600_lane1", "i-80_1600_lane2"}
    assert f"{len(street)} rows of streets with intersections (lankershim)" in caplog.text
    with pytest.raises(DataError, match=r"intersections alone \(lankershim\)"):
        read(published(tmp_path / "b.csv", street))


def test_a_platoon_ends_where_a_vehicle_changes_lane(tmp_path: Path) -> None:
    table = period("i-80", "1600", cars=6)
    table.loc[(table.Vehicle_ID == 3) & (table.Frame_ID > 150), "Lane_ID"] = 3
    agents = {
        (s.recording[-5:], s.agents, s.time[0]) for s in read(published(tmp_path / "a", table))
    }
    first = {cars for lane, cars, start in agents if lane == "lane1" and start < 5}
    during = {cars for lane, cars, start in agents if lane == "lane1" and 5 < start < 15}
    after = {cars for lane, cars, start in agents if lane == "lane1" and start > 15}
    assert first == {("6", "5", "4", "3", "2", "1")}
    assert during == {("6", "5", "4")}  # the two ahead of the place are too few
    assert after == {("6", "5", "4", "2", "1")}


def test_an_identifier_that_is_used_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Car 10 of lane 2 leaves; the car that bears its number ten seconds later enters behind."""
    table = period("i-80", "1600", seconds=45.0)
    ten = table.Vehicle_ID == 10
    table.loc[ten & (table.Frame_ID > 250), "Local_Y"] -= 600
    table = table[~(ten & table.Frame_ID.between(150, 250))]
    path = published(tmp_path / "a.csv", table)
    with caplog.at_level(logging.INFO):
        sequences = read(path)
    late = [s.agents for s in sequences if s.time[0] > 25 and "lane2" in s.name]
    assert late == [("10#2", "9", "8", "7", "6")]
    assert "i-80_1600: 1 identifiers are used again for another vehicle" in caplog.text
    assert "such as 10, another one from 25.1 s on" in caplog.text
    kept = [s.agents for s in read(path, agents=Agents["global"]) if s.time[0] > 25]
    assert ("10", "9", "8", "7", "6") in kept


def test_a_preparation_needs_the_path_alone(tmp_path: Path) -> None:
    path = published(tmp_path / "NGSIM.csv", period("i-80", "1600"))
    store = prepare(NgsimOptions(path=str(path), window=10.0), tmp_path / "out")
    assert len(store) == 6  # 40 s less the first 0.2 s are three windows in each of two lanes
    assert store.manifest["counts"]["dropped"] == 0
    assert store.manifest["identifiers"] == []


def test_files_that_are_something_else(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("id,t,x\n1,0,0\n")
    with pytest.raises(DataError, match=r"lacks Vehicle_ID, Frame_ID, .*; it has: id, t, x; .*"):
        read(path)
    path.write_text("1 2 3\n4 5 6\n")
    with pytest.raises(DataError, match=r"has 3 columns without names; NGSIM's files have 18, 19"):
        read(path)
    table = period("i-80", "1600")
    table["Local_Y"] = table["Local_Y"].astype(object)
    table.iloc[7, COLUMNS.index("Local_Y")] = "far"
    table.to_csv(path, index=False)
    with pytest.raises(DataError, match=r"line 9: column 'Local_Y' holds 'far'"):
        read(path)
    two = pd.concat([period("i-80", "1600"), period("i-80", "1600").assign(Local_Y=1.0).iloc[:1]])
    two.to_csv(path, index=False)
    with pytest.raises(DataError, match=r"line 4002: agent 1 stands .* at 0.1 s .*in line 2"):
        read(path)


@pytest.mark.real
def test_the_reconstructed_table_is_known_by_its_columns(real_data: Path) -> None:
    path = real_data / "ngsim" / "i80_lanes_1_2.csv"
    columns = {"vehicle": "veh", "time": "t", "speed": "v", "kind": "cls"}
    expected = read_vehicles(path, VehicleTableOptions(columns=columns, window=10.0))
    result = read(path)
    assert len(result) == 61
    for sequence, other in zip(result, expected, strict=True):
        assert (sequence.name, sequence.agents) == (other.name, other.agents)
        np.testing.assert_array_equal(sequence.x, other.x)
