"""Cases with drivers who differ, with a quick substitute for the diagnosis."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

import nnode
from benchmarks import drivers


@pytest.mark.parametrize(("law", "covered"), [("lin", "yes"), ("fvdm", "no")])
def test_rows_are_scored_and_kept(
    law: str, covered: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def zone(table: pd.DataFrame, *given: Any, **options: Any) -> SimpleNamespace:
        calls.append(table)
        alpha = {"alpha": {"value": 0.88, "low": 0.85, "high": 0.91}}
        effect = {"name": "speed_zone", "alternatives": [], "coefficients": alpha}
        report = {"effects": [effect], "verdict": "named", "drivers": []}
        return SimpleNamespace(plain=lambda: report)

    monkeypatch.setattr(nnode, "diagnose", zone)
    path = tmp_path / "table.csv"
    size = ["--platoons", "3", "--vehicles", "3", "--processes", "1", "--table", str(path)]
    monkeypatch.setattr(
        sys, "argv", ["drivers", "--laws", law, "--seed", "5", "--cases", "2", *size]
    )
    for _ in range(2):
        drivers.main()
    assert len(calls) == 2
    assert calls[0].groupby("sequence")["agent"].nunique().tolist() == [3, 3, 3]
    rows = pd.read_csv(path, keep_default_na=False)
    assert rows["effect"].tolist() == ["none", "speed_zone"]
    assert rows[["exact", "false"]].to_numpy().tolist() == [[False, True], [True, False]]
    assert rows["estimate"].tolist() == ["", "0.88"]
    assert rows["covered"].tolist() == ["", covered]
    assert set(rows["v0 covered"]) == {"-"}


def test_laws_are_compared_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "table.csv"
    size = ["--platoons", "8", "--vehicles", "4", "--processes", "1", "--table", str(path)]
    given = ["drivers", "--compare", "--laws", "lin", "--seed", "5", "--cases", "1", *size]
    monkeypatch.setattr(sys, "argv", given)
    drivers.main()
    (row,) = pd.read_csv(path).to_dict("records")
    assert row["exact"]
    assert row["first"] == "lin" != row["second"]
    assert row["p second"] < row["p true"] == 1.0
