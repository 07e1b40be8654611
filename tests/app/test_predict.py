"""``nnode predict`` and ``nnode.predict``: predictions from drivers' first seconds."""

from __future__ import annotations

import shutil
from pathlib import Path

import pandas as pd
import pytest

import nnode
from nnode.errors import CheckpointError, ConfigError
from tests.app.conftest import Script, read_json, trained_idm
from tests.app.different import table

DIFFER = {"T": 0.15}


def drives(seed: int) -> pd.DataFrame:
    return table(seed, platoons=6, cars=4, seconds=30.0, noise=0.05, differ=DIFFER)[0]


@pytest.fixture(scope="module")
def run(script: Script, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training with driver-specific parameters."""
    folder = tmp_path_factory.mktemp("predict")
    return trained_idm(script, folder, drives(1), "trainer.drivers=[T]", "trainer.max_epochs=20")


def test_drivers_are_predicted_better_than_the_typical_driver(run: Path) -> None:
    predictions = nnode.predict(run, drives(2), seconds=10.0, part="all")
    assert predictions.rmse < 0.7 * predictions.rmse_typical
    assert predictions.difference.high < 0
    assert 0.8 < predictions.covered <= 1.0  # 18 drivers with autocorrelated errors
    rows = predictions.table
    assert len(rows.groupby(["sequence", "agent"])) == 6 * 3
    assert rows.loc[rows["given"], "time"].max() == pytest.approx(10.0)
    given = rows[rows["given"]]
    assert ((given["predicted"] - given["measured"]).abs() < 0.3).all()
    assert "18 followers predicted from their first 10 s" in repr(predictions)


def test_command_writes_the_result_of_python(script: Script, run: Path, tmp_path: Path) -> None:
    done = script("predict", f"run={run}", "seconds=5", folder=tmp_path)
    assert "band of 95%" in done.stdout
    predictions = nnode.predict(run, seconds=5.0)
    assert read_json(tmp_path / "prediction.json") == predictions.plain()
    assert len(pd.read_csv(tmp_path / "prediction.csv")) == len(predictions.table)
    assert (tmp_path / "prediction.png").stat().st_size > 10_000


def test_unsuitable_runs_and_durations_are_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"seconds=1: expected at least 2 s"):
        nnode.predict(run, seconds=1.0)
    with pytest.raises(ConfigError, match=r"seconds=40: none of the \d sequences is longer"):
        nnode.predict(run, seconds=40.0)
    damaged = shutil.copytree(run, tmp_path / "damaged")
    for content, message in (
        ('{"drivers": null}', r"no differences between drivers.*trainer\.drivers=auto"),
        ('{"drivers": {"differ": []}}', r"are damaged"),
        ("{", r"cannot be read"),
    ):
        (damaged / "result.json").write_text(content)
        with pytest.raises((ConfigError, CheckpointError), match=message):
            nnode.predict(damaged)
