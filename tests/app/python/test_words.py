"""Options in messages for who calls in Python."""

from __future__ import annotations

import pandas as pd
import pytest

import nnode
from nnode.app.python.words import as_arguments
from nnode.errors import ConfigError, DataError
from tests.data.check.planted import cars


@pytest.mark.parametrize(
    ("shell", "python"),
    [
        ("data.faults=keep keeps faulty ones", "faults='keep' keeps faulty ones"),
        ("set data.columns.x=pos", "set columns={'x': 'pos'}"),
        ("data.split.heldout=0 to train on", "heldout=0 to train on"),
        ("data.split.mode=auto, or", "split={'mode': 'auto'}, or"),
        ("lower data.min_samples or data.window", "lower min_samples or window"),
        ("set data.prepared=null.", "set prepared=None."),
        ("data=vehicles, or data.frame_rate=25", "data='vehicles', or frame_rate=25"),
        ("/home/data.path/a.csv and my-data.faults", "/home/data.path/a.csv and my-data.faults"),
    ],
)
def test_options_are_arguments(shell: str, python: str) -> None:
    assert as_arguments(shell) == python


def test_what_a_message_names_is_taken() -> None:
    table = pd.concat(
        [
            cars(3, 6.0).assign(sequence=k).rename(columns={"veh": "agent", "t": "time"})
            for k in range(3)
        ]
    )[["sequence", "time", "agent", "x"]]
    broken = table.assign(x=table.x.where(table.time != 3.0, table.x + 300))
    for call in (nnode.fit, nnode.sequences, nnode.Calibrator().fit):
        with pytest.raises(DataError, match=r"faults='keep' keeps faulty ones"):
            call(broken)  # type: ignore[operator]
    assert len(nnode.sequences(broken, faults="keep")) == 3
    assert nnode.fit(broken, "traffic", epochs=1, heldout=0, faults="keep").n_iter == 1
    with pytest.raises(ConfigError, match=r"no option fault; .*did you mean faults\?"):
        nnode.fit(table, "traffic", fault="keep")


def test_what_may_be_two_things_is_an_error_that_names_both() -> None:
    table = cars(4, 10.0)
    two = table.assign(track=table.veh + (table.t > 5))
    with pytest.raises(ConfigError, match=r"agent may be veh or track.*columns=\{'agent': 'veh'\}"):
        nnode.fit(two, "traffic")
    assert len(nnode.sequences(two, columns={"agent": "track"})) > 0
    frames = table.assign(frame=(10 * table.t).round()).drop(columns=["t", "v"])
    with pytest.raises(ConfigError, match=r"5 or 10 or .* frames/s fit: .*frame_rate=\d+"):
        nnode.fit(frames, "traffic")
    assert nnode.sequences(frames, frame_rate=10)[0].dt == pytest.approx(0.2)
