"""``scripts/simulate.py`` from a table to scores."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nnode.data.options import TableOptions
from nnode.data.prepare import prepare
from tests.app.conftest import Script
from tests.app.following import table

SAMPLES = 39


@pytest.fixture(scope="module")
def run(started: Script, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short training."""
    folder = tmp_path_factory.mktemp("simulate")
    table(10, 20.0).to_csv(folder / "mine.csv", index=False)
    done = started(
        "train", "model=idm", "data=table", "data.domain=traffic", f"data.path={folder}/mine.csv",
        "trainer.max_epochs=2", f"hydra.run.dir={folder}/run",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "run"


def test_a_run_is_sampled_and_scored(started: Script, run: Path, tmp_path: Path) -> None:
    done = started("simulate", f"run={run}", f"samples={SAMPLES}", f"hydra.run.dir={tmp_path}")
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "scores.json").read_text())
    assert found["sequences"] == 2
    assert set(found["scores"]) == {"idm", "idm, no noise", "constant_speed"}
    assert found["scores"]["idm, no noise"]["coverage_position_95"]["mean"] < 0.5
    near, far = (found["scores"][k]["crps_position_m"]["mean"] for k in ("idm", "constant_speed"))
    assert near < 0.5 * far
    assert (tmp_path / "bands.png").stat().st_size > 10_000
    store = prepare(
        TableOptions(domain="traffic", path=str(tmp_path / "samples.parquet")), tmp_path / "again"
    )
    assert len(store) == 2 * SAMPLES
    assert store[0].n_agents == 3
    assert store[0].name.endswith("~1")


def test_too_few_samples_are_refused(started: Script, run: Path, tmp_path: Path) -> None:
    done = started("simulate", f"run={run}", "samples=10", f"hydra.run.dir={tmp_path}")
    assert done.returncode != 0
    assert "samples=10" in done.stderr
    assert "at least 39" in done.stderr
