"""NGSIM's public file as it is published."""

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


def test_published_file(tmp_path: Path) -> None:
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
    tables = [period(*key, seed=i) for i, key in enumerate(periods)]
    path = published(tmp_path / "all.csv", *tables)
    names = {s.recording for s in read(path)}
    assert names == {f"{a}_{b}_lane{lane}" for a, b in periods for lane in (1, 2)}
    selected = read(path, recording="us-101_0805_lane2")
    assert {s.recording for s in selected} == {"us-101_0805_lane2"}
    assert {s.recording[-5:] for s in read(path, lane=2)} == {"lane2"}
    with pytest.raises(ConfigError, match=r"lane=9: .* has the lanes 1, 2"):
        read(path, lane=9)
    with pytest.raises(ConfigError, match="recording=i-80: unknown recording; nearest first"):
        read(path, recording="i-80")


@pytest.mark.parametrize("name", ["trajectories-0400-0415.txt", "trajectories-0400-0415.csv"])
def test_older_files_without_names_and_location(tmp_path: Path, name: str) -> None:
    table = period("i-80", "1600")
    old, new = read(quarter(tmp_path / name, table)), read(published(tmp_path / "new.csv", table))
    assert old[0].recording == "trajectories-0400-0415_1600_lane1"
    assert len(old) == len(new)
    for sequence, other in zip(old, new, strict=True):
        np.testing.assert_array_equal(sequence.x, other.x)
        assert sequence.agents == other.agents


def test_lower_case_thousands_separators_and_repeated_rows(tmp_path: Path) -> None:
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


def test_lane_change_divides_a_platoon(tmp_path: Path) -> None:
    table = period("i-80", "1600", cars=6)
    table.loc[(table.Vehicle_ID == 3) & (table.Frame_ID > 150), "Lane_ID"] = 3
    parts: dict[str, set[tuple[str, ...]]] = {"first": set(), "during": set(), "after": set()}
    for s in read(published(tmp_path / "a", table)):
        if s.recording.endswith("lane1"):
            part = "first" if s.time[0] < 5 else "during" if s.time[0] < 15 else "after"
            parts[part].add(s.agents)
    assert parts == {
        "first": {("6", "5", "4", "3", "2", "1")},
        "during": {("6", "5", "4")},  # two vehicles ahead of the lane changer are too few
        "after": {("6", "5", "4", "2", "1")},
    }


def test_reused_identifier(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Car 10 of lane 2 leaves; ten seconds later another car with its number enters at the rear."""
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


def test_prepare_needs_only_the_path(tmp_path: Path) -> None:
    path = published(tmp_path / "NGSIM.csv", period("i-80", "1600"))
    store = prepare(NgsimOptions(path=str(path), window=10.0), tmp_path / "out")
    assert len(store) == 6  # 40 s less the first 0.2 s are three windows in each of two lanes
    assert store.manifest["counts"]["dropped"] == 0
    assert store.manifest["identifiers"] == []


def test_invalid_files(tmp_path: Path) -> None:
    table = period("i-80", "1600")
    wrong_cell = table.astype({"Local_Y": object}).reset_index(drop=True)
    wrong_cell.loc[7, "Local_Y"] = "far"
    repeated = pd.concat([table, table.iloc[:1].assign(Local_Y=1.0)])
    path = tmp_path / "t.csv"
    for text, message in (
        ("id,t,x\n1,0,0\n", r"lacks Vehicle_ID, Frame_ID, .*; it has: id, t, x; .*"),
        ("1 2 3\n4 5 6\n", "has 3 columns without names; NGSIM's files have 18, 19"),
        (wrong_cell.to_csv(index=False), "line 9: column 'Local_Y' holds 'far'"),
        (repeated.to_csv(index=False), "line 4002: agent 1 occurs .* at 0.1 s .*in line 2"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=message):
            read(path)


@pytest.mark.real
def test_reconstructed_table_is_recognised_by_its_columns(real_data: Path) -> None:
    path = real_data / "ngsim" / "i80_lanes_1_2.csv"
    columns = {"vehicle": "veh", "time": "t", "speed": "v", "kind": "cls"}
    expected = read_vehicles(path, VehicleTableOptions(columns=columns, window=10.0))
    result = read(path)
    assert len(result) == 61
    for sequence, other in zip(result, expected, strict=True):
        assert (sequence.name, sequence.agents) == (other.name, other.agents)
        np.testing.assert_array_equal(sequence.x, other.x)
