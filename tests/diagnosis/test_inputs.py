"""Inputs of a diagnosis and the exclusion of faulty sequences."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from nnode.data.options import Faults
from nnode.data.prepare import prepare
from nnode.data.readers.esimas import EsimasOptions
from nnode.data.readers.table import TableOptions
from nnode.diagnosis.inputs import read_inputs
from nnode.errors import DataError, FaultError, NNodeError
from tests.diagnosis.recorded import lane


def table(tmp_path: Path, **more: Any) -> tuple[pd.DataFrame, TableOptions]:
    path = lane(tmp_path / "lane.csv", sequences=5, seconds=4.0, cars=3)
    options = TableOptions(domain="traffic", path=str(path), **more)
    return pd.read_csv(path), options


def exchanged(frame: pd.DataFrame, sequence: int) -> pd.DataFrame:
    """Two vehicles of a sequence exchange their paths after two seconds."""
    first, second = f"v{sequence}-0", f"v{sequence}-1"
    late = frame["time"] > 40.0 * sequence + 2.0
    return frame.assign(
        agent=frame["agent"].mask(late, frame["agent"].replace({first: second, second: first}))
    )


def spoilt(frame: pd.DataFrame) -> pd.DataFrame:
    """Two vehicles of sequence 1 exchange their paths after two seconds; one of 2 vanishes."""
    gone = (frame["agent"] == "v2-1") & (frame["time"] > 82.0)
    return exchanged(frame[~gone], 1)


def test_faulty_sequences_are_excluded(tmp_path: Path) -> None:
    frame, options = table(tmp_path)
    spoilt(frame).to_csv(options.path, index=False)
    inputs = read_inputs(options, tmp_path / "data")
    # the first seconds of sequence 2 remain
    assert [s.name for s in inputs.sequences] == ["lane/0", "lane/2", "lane/3", "lane/4"]
    assert [s.name for s in inputs.faulty] == ["lane/1"]
    swap = next(f for f in inputs.data_faults if f.kind == "identity_swap")
    assert (swap.sequence, swap.agents) == ("lane/1", ["v1-0", "v1-1"])
    assert swap.time == pytest.approx(42.2)
    assert set(inputs.faults) == {"lane/1"}
    assert inputs.faults["lane/1"][0].agents == (0, 1)


def test_prepared_data_give_same_inputs(tmp_path: Path) -> None:
    frame, options = table(tmp_path)
    spoilt(frame).to_csv(options.path, index=False)
    fresh = read_inputs(options, tmp_path / "data")
    prepare(options, tmp_path / "prepared")
    options.prepared = str(tmp_path / "prepared")
    prepared = read_inputs(options, tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
    assert prepared.data_faults == fresh.data_faults
    assert [s.name for s in prepared.sequences] == [s.name for s in fresh.sequences]


@pytest.mark.parametrize(
    ("faults", "change", "error", "message"),
    [
        (Faults.error, spoilt, FaultError, "identity_swap"),
        (
            Faults.drop,
            lambda frame: frame[frame["sequence"] == 0],
            DataError,
            "1 of 1 sequences are without a fault; a diagnosis needs",
        ),
        (
            Faults.drop,
            lambda frame: exchanged(spoilt(frame[frame["sequence"] < 3]), 0),
            DataError,
            r"1 of 3 .*identity_swap in 2",
        ),
        (
            Faults.keep,
            lambda frame: frame[frame["agent"].str.endswith("-2")],
            DataError,
            "no vehicle follows another in any of the 5 sequences",
        ),
    ],
)
def test_unusable_data(
    tmp_path: Path,
    faults: Faults,
    change: Callable[[pd.DataFrame], pd.DataFrame],
    error: type[NNodeError],
    message: str,
) -> None:
    frame, options = table(tmp_path, faults=faults)
    change(frame).to_csv(options.path, index=False)
    with pytest.raises(error, match=message):
        read_inputs(options, tmp_path / "data")


@pytest.mark.real
def test_identity_swaps_of_real_recording(real_data: Path, tmp_path: Path) -> None:
    options = EsimasOptions(source=str(real_data), recording="1-1_1")
    inputs = read_inputs(options, tmp_path)
    swaps = [fault for fault in inputs.data_faults if fault.kind == "identity_swap"]
    assert len({fault.sequence for fault in swaps}) == 6
    assert len(inputs.sequences) == 22
    assert len(inputs.faulty) == 12
    # the source has no identifiers: agents are numbered
    assert all(agent.isdigit() for agent in swaps[0].agents)
