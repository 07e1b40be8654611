"""Recordings in the format of highD: directions, fronts, classes, and missing tables."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode.data.options import Faults
from nnode.data.prepare import prepare
from nnode.data.readers.highd import HighDOptions
from nnode.errors import ConfigError, DataError
from tests.data import tables

#: id, lane, direction, length (m), corner at the start (m), class; 20 m/s.
CARS = [
    (1, 5, 2, 4.0, 0.0, "Car"),
    (2, 5, 2, 10.0, 40.0, "Truck"),
    (3, 5, 2, 5.0, 90.0, "Car"),
    (4, 2, 1, 4.0, 300.0, "Car"),
    (5, 2, 1, 10.0, 340.0, "Truck"),
    (6, 2, 1, 5.0, 390.0, "Car"),
]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Both carriageways for 4 s at 25 frames/s; the vehicles in lane 2 drive to the left."""
    frames = np.arange(1, 102)
    tracks = pd.concat(
        pd.DataFrame(
            {
                "frame": frames,
                "id": number,
                "x": corner + (1 if direction == 2 else -1) * 0.8 * (frames - 1),
                "y": 8.0,
                "width": length,
                "height": 2.0,
                "xVelocity": 20.0 if direction == 2 else -20.0,
                "laneId": lane,
            }
        )
        for number, lane, direction, length, corner, _ in CARS
    )
    tracks.to_csv(tmp_path / "07_tracks.csv", index=False)
    meta = pd.DataFrame(
        [(number, kind, direction) for number, _, direction, _, _, kind in CARS],
        columns=["id", "class", "drivingDirection"],
    )
    meta.to_csv(tmp_path / "07_tracksMeta.csv", index=False)
    (tmp_path / "07_recordingMeta.csv").write_text("id,frameRate,speedLimit\n7,25,-1\n")
    return tmp_path / "07_tracks.csv"


read = partial(tables.read, HighDOptions)


def test_positions_increase_in_both_directions(recording: Path) -> None:
    left, right = read(recording, kinds={"Car": "car", "Truck": "truck"})
    assert [s.recording for s in (left, right)] == ["07_lane2", "07_lane5"]
    assert (left.agents, right.agents) == (("6", "5", "4"), ("1", "2", "3"))
    assert right.kind == ("car", "truck", "car")
    np.testing.assert_array_equal(right.length, [4, 10, 5])
    # the first frame is number 1, at 0.04 s; the grid's first time is 0.2 s
    np.testing.assert_allclose(right.time[0], 0.2)
    np.testing.assert_allclose(right.x[0, :, 0], np.array([4.0, 50.0, 95.0]) + 20 * 0.16)
    np.testing.assert_allclose(left.x[0, :, 0], -np.array([390.0, 340.0, 300.0]) + 20 * 0.16)
    for s in (left, right):
        np.testing.assert_allclose(s.v, 20.0)
        np.testing.assert_allclose(np.diff(s.x, axis=0), 4.0)


def test_prepare_one_lane(recording: Path, tmp_path: Path) -> None:
    options = HighDOptions(path=str(recording), lane=5, faults=Faults.error)
    store = prepare(options, tmp_path / "out")
    assert [s.recording for s in store] == ["07_lane5"]
    names = sorted(file["name"] for file in store.manifest["files"].values())
    assert names == ["07_recordingMeta.csv", "07_tracks.csv", "07_tracksMeta.csv"]


@pytest.mark.parametrize("missing", ["07_tracksMeta.csv", "07_recordingMeta.csv"])
def test_missing_table_is_named(recording: Path, missing: str) -> None:
    recording.with_name(missing).unlink()
    with pytest.raises(DataError, match=f"no file .*{missing}.*beside it"):
        read(recording)


def test_path_of_another_table_of_the_recording(recording: Path) -> None:
    with pytest.raises(ConfigError, match=r"expected a file NAME_tracks\.csv"):
        read(recording.with_name("07_tracksMeta.csv"))


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("07_tracksMeta.csv", "4,Car,1", "4,Car,3", "line 5.*drivingDirection is 3"),
        ("07_tracksMeta.csv", "2,Truck,2\n", "", "line 103.*track 2.*tracksMeta"),
        ("07_tracksMeta.csv", "drivingDirection", "way", "drivingDirection.*way"),
        ("07_recordingMeta.csv", "7,25,-1", "7,0,-1", "one row with a positive frameRate"),
        ("07_recordingMeta.csv", "7,25,-1\n", "7,25,-1\n8,25,-1\n", "one row.*2 rows"),
        ("07_tracks.csv", "1,1,0.0,8.0", "1,1,here,8.0", "line 2.*'here'"),
        ("07_tracks.csv", "2,1,0.8,8.0", "1,1,0.8,8.0", "line 3.*agent 1.*second time"),
    ],
)
def test_invalid_tables(recording: Path, name: str, old: str, new: str, message: str) -> None:
    path = recording.with_name(name)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DataError, match=f"(?s){message}"):
        read(recording)
