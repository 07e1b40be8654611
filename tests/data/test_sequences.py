"""Sequences in memory: reading, selection and display."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import nnode
from nnode.data.prepare import prepare
from nnode.data.readers.pairs import PairOptions
from nnode.data.readers.table import TableOptions
from nnode.data.readers.vehicles import VehicleTableOptions
from nnode.errors import ConfigError, DataError
from tests.app.following import pairs, table


@pytest.fixture(scope="module")
def tidy() -> pd.DataFrame:
    return table(platoons=4, seconds=3.0)


def test_data_frame_equals_file_and_store(tidy: pd.DataFrame, tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    tidy.to_parquet(path)
    store = prepare(TableOptions(domain="traffic", path=str(path)), tmp_path / "store")
    for result in (nnode.sequences(tidy), nnode.sequences(path)):
        assert [s.name for s in result] == [entry["name"] for entry in store.index]
        for actual, expected in zip(result, store, strict=True):
            for field in ("x", "time", "agents", "length"):
                np.testing.assert_array_equal(getattr(actual, field), getattr(expected, field))
        assert result.manifest["counts"] == store.manifest["counts"]
        assert result.domain == "traffic"


def test_format_follows_from_the_columns(tidy: pd.DataFrame) -> None:
    assert nnode.sequences(tidy).manifest["reader"] == TableOptions.__name__
    read_pairs = nnode.sequences(pairs(number=2, seconds=3.0))
    assert read_pairs.manifest["reader"] == PairOptions.__name__
    assert [s.n_agents for s in read_pairs] == [2, 2]
    assert read_pairs[0].v is not None
    platoon = tidy[tidy.sequence == 0].rename(columns={"agent": "vehicle"}).drop(columns="sequence")
    assert nnode.sequences(platoon).manifest["reader"] == VehicleTableOptions.__name__
    assert [s.n_agents for s in nnode.sequences(platoon, dt=0.1)] == [3]
    assert nnode.sequences(tidy.assign(y=0.5 * tidy.agent), faults="keep").domain == "crowd"


def test_columns_and_units_are_options(tidy: pd.DataFrame) -> None:
    feet = tidy[tidy.sequence == 0].assign(front=tidy.x / 0.3048)[["time", "agent", "front"]]
    columns = {"vehicle": "agent", "x": "front"}
    (single,) = nnode.sequences(feet, data="vehicles", columns=columns, position_unit="ft", dt=0.1)
    assert single.x[:, 0, 0] == pytest.approx(tidy[tidy.agent == 0].x.to_numpy(), abs=1e-6)


def test_data_set_is_read_by_name(real_data: Path) -> None:
    result = nnode.sequences(data="esimas", recording="1-1_1", source=str(real_data))
    assert len(result) > 10
    assert {s.recording for s in result} == {"1-1_1"}


def test_selections_are_sequences(tidy: pd.DataFrame) -> None:
    items = nnode.sequences(tidy)
    assert items[-1].name == "table/3"
    names = [s.name for s in items]
    for key, expected in (
        (slice(1, 3), names[1:3]),
        ([2, 0], [names[2], names[0]]),
        (np.array([3]), names[3:]),
        (np.array([True, False, False, True]), [names[0], names[3]]),
    ):
        part = items[key]
        assert isinstance(part, nnode.Sequences)
        assert [s.name for s in part] == expected


def test_round_trip_through_a_data_frame(tidy: pd.DataFrame) -> None:
    items = nnode.sequences(tidy)
    table = items.to_dataframe()
    keys = ["sequence", "time", "agent", "x", "length"]
    pd.testing.assert_frame_equal(table[keys], tidy[keys], check_dtype=True)
    assert nnode.sequences(table).score(items) == 0.0


def test_score_is_the_negative_rms_distance(tidy: pd.DataFrame) -> None:
    # 3 m along and 4 m across, in every sample except the first
    walk = tidy.assign(y=0.5 * tidy.agent, agent=tidy.agent.astype(str))
    later = walk.time > 0
    moved = walk.assign(x=walk.x + 3.0 * later, y=walk.y + 4.0 * later)
    expected, result = (nnode.sequences(table, faults="keep") for table in (walk, moved))
    assert result.score(expected) == pytest.approx(-5.0)
    with pytest.raises(DataError, match="is not among the simulated ones"):
        nnode.sequences(tidy)[:1].score(tidy)


def test_repr_html_and_xarray(tidy: pd.DataFrame) -> None:
    items = nnode.sequences(tidy)
    assert repr(items).startswith("<nnode.Sequences: 4 sequences of vehicles in lanes, 4 clusters")
    page = items._repr_html_()
    assert page.count("<tr>") == 4
    assert "<td>table/0</td>" in page
    pytest.importorskip("xarray")
    dataset = items.to_xarray()
    assert dataset.sizes == {"sequence": 4, "sample": 31, "place": 3}
    first = dataset.x.sel(sequence="table/1").isel(place=0).to_numpy()
    assert np.array_equal(first, items[1].x[:, 0, 0])


def test_invalid_sequences(tidy: pd.DataFrame) -> None:
    first = nnode.sequences(tidy)[0]
    for items, message in (
        ([first, 3], "found an entry of type int"),
        ([first, first], "two sequences are named table/0"),
        ([], "found nothing"),
    ):
        with pytest.raises(DataError, match=message):
            nnode.Sequences(items)


def test_invalid_arguments(tidy: pd.DataFrame) -> None:
    for arguments, options, message in (
        ((), {"data": "esima"}, r"data=esima is unknown.*did you mean esimas"),
        (
            (tidy,),
            {"data": "pairs", "colums": {}},
            r"no option data.colums; .*did you mean data.columns",
        ),
        ((tidy,), {"data": "juelich"}, "no data frame; give their path"),
        ((), {}, "there is no table"),
    ):
        with pytest.raises(ConfigError, match=message):
            nnode.sequences(*arguments, **options)
