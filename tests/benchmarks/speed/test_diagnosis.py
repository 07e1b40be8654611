"""The diagnosis of two checkouts side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.speed import diagnosis

FOUND = {"wall_s": 2.0, "cpu_s": 1.0, "peak_memory_MB": 500.0, "verdict": "named"}


def test_platoons_follow_each_other() -> None:
    time, x = diagnosis.platoons(3)
    assert x.shape == (*time.shape, diagnosis.VEHICLES)
    assert (np.diff(x, axis=2) > diagnosis.LENGTH).all()
    assert (np.diff(x[..., -1], axis=1) > 0).all()


def test_a_checkout_is_timed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert diagnosis.main(["--sequences", "4", "--json", str(tmp_path / "found.json")]) == 0
    assert (tmp_path / "found.json").exists()
    assert "4 sequences\n  here" in capfd.readouterr().out


def test_a_checkout_that_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="No such file"):
        diagnosis.diagnosis_of(tmp_path / "nothing.npz")


@pytest.mark.parametrize(("name", "code"), [("inertia", 0), ("time_gap", 1)])
def test_another_verdict_is_said(
    name: str,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    def stand_in(data: Path, checkout: Path) -> dict[str, Any]:
        return {**FOUND, "effects": [name if checkout == tmp_path else "inertia"]}

    monkeypatch.setattr(diagnosis, "diagnosis_of", stand_in)
    assert diagnosis.main(["--against", str(tmp_path), "--sequences", "3"]) == code
    assert ("ANOTHER" in capsys.readouterr().out) == bool(code)
