"""``nnode discover`` on files in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from tests.app.conftest import Script, read_json
from tests.diagnosis.recorded import corridor, lane


@pytest.fixture
def highd(tmp_path: Path) -> Path:
    """Platoons of cars in separate lanes, 5 frames/s."""
    table = pd.read_csv(lane(tmp_path / "lane.csv", sequences=9, seconds=8.0, cars=3))
    number = pd.factorize(table["agent"])[0] + 1
    frame = ((table["time"] - 40 * table["sequence"]) * 5).round().astype(int)
    pd.DataFrame(
        {
            "frame": frame,
            "id": number,
            "x": table["x"] - 4.5,
            "width": 4.5,
            "laneId": table["sequence"] + 1,
        }
    ).to_csv(tmp_path / "01_tracks.csv", index=False)
    pd.DataFrame({"id": sorted(set(number)), "class": "Car", "drivingDirection": 2}).to_csv(
        tmp_path / "01_tracksMeta.csv", index=False
    )
    (tmp_path / "01_recordingMeta.csv").write_text("id,frameRate\n1,5\n")
    return tmp_path / "01_tracks.csv"


@pytest.fixture
def pedpy(tmp_path: Path) -> Path:
    """People in a corridor, 10 frames/s; the walkable area lies in the same folder."""
    table = pd.read_csv(corridor(tmp_path / "walk.csv", sequences=9, seconds=2.0, people=4)[0])
    number = pd.factorize(table["agent"])[0] + 1
    rows = zip(
        number, (table["time"] * 10).round().astype(int), table["x"], table["y"], strict=True
    )
    text = "".join(f"{who} {frame} {x:.4f} {y:.4f} 0\n" for who, frame, x, y in rows)
    (tmp_path / "walk.txt").write_text(f"# framerate: 10 fps\n# id frame x/m y/m z/m\n{text}")
    (tmp_path / "area.wkt").write_text("POLYGON ((-6 0, 6 0, 6 4, -6 4, -6 0))")
    return tmp_path / "walk.txt"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("source", "options"),
    [
        # the true law has no inertia
        (
            "highd",
            "model=lin model.leader=measured data.window=null discover.effects=[inertia]",
        ),
        # the true motion has no slope
        ("pedpy", "model=sf model.B=0.3 data.t_seq=2 discover.effects=[drift]"),
    ],
)
def test_a_diagnosis_ends_with_a_verdict(
    request: pytest.FixtureRequest, script: Script, tmp_path: Path, source: str, options: str
) -> None:
    path: Path = request.getfixturevalue(source)
    folder = tmp_path / "run"
    words = [*options.split(), f"data={source}", f"data.path={path}"]
    words += [f"data.geometry={area}" for area in path.parent.glob("area.wkt")]
    words += ["discover.page=false", "discover.compare=[]", f"hydra.run.dir={folder}"]
    done = script("discover", *words)
    report: dict[str, Any] = read_json(folder / "report.json")
    assert f"verdict: {report['verdict']}" in done.stdout
    # six clusters are the minimum for a test of one effect
    assert report["clusters"]["exploration"] == report["clusters"]["least_exploration"] == 6
    # with so few clusters the effect may not be testable
    absences = report["absences"]
    testable = not absences or any(absence["testable"] for absence in absences)
    assert report["verdict"] in ("unknown", "none" if testable else "not_testable")
    assert report["effects"] == report["data_faults"] == []
    assert len(report["split"]["exploration"]) + len(report["split"]["confirmation"]) == 9
