"""Calibrating and diagnosing without a command line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import nnode
from nnode.app.python_inputs import named
from nnode.errors import ConfigError, DataError
from nnode.models.field import FIELD
from nnode.models.field_crowd import PEOPLE
from tests.discover.platoons import LENGTH, V0, platoons


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    rows = []
    for number, one in enumerate(platoons(number=14, seconds=8.0)):
        for k, time in enumerate(one.time):
            for i, x in enumerate(one.x[k, :, 0]):
                rows.append((number, time, f"{number}/{i}", x))
    return pd.DataFrame(rows, columns=["sequence", "time", "agent", "x"])


def test_three_lines_find_the_law(table: pd.DataFrame, tmp_path: Path) -> None:
    run = nnode.fit(table, "traffic", model="lin", leader="measured", folder=tmp_path / "run")
    assert run.parameters.value["lin.v0"] == pytest.approx(V0, rel=0.01)
    assert run.parameters.value["lin.L"] == pytest.approx(LENGTH, rel=0.02)
    assert run.parameters.unit.to_dict() == {"lin.v0": "m/s", "lin.L": "m"}
    assert run.history["cost/train"].iloc[-1] < 1e-3 * run.history["cost/train"].iloc[0]
    # the folder is one of scripts/train.py
    again = nnode.load(run.folder / "checkpoints" / "best.pt")
    for name, (value, _) in again.physical().items():
        assert float(value) == run.parameters.value[name]
    assert re.search(r"lin, calibrated: cost .*held-out", repr(run))
    assert re.search(r"L = \d\.\d+ m\n", repr(run))
    assert re.search(r"v0=\d+(\.\d+)? m/s, L=", repr(run.model))
    curve = run.plot().axes[0].lines[0].get_xydata()
    assert np.isfinite(np.asarray(curve)).all()


def test_models_bear_the_names_of_the_configuration() -> None:
    files = {p.stem for p in (Path(__file__).parents[2] / "conf" / "model").glob("*.yaml")}
    own = {"lin", "log", "n2", "n4", "n10", "formula", "sf", "nn"}
    assert own | set(FIELD) | set(PEOPLE) == files
    assert all(named(name)["name"] == name for name in files)
    with pytest.raises(ConfigError, match="model=lwr is unknown, expected one of lin, log"):
        named("lwr")


def test_a_table_that_does_not_fit_is_refused(table: pd.DataFrame) -> None:
    with pytest.raises(DataError, match="agent"):
        nnode.fit(table.drop(columns="agent"), "traffic")


def test_a_diagnosis_takes_a_data_frame(table: pd.DataFrame) -> None:
    report = nnode.diagnose(table, "traffic", model="lin")
    assert report["verdict"] == "none"
    assert report["effects"] == []
