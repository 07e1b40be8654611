"""What a diagnosis is given, and what it does without."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from nnode.data.options import Faults
from nnode.data.prepare import prepare
from nnode.data.readers.esimas import EsimasOptions
from nnode.data.readers.table import TableOptions
from nnode.discover.inputs import read_inputs
from nnode.errors import DataError, FaultError
from tests.discover.recorded import lane


def table(tmp_path: Path, **more: object) -> tuple[pd.DataFrame, TableOptions]:
    path = lane(tmp_path / "lane.csv", sequences=5, seconds=4.0, cars=3)
    options = TableOptions(domain="traffic", path=str(path), **more)  # type: ignore[arg-type]
    return pd.read_csv(path), options


def spoil(frame: pd.DataFrame, path: str) -> None:
    """Two vehicles of sequence 1 exchange their paths after two seconds; one of 2 vanishes."""
    own = frame["sequence"] == 1
    late = own & (frame["time"] > 42.0)
    names = {"v1-0": "v1-1", "v1-1": "v1-0"}
    frame.loc[late, "agent"] = frame.loc[late, "agent"].replace(names)
    gone = (frame["agent"] == "v2-1") & (frame["time"] > 82.0)
    frame[~gone].to_csv(path, index=False)


def test_faulty_sequences_are_named_and_left_out(tmp_path: Path) -> None:
    frame, options = table(tmp_path)
    spoil(frame, options.path)
    inputs = read_inputs(options, tmp_path / "data")
    # of the other one the first seconds are left
    assert [s.name for s in inputs.sequences] == ["lane/0", "lane/2", "lane/3", "lane/4"]
    assert [s.name for s in inputs.faulty] == ["lane/1"]
    swap = next(f for f in inputs.data_faults if f.kind == "identity_swap")
    assert (swap.sequence, swap.agents) == ("lane/1", ["v1-0", "v1-1"])
    assert swap.time == pytest.approx(42.2)
    assert set(inputs.faults) == {"lane/1"}
    assert inputs.faults["lane/1"][0].agents == (0, 1)


def test_prepared_data_give_the_same(tmp_path: Path) -> None:
    frame, options = table(tmp_path)
    spoil(frame, options.path)
    fresh = read_inputs(options, tmp_path / "data")
    prepare(options, tmp_path / "prepared")
    options.prepared = str(tmp_path / "prepared")
    again = read_inputs(options, tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
    assert again.data_faults == fresh.data_faults
    assert [s.name for s in again.sequences] == [s.name for s in fresh.sequences]


def test_faults_can_be_refused(tmp_path: Path) -> None:
    frame, options = table(tmp_path, faults=Faults.error)
    spoil(frame, options.path)
    with pytest.raises(FaultError, match="identity_swap"):
        read_inputs(options, tmp_path / "data")


def test_a_single_sequence_is_too_little(tmp_path: Path) -> None:
    frame, options = table(tmp_path)
    frame[frame["sequence"] == 0].to_csv(options.path, index=False)
    with pytest.raises(DataError, match="1 of 1 sequences are without a fault; a diagnosis needs"):
        read_inputs(options, tmp_path / "data")


def test_too_many_faults_are_counted(tmp_path: Path) -> None:
    frame, options = table(tmp_path)
    frame = frame[frame["sequence"] < 3]
    late = (frame["sequence"] == 0) & (frame["time"] > 2.0)
    names = {"v0-0": "v0-1", "v0-1": "v0-0"}
    frame.loc[late, "agent"] = frame.loc[late, "agent"].replace(names)
    spoil(frame, options.path)
    with pytest.raises(DataError, match=r"1 of 3 .*identity_swap in 2"):
        read_inputs(options, tmp_path / "data")


def test_without_followers_there_is_nothing_to_diagnose(tmp_path: Path) -> None:
    frame, options = table(tmp_path, faults=Faults.keep)
    frame[frame["agent"].str.endswith("-2")].to_csv(options.path, index=False)
    with pytest.raises(DataError, match="no vehicle follows another in any of the 5 sequences"):
        read_inputs(options, tmp_path / "data")


@pytest.mark.real
def test_identity_swaps_of_a_real_recording_are_named(real_data: Path, tmp_path: Path) -> None:
    options = EsimasOptions(source=str(real_data), recording="1-1_1")
    inputs = read_inputs(options, tmp_path)
    swaps = {f.sequence for f in inputs.data_faults if f.kind == "identity_swap"}
    assert len(swaps) == 6
    assert len(inputs.sequences) == 22
    assert len(inputs.faulty) == 12
    first = next(f for f in inputs.data_faults if f.kind == "identity_swap")
    # the source has no identifiers: agents are numbered
    assert all(agent.isdigit() for agent in first.agents)
