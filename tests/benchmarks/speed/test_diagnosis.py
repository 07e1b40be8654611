"""The diagnosis of two checkouts side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.speed import diagnosis


def test_platoons_follow_each_other() -> None:
    time, x = diagnosis.platoons(3)
    assert x.shape == (*time.shape, diagnosis.VEHICLES)
    assert (np.diff(x, axis=2) > diagnosis.LENGTH).all()
    assert (np.diff(x[..., -1], axis=1) > 0).all()


@pytest.mark.thorough
def test_a_checkout_is_timed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert diagnosis.main(["--sequences", "4", "--json", str(tmp_path / "found.json")]) == 0
    assert (tmp_path / "found.json").exists()
    assert "4 sequences\n  here" in capfd.readouterr().out
