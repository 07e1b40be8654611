"""The benchmark of heterogeneous drivers, with a substitute for the diagnosis."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import kurtosis

import nnode
from benchmarks import drivers
from nnode.app.python.inputs import model_options
from nnode.model.build import build_model


def run(monkeypatch: pytest.MonkeyPatch, path: Path, *options: str) -> pd.DataFrame:
    """The table of a run with these options."""
    argv = ["drivers", "--seed", "5", "--processes", "1", "--table", str(path), *options]
    monkeypatch.setattr(sys, "argv", argv)
    drivers.main()
    return pd.read_csv(path)


def test_pushes_have_their_distribution_and_smoothness() -> None:
    values, changes = {}, {}
    for nature in ("plain", "heavy", "smooth"):
        pushes = drivers.Pushes(nature, (60, 60), np.random.default_rng(3))
        for _ in range(round(8.0 / drivers.STEP)):
            pushes.advance()
        before = pushes.present()
        pushes.advance()
        values[nature], changes[nature] = before, pushes.present() - before
    for each in values.values():
        assert each.std() == pytest.approx(1.0, abs=0.05)
    assert kurtosis(values["heavy"], axis=None) > 3 > 0.2 > kurtosis(values["plain"], axis=None)
    # changes in a step: sqrt(2 STEP / LASTS) of first, 2 STEP / LASTS of second order
    assert changes["smooth"].std() < 0.1 * changes["plain"].std()


@pytest.mark.thorough
@pytest.mark.parametrize(("law", "covered"), [("lin", True), ("fvdm", False)])
def test_rows_are_scored_and_kept(
    law: str, covered: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def zone(table: pd.DataFrame, *arguments: Any, **options: Any) -> SimpleNamespace:
        calls.append(table)
        alpha = {"alpha": {"value": 0.88, "low": 0.85, "high": 0.91}}
        effect = {"name": "speed_zone", "alternatives": [], "coefficients": alpha}
        empty: dict[str, list[Any]] = {"drivers": [], "hypotheses": [], "law_at_bounds": []}
        report = {"effects": [effect], "verdict": "named", **empty}
        return SimpleNamespace(plain=lambda: report)

    monkeypatch.setattr(nnode, "diagnose", zone)
    size = ["--laws", law, "--cases", "2", "--platoons", "3", "--vehicles", "3"]
    for _ in range(2):
        rows = run(monkeypatch, tmp_path / "table.csv", *size)
    assert len(calls) == 2
    assert calls[0].groupby("sequence")["agent"].nunique().tolist() == [3, 3, 3]
    assert rows["effect"].tolist() == ["none", "speed_zone"]
    assert rows[["exact", "false_name"]].to_numpy().tolist() == [[False, True], [True, False]]
    assert rows["speed_zone"].tolist()[1:] == [0.88]
    assert rows["speed_zone covered"].tolist()[1:] == [covered]
    assert rows["v0 covered"].isna().all()
    assert not rows["law_at_bounds"].any()
    assert run(monkeypatch, tmp_path / "nothing.csv", "--nothing", *size)["effect"].tolist() == [
        "none",
        "none",
    ]


@pytest.mark.thorough
def test_comparison_of_laws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    laws = {name: build_model(model_options(name, "measured")) for name in ("lin", "log")}
    monkeypatch.setattr(drivers, "compared_laws", lambda *arguments: laws)
    size = ["--laws", "lin", "--cases", "1", "--platoons", "8", "--vehicles", "4"]
    (row,) = run(monkeypatch, tmp_path / "table.csv", "--compare", *size).to_dict("records")
    assert row["true law first"]
    assert (row["first"], row["second"]) == ("lin", "log")
    assert row["p second"] < row["p true"] == 1.0


@pytest.mark.thorough
def test_calibrations_are_scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = ["--laws", "lin", "--cases", "1", "--platoons", "8", "--vehicles", "3"]
    (row,) = run(monkeypatch, tmp_path / "table.csv", "--calibrate", *size).to_dict("records")
    assert (row["effect"], row["v0, true"], row["push_time, variation, true"]) == ("none", 29, 4)
    assert row["L"] == pytest.approx(6.0, rel=0.02)
    assert row["v0, variation"] == pytest.approx(15.0, rel=0.5)
    assert {row["v0 covered"], row["L covered"]} <= {True, False}
