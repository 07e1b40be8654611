"""``nnode.replay``: a player page of measured and simulated tables."""

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


def page_data(path: Path) -> dict[str, Any]:
    """The JSON data of a page."""
    page = path.read_text(encoding="utf-8")
    text = page[page.index('"application/json">') + 19 :]
    return dict(json.loads(text[: text.index("</script>")]))


def tracks(rows: list[list[int | None]]) -> np.ndarray:
    """Positions ``(rows, K)`` (m) from a page's increments."""
    return np.array([[np.nan if v is None else v for v in row] for row in rows]).cumsum(1) / 100


def test_simulations_are_resampled_to_measured_times(tmp_path: Path) -> None:
    measured = cars(0.2, 4.0)
    simulated = cars(0.5, 3.0, late=2.0)
    path = nnode.replay(
        measured,
        {"mine": simulated, "short": simulated[simulated["agent"] == "a"]},
        tmp_path / "r.html",
        domain="traffic",
        zones=[Zone("zone", x=(10.0, 20.0))],
    )
    result = page_data(path)
    (scene,) = result["scenes"]
    real = tracks(scene["measured"])
    np.testing.assert_allclose(real[1], 50 + 12 * 0.2 * np.arange(21), atol=0.0051)
    assert [entry["title"] for entry in scene["simulated"]] == ["mine", "short"]
    mine, short = (entry["x"] for entry in scene["simulated"])
    assert [row[16:] for row in mine] == [[None] * 5] * 2  # the simulation ends after 3 s
    np.testing.assert_allclose(tracks([r[:16] for r in mine]), real[:, :16] - 2, atol=0.0101)
    assert short[1] == [None] * 21
    assert result["zones"] == [{"label": "zone", "x": [10.0, 20.0]}]


def test_replay_of_people_and_walls_from_files(tmp_path: Path) -> None:
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
    (scene,) = page_data(path)["scenes"]
    assert (scene["dims"], scene["walls"]) == (2, [[0.0, 0.0, 4.0, 0.0]])
    np.testing.assert_allclose(tracks(scene["measured"]), [time, 1 + time], atol=0.0051)


def test_tables_that_do_not_match_are_refused(tmp_path: Path) -> None:
    table, renamed = cars(0.2, 2.0), cars(0.2, 2.0, sequence="t")
    with pytest.raises(DataError, match="those measured are called s and the like, those simul"):
        nnode.replay(table, renamed, tmp_path / "r.html", domain="traffic")
    with pytest.raises(ConfigError, match="ending in"):
        nnode.replay(table, table, tmp_path / "r.txt", domain="traffic")
    with pytest.raises(DataError, match="no column 'agent'"):
        nnode.replay(table.drop(columns="agent"), table, tmp_path / "r.html", domain="traffic")
    path = nnode.replay(pd.concat([table, renamed]), table, tmp_path / "r.html", domain="traffic")
    assert "The player contains 1 of 2 sequences." in path.read_text(encoding="utf-8")
