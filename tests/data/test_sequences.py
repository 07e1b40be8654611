"""Sequences in memory: what is read, how they are divided and shown."""

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


def test_a_data_frame_is_read_as_its_file_is(tidy: pd.DataFrame, tmp_path: Path) -> None:
    tidy.to_parquet(tmp_path / "table.parquet")
    options = TableOptions(domain="traffic", path=str(tmp_path / "table.parquet"))
    store = prepare(options, tmp_path / "store")
    for result in (nnode.sequences(tidy), nnode.sequences(tmp_path / "table.parquet")):
        assert [s.name for s in result] == [entry["name"] for entry in store.index]
        for ours, theirs in zip(result, store, strict=True):
            assert np.array_equal(ours.x, theirs.x)
            assert np.array_equal(ours.time, theirs.time)
            assert ours.agents == theirs.agents
            assert np.array_equal(ours.length, theirs.length)
        assert result.manifest["counts"] == store.manifest["counts"]
        assert result.domain == "traffic"


def test_the_format_shows_in_the_columns(tidy: pd.DataFrame) -> None:
    assert nnode.sequences(tidy).manifest["reader"] == TableOptions.__name__
    two = nnode.sequences(pairs(number=2, seconds=3.0))
    assert two.manifest["reader"] == PairOptions.__name__
    assert [s.n_agents for s in two] == [2, 2]
    assert two[0].v is not None
    single = tidy[tidy.sequence == 0].rename(columns={"agent": "vehicle"}).drop(columns="sequence")
    (cars,) = nnode.sequences(single, dt=0.1)
    assert nnode.sequences(single).manifest["reader"] == VehicleTableOptions.__name__
    assert cars.n_agents == 3
    walk = tidy.assign(y=0.5 * tidy.agent)
    assert nnode.sequences(walk, faults="keep").domain == "crowd"


def test_columns_of_other_names_and_units_are_told(tidy: pd.DataFrame) -> None:
    feet = tidy[tidy.sequence == 0].assign(front=tidy.x / 0.3048)[["time", "agent", "front"]]
    columns = {"vehicle": "agent", "x": "front"}
    (single,) = nnode.sequences(feet, data="vehicles", columns=columns, position_unit="ft", dt=0.1)
    assert single.x[:, 0, 0] == pytest.approx(tidy[tidy.agent == 0].x.to_numpy(), abs=1e-6)


def test_a_data_set_is_read_by_its_name(real_data: Path) -> None:
    result = nnode.sequences(data="esimas", recording="1-1_1", source=str(real_data))
    assert len(result) > 10
    assert {s.recording for s in result} == {"1-1_1"}


def test_parts_are_sequences_again(tidy: pd.DataFrame) -> None:
    every = nnode.sequences(tidy)
    assert every[-1].name == "table/3"
    names = [s.name for s in every]
    for key, expected in (
        (slice(1, 3), names[1:3]),
        ([2, 0], [names[2], names[0]]),
        (np.array([3]), names[3:]),
        (np.array([True, False, False, True]), [names[0], names[3]]),
    ):
        part = every[key]
        assert isinstance(part, nnode.Sequences)
        assert [s.name for s in part] == expected


def test_a_table_of_sequences_is_read_back_the_same(tidy: pd.DataFrame) -> None:
    every = nnode.sequences(tidy)
    told = every.to_dataframe()
    keys = ["sequence", "time", "agent", "x", "length"]
    pd.testing.assert_frame_equal(told[keys], tidy[keys], check_dtype=True)
    assert nnode.sequences(told).score(every) == 0.0


def test_the_score_is_minus_the_root_mean_square_distance(tidy: pd.DataFrame) -> None:
    every = nnode.sequences(tidy)
    # 3 m beside and 4 m above, in every sample but the first
    walk = tidy.assign(y=0.5 * tidy.agent, agent=tidy.agent.astype(str))
    later = walk.time > 0
    moved = walk.assign(x=walk.x + 3.0 * later, y=walk.y + 4.0 * later)
    kept = nnode.sequences(walk, faults="keep")
    assert nnode.sequences(moved, faults="keep").score(kept) == pytest.approx(-5.0)
    with pytest.raises(DataError, match="is not among the simulated ones"):
        every[:1].score(tidy)


def test_sequences_are_shown_and_labelled(tidy: pd.DataFrame) -> None:
    every = nnode.sequences(tidy)
    assert repr(every).startswith("<nnode.Sequences: 4 sequences of vehicles in lanes, 4 clusters")
    page = every._repr_html_()
    assert page.count("<tr>") == 4
    assert "<td>table/0</td>" in page
    pytest.importorskip("xarray")
    told = every.to_xarray()
    assert told.sizes == {"sequence": 4, "sample": 31, "place": 3}
    first = told.x.sel(sequence="table/1").isel(place=0).to_numpy()
    assert np.array_equal(first, every[1].x[:, 0, 0])


def test_what_holds_no_trajectories_is_refused(tidy: pd.DataFrame) -> None:
    every = nnode.sequences(tidy)
    for wrong, message in (
        ([every[0], 3], "found an entry of type int"),
        ([every[0], every[0]], "two sequences are named table/0"),
        ([], "found nothing"),
    ):
        with pytest.raises(DataError, match=message):
            nnode.Sequences(wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"data=esima is unknown.*did you mean esimas"):
        nnode.sequences(data="esima")
    with pytest.raises(ConfigError, match=r"no option data.colums; .*did you mean data.columns"):
        nnode.sequences(tidy, data="pairs", colums={})
    with pytest.raises(ConfigError, match="no data frame; give their path"):
        nnode.sequences(tidy, data="juelich")
    with pytest.raises(ConfigError, match="there is no table"):
        nnode.sequences()
