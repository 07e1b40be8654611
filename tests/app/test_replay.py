"""Players of tables: who is measured and simulated under one name, at one time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import nnode
from nnode.errors import ConfigError, DataError
from nnode.pages.replay import Zone

SPEED = {"a": 10.0, "b": 12.0}


def cars(dt: float, seconds: float, *, late: float = 0.0, sequence: str = "s") -> pd.DataFrame:
    """Two cars at constant speeds."""
    rows = [
        {"sequence": sequence, "time": t, "agent": agent, "x": 50 * (agent == "b") + v * t - late}
        for t in dt * np.arange(round(seconds / dt) + 1)
        for agent, v in SPEED.items()
    ]
    return pd.DataFrame(rows)


def held(path: Path) -> dict[str, Any]:
    """The data of a page."""
    page = path.read_text(encoding="utf-8")
    text = page[page.index('"application/json">') + 19 :]
    return dict(json.loads(text[: text.index("</script>")]))


def tracks(rows: list[list[int | None]]) -> np.ndarray:
    """``(rows, K)`` m."""
    return np.array([[np.nan if v is None else v for v in row] for row in rows]).cumsum(1) / 100


def test_a_simulation_with_steps_of_its_own_is_shown_at_the_measured_times(tmp_path: Path) -> None:
    measured = cars(0.2, 4.0)
    other = cars(0.5, 3.0, late=2.0)
    path = nnode.replay(
        measured,
        {"mine": other, "short": other[other["agent"] == "a"]},
        tmp_path / "r.html",
        domain="traffic",
        zones=[Zone("zone", x=(10.0, 20.0))],
    )
    result = held(path)
    (scene,) = result["scenes"]
    real = tracks(scene["measured"])
    np.testing.assert_allclose(real[1], 50 + 12 * 0.2 * np.arange(21), atol=0.0051)
    mine, short = (one["x"] for one in scene["simulated"])
    assert [one["title"] for one in scene["simulated"]] == ["mine", "short"]
    assert [row[16:] for row in mine] == [[None] * 5] * 2  # after 3 s nothing was simulated
    np.testing.assert_allclose(tracks([r[:16] for r in mine]), real[:, :16] - 2, atol=0.0101)
    assert short[1] == [None] * 21
    assert result["zones"] == [{"label": "zone", "x": [10.0, 20.0]}]


def test_files_of_people_and_walls(tmp_path: Path) -> None:
    time = 0.1 * np.arange(6)
    people = pd.DataFrame({"sequence": 1, "time": time, "agent": 7, "x": time, "y": 1 + time})
    people.to_csv(tmp_path / "real.csv", index=False)
    people.assign(y=1.0).to_parquet(tmp_path / "model.parquet")
    pd.DataFrame({"x1": [0.0], "y1": [0.0], "x2": [4.0], "y2": [0.0]}).to_csv(
        tmp_path / "walls.csv", index=False
    )
    path = nnode.replay(
        tmp_path / "real.csv",
        tmp_path / "model.parquet",
        tmp_path / "r.html",
        domain="crowd",
        walls=tmp_path / "walls.csv",
    )
    (scene,) = held(path)["scenes"]
    assert (scene["dims"], scene["walls"]) == (2, [[0.0, 0.0, 4.0, 0.0]])
    np.testing.assert_allclose(tracks(scene["measured"]), [time, 1 + time], atol=0.0051)


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    one, other = cars(0.2, 2.0), cars(0.2, 2.0, sequence="t")
    with pytest.raises(DataError, match="those measured are called s and the like, those simul"):
        nnode.replay(one, other, tmp_path / "r.html", domain="traffic")
    with pytest.raises(ConfigError, match="ending in"):
        nnode.replay(one, one, tmp_path / "r.txt", domain="traffic")
    with pytest.raises(DataError, match="no column 'agent'"):
        nnode.replay(one.drop(columns="agent"), one, tmp_path / "r.html", domain="traffic")
    path = nnode.replay(pd.concat([one, other]), one, tmp_path / "r.html", domain="traffic")
    assert "The player contains 1 of 2 sequences." in path.read_text(encoding="utf-8")
