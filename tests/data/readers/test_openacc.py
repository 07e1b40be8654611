"""OpenACC: positions from gaps, holes, properties of vehicles, laps of a circle."""

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
#: Speed (m/s) and gaps (m) of :func:`run`.
SPEED, GAP = 10.0, np.array([20.0, 15.0, 30.0])


def run(seconds: float = 20.0, radius: float = 100.0) -> pd.DataFrame:
    """Four vehicles on a circle at a constant speed; the third has no coordinates."""
    t = 0.1 * np.arange(round(10 * seconds) + 1)
    columns = {"Time": 100.0 + t}
    for i in range(1, 5):
        angle = (SPEED * t - 20.0 * (i - 1)) / (radius if i != 3 else np.nan)
        columns[f"Speed{i}"] = np.full(len(t), SPEED)
        columns[f"E{i}"], columns[f"N{i}"] = radius * np.sin(angle), radius * np.cos(angle)
    return pd.DataFrame(columns).assign(**{f"IVS{i + 1}": gap for i, gap in enumerate(GAP)})


def save(path: Path, table: pd.DataFrame, acc: str = "1", setting: str = "S", n: int = 4) -> Path:
    header = [
        "Date,8,10,2019",
        f"Vehicle_order,{','.join(MAKES)},",
        f"Number_of_vehicles,{n}",
        f"ACC,{acc}",
        f"Distance_setting,{setting}",
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(header) + "\n" + table.to_csv(index=False))
    return path


read = partial(tables.read, OpenAccOptions)


def test_positions_follow_from_the_leader_and_the_gaps(tmp_path: Path) -> None:
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


def test_properties_of_vehicles(tmp_path: Path) -> None:
    path = save(tmp_path / "part1.csv", run(), acc="0", setting="")
    (s,) = read(path, kind="order", group="acc", length=None)
    assert s.kind == ("4", "3", "2", "1")
    assert s.group == ("people", "people", "people", "")
    assert s.length is None
    np.testing.assert_allclose(np.diff(s.x[0, :, 0]), GAP[::-1])
    (s,) = read(path, kind=None, group=None)
    assert s.kind is s.group is None
    with pytest.raises(ConfigError, match="kind=colour: expected one of make, setting"):
        read(path, kind="colour")


def test_missing_vehicle_divides_a_platoon(tmp_path: Path) -> None:
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
    table = table.drop(columns=["Speed2", "E2", "N2", "IVS1", "IVS2"]).iloc[:200]
    (s,) = read(save(tmp_path / "b.csv", table))
    assert s.agents == ("TESLA_4", "BMW")


def test_missing_rows_are_holes(tmp_path: Path) -> None:
    table = run(30.0).drop(index=range(100, 140))
    first, second = read(save(tmp_path / "a.csv", table))
    assert (first.time[-1], second.time[0]) == pytest.approx((109.9, 114.0))
    # the leader keeps the speed of the ends of the hole
    np.testing.assert_allclose(second.x[0, 3, 0], SPEED * 14)


def test_invalid_gaps_are_holes(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    table = run(30.0)
    table.loc[50, "IVS1"] = 23.0  # it and its neighbours, 0.3 s in total, are filled
    table.loc[100:150, "IVS3"] = -1.0
    path = save(tmp_path / "a.csv", table)
    with caplog.at_level(logging.INFO):
        result = read(path)
    assert [(s.n_agents, s.filled) for s in result] == [(4, 3), (3, 0), (4, 0)]
    np.testing.assert_allclose(np.diff(result[0].x[:, 2:, 0], axis=1), GAP[0] + 5.0)
    assert "3 of 301 gaps of TESLA_2 to SMART" in caplog.text
    x = read(path, max_error=None)[0].x
    assert np.ptp(x[:, 3] - x[:, 2]) > 2


def test_laps_of_a_circle() -> None:
    s = 12.0 * np.arange(0, 200, 0.1)
    circle = 100 * np.stack([np.cos(s / 100), np.sin(s / 100)], -1)
    by_speed, by_path = find_laps(s, circle)
    assert len(by_speed) == 3
    np.testing.assert_allclose(by_speed, 2 * np.pi * 100, rtol=1e-4)
    # chords of 1.2 m are shorter than arcs by 6e-6
    np.testing.assert_allclose(by_path, by_speed, rtol=1e-4)
    by_speed, by_path = find_laps(1.02 * s, circle)
    assert by_speed.sum() / by_path.sum() == pytest.approx(1.02, abs=1e-4)
    assert len(find_laps(s, np.full((len(s), 2), np.nan))[0]) == 0


def test_laps_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    table = run(150.0)
    with caplog.at_level(logging.INFO):
        read(save(tmp_path / "a.csv", table))
        assert "laps of SMART: 2, 628.3 to 628.3 m by its speed" in caplog.text
        assert "differ" not in caplog.text
        read(save(tmp_path / "b.csv", table.assign(Speed1=SPEED * 1.03)), max_error=None)
    assert "they differ by more than 1 %" in caplog.text


def test_table_with_one_row_per_vehicle_and_time(tmp_path: Path) -> None:
    columns = {"run": "p7", "setting": "min", "acc": True, "t": np.arange(1.0, 11.0, 0.1)}
    parts = [
        pd.DataFrame({**columns, "position": p, "make": make, "v": SPEED, "gap": gap})
        for p, make, gap in ((3, "C", GAP[1]), (1, "A", np.nan), (2, "B", GAP[0]))
    ]
    table = pd.concat(parts).sample(frac=1.0, random_state=1)
    path = tables.saved(tmp_path / "runs.parquet", table)
    (s,) = read(path)
    assert (s.name, s.agents, s.group) == ("p7/000", ("C", "B", "A"), ("min", "min", ""))
    np.testing.assert_allclose(np.diff(s.x[0, :, 0]) - 5, GAP[:2][::-1])
    with pytest.raises(DataError, match="two rows of one position"):
        read(tables.saved(path, table, parts[0]))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (run().replace({"Time": {100.2: 100.25}}), r"the time 100\.25 s is no whole number of"),
        (run().replace({"Time": {120.0: 1e9}}), "stand at times from 100 to 1e"),
        (run().assign(IVS1=[20.0, 20.0, "x", *[20.0] * 198]), "line 9: column 'IVS1' holds 'x'"),
        (run(2.0), "no sequence; in 1 runs"),
    ],
)
def test_invalid_tables(tmp_path: Path, table: pd.DataFrame, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read(save(tmp_path / "a.csv", table))


def test_invalid_headers(tmp_path: Path) -> None:
    path = save(tmp_path / "a.csv", run(), n=5)
    with pytest.raises(DataError, match="line 3: 5 vehicles, but line 2 has the order of 4"):
        read(path)
    path.write_text(save(path, run()).read_text().replace("ACC,", "Acc,"))
    with pytest.raises(DataError, match="line 4: expected ACC"):
        read(path)


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
    table = pd.read_csv(real_data / f"openacc/zalazone/{s.recording}.csv", skiprows=5)
    rows = table.set_index("Time").loc[np.round(s.time, 1)]
    gaps = np.diff(s.x[:, :, 0], axis=1)[:, ::-1] - 5.0
    measured = rows[[f"IVS{i}" for i in range(1, 10)]].to_numpy()
    finite = np.isfinite(measured)
    np.testing.assert_allclose(gaps[finite], measured[finite], atol=1e-9)


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
