"""Reading OpenACC: gaps to positions, holes, what is told of vehicles, laps of a circle."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode.data import download
from nnode.data.options import Agents
from nnode.data.prepare import prepare
from nnode.data.readers.openacc import OpenAccOptions, find_laps
from nnode.errors import ConfigError, DataError
from tests.data import tables

MAKES = ("SMART", "TESLA", "BMW", "TESLA")
#: m/s and m of the run below.
SPEED, GAP = 10.0, np.array([20.0, 15.0, 30.0])


def run(seconds: float = 20.0, radius: float = 100.0) -> pd.DataFrame:
    """Four vehicles on a circle at a constant speed; the third has no coordinates."""
    t = 100.0 + 0.1 * np.arange(round(10 * seconds) + 1)
    table = {"Time": t}
    for i in range(4):
        s = SPEED * (t - 100.0) - i * 20.0
        table[f"Speed{i + 1}"] = np.full(len(t), SPEED)
        table[f"E{i + 1}"] = radius * np.sin(s / radius) if i != 2 else np.full(len(t), np.nan)
        table[f"N{i + 1}"] = radius * np.cos(s / radius) if i != 2 else np.full(len(t), np.nan)
    for i in range(3):
        table[f"IVS{i + 1}"] = np.full(len(t), GAP[i])
    return pd.DataFrame(table)


def save(path: Path, table: pd.DataFrame, acc: str = "1", setting: str = "S", n: int = 4) -> Path:
    head = [
        "Date,8,10,2019",
        f"Vehicle_order,{','.join(MAKES)},",
        f"Number_of_vehicles,{n}",
        f"ACC,{acc}",
        f"Distance_setting,{setting}",
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(head) + "\n" + table.to_csv(index=False))
    return path


read = partial(tables.read, OpenAccOptions)


def test_positions_are_the_leaders_path_and_the_gaps(tmp_path: Path) -> None:
    (s,) = read(save(tmp_path / "short" / "part1.csv", run()).parent.parent)
    assert (s.name, s.recording) == ("short_part1/000", "short_part1")
    assert s.agents == ("TESLA_4", "BMW", "TESLA_2", "SMART")
    assert s.kind == ("TESLA", "BMW", "TESLA", "SMART")
    assert s.group == ("S", "S", "S", "")
    np.testing.assert_allclose(s.time, 100 + 0.1 * np.arange(201))
    np.testing.assert_allclose(s.x[:, 3, 0], SPEED * (s.time - 100), atol=1e-9)
    np.testing.assert_allclose(s.v, SPEED)
    np.testing.assert_array_equal(s.length, 5.0)
    np.testing.assert_allclose(np.diff(s.x[:, :, 0], axis=1) - 5.0, np.tile(GAP[::-1], (201, 1)))


def test_what_is_told(tmp_path: Path) -> None:
    path = save(tmp_path / "part1.csv", run(), acc="0", setting="")
    (s,) = read(path, kind="order", group="acc", length=None)
    assert s.kind == ("4", "3", "2", "1")
    assert s.group == ("people", "people", "people", "")
    assert s.length is None
    np.testing.assert_allclose(np.diff(s.x[0, :, 0]), GAP[::-1])
    (s,) = read(path, kind=None, group=None)
    assert s.kind is None
    assert s.group is None
    with pytest.raises(ConfigError, match="kind=colour: expected one of make, setting"):
        read(path, kind="colour")


def test_a_platoon_is_cut_where_a_vehicle_is_not_known(tmp_path: Path) -> None:
    table = run(30.0)
    table.loc[100:105, "Speed3"] = np.nan  # 0.6 s are filled
    table.loc[200:, "Speed3"] = np.nan
    path = save(tmp_path / "a.csv", table)
    first, second = read(path)
    assert (first.n_agents, first.time[-1]) == (4, pytest.approx(119.9))
    assert second.agents == ("TESLA_2", "SMART")
    np.testing.assert_allclose(second.x[0, 1, 0], SPEED * 20)
    result = read(path, window=5.0, dt=0.5)
    assert [s.n_agents for s in result] == [4, 4, 4, 2, 2, 2]
    assert {s.n_samples for s in result} == {11}
    without = table.drop(columns=["Speed2", "E2", "N2", "IVS1", "IVS2"]).iloc[:200]
    (s,) = read(save(tmp_path / "b.csv", without))
    assert s.agents == ("TESLA_4", "BMW")


def test_times_without_a_row_are_holes(tmp_path: Path) -> None:
    table = run(30.0).drop(index=range(100, 140))
    first, second = read(save(tmp_path / "a.csv", table))
    assert (first.time[-1], second.time[0]) == pytest.approx((109.9, 114.0))
    # over the hole the leader drives on at the speed of its ends
    np.testing.assert_allclose(second.x[0, 3, 0], SPEED * 14)


def test_gaps_that_are_none_count_as_holes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    table = run(30.0)
    table.loc[50, "IVS1"] = 23.0  # it and its neighbours, 0.3 s in all: filled
    table.loc[100:150, "IVS3"] = -1.0
    path = save(tmp_path / "a.csv", table)
    with caplog.at_level(logging.INFO):
        result = read(path)
    assert [s.n_agents for s in result] == [4, 3, 4]
    assert [s.filled for s in result] == [3, 0, 0]
    np.testing.assert_allclose(np.diff(result[0].x[:, 2:, 0], axis=1), GAP[0] + 5.0)
    assert "3 of 301 gaps of TESLA_2 to SMART" in caplog.text
    assert np.ptp(read(path, max_error=None)[0].x[:, 3] - read(path, max_error=None)[0].x[:, 2]) > 2


def test_laps_of_a_circle(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    t = np.arange(0, 200, 0.1)
    s = 12.0 * t
    circle = 100 * np.stack([np.cos(s / 100), np.sin(s / 100)], -1)
    by_speed, path = find_laps(s, circle)
    assert len(by_speed) == 3
    np.testing.assert_allclose(by_speed, 2 * np.pi * 100, rtol=1e-4)
    # chords of 1.2 m are shorter than arcs by 6e-6
    np.testing.assert_allclose(path, by_speed, rtol=1e-4)
    faster, path = find_laps(1.02 * s, circle)
    assert faster.sum() / path.sum() == pytest.approx(1.02, abs=1e-4)
    assert len(find_laps(s, np.full((len(s), 2), np.nan))[0]) == 0
    table = run(150.0)
    with caplog.at_level(logging.INFO):
        read(save(tmp_path / "a.csv", table))
        assert "laps of SMART: 2, 628.3 to 628.3 m by its speed" in caplog.text
        assert "differ" not in caplog.text
        read(save(tmp_path / "b.csv", table.assign(Speed1=SPEED * 1.03)), max_error=None)
    assert "they differ by more than 1 %" in caplog.text


def test_a_table_of_rows(tmp_path: Path) -> None:
    t = np.arange(1.0, 11.0, 0.1)
    rows = [
        pd.DataFrame(
            {
                "run": "p7",
                "setting": "min",
                "acc": True,
                "position": p,
                "make": m,
                "t": t,
                "v": SPEED,
                "gap": GAP[p - 2] if p > 1 else np.nan,
            }
        )
        for p, m in ((3, "C"), (1, "A"), (2, "B"))
    ]
    path = tmp_path / "runs.parquet"
    pd.concat(rows).sample(frac=1.0, random_state=1).to_parquet(path)  # in any order
    (s,) = read(path)
    assert (s.name, s.agents, s.group) == ("p7/000", ("C", "B", "A"), ("min", "min", ""))
    np.testing.assert_allclose(np.diff(s.x[0, :, 0]) - 5, GAP[:2][::-1])
    pd.concat([*rows, rows[0]]).to_parquet(path)
    with pytest.raises(DataError, match="two rows of one position"):
        read(path)


def test_files_of_another_layout_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="line 3: 5 vehicles, but line 2 has the order of 4"):
        read(save(tmp_path / "a.csv", run(), n=5))
    with pytest.raises(DataError, match=r"the time 100\.25 s is no whole number of steps"):
        read(save(tmp_path / "b.csv", run().replace({"Time": {100.2: 100.25}})))
    text = save(tmp_path / "c.csv", run()).read_text().replace("ACC,", "Acc,")
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(DataError, match="line 4: expected ACC"):
        read(tmp_path / "c.csv")
    table = run().astype({"IVS1": object})
    table.loc[2, "IVS1"] = "x"
    with pytest.raises(DataError, match="line 9: column 'IVS1' holds 'x'"):
        read(save(tmp_path / "e.csv", table))
    with pytest.raises(DataError, match="stand at times from 100 to 1e"):
        read(save(tmp_path / "f.csv", run().replace({"Time": {120.0: 1e9}})))
    with pytest.raises(DataError, match="no sequence; in 1 runs"):
        read(save(tmp_path / "d.csv", run(2.0)))


def test_published_files_have_their_addresses() -> None:
    origin = download.ORIGINS["openacc"]
    assert set(origin.places) == set(origin.files)
    assert origin.url("no_ACC_handling_part40.csv").endswith(
        "/8781ec31a976113210a9809b98345c76594c3896/data/OpenACC_data/no_ACC/handling_part40.csv"
    )


@pytest.mark.real
def test_zalazone(real_data: Path, tmp_path: Path) -> None:
    options = OpenAccOptions(source=str(real_data), agents=Agents["global"])
    store = prepare(options, tmp_path)
    assert len({s.recording for s in store}) == 6
    (s,) = (s for s in store if s.recording == "short_setting_dynamic_part14")
    table = pd.read_csv(real_data / f"openacc/zalazone/{s.recording}.csv", skiprows=5).set_index(
        "Time"
    )
    rows = table.loc[np.round(s.time, 1)]
    gaps = np.diff(s.x[:, :, 0], axis=1)[:, ::-1] - 5.0
    measured = rows[[f"IVS{i}" for i in range(1, 10)]].to_numpy()
    stated = np.isfinite(measured)
    np.testing.assert_allclose(gaps[stated], measured[stated], atol=1e-9)


@pytest.mark.real
def test_astazero(real_data: Path) -> None:
    path = real_data / "openacc" / "astazero.parquet"
    table = pd.read_parquet(path)
    result = read(path)
    assert len(result) == table.run.nunique() == 7
    for s in result:
        rows = table[table.run == s.recording].pivot(index="t", columns="position", values="gap")
        gaps = np.diff(s.x[:, :, 0], axis=1)[:, ::-1] - 5.0
        np.testing.assert_allclose(gaps, rows[[2, 3, 4, 5]].to_numpy(), atol=1e-6)
