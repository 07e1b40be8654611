"""The timed diagnosis, and the comparison of two checkouts."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.speed import against, diagnosis


def test_platoons_do_not_collide() -> None:
    time, x = diagnosis.data(3, vehicles=5, seconds=20.0)
    assert x.shape == (*time.shape, 5)
    assert (np.diff(x, axis=2) > diagnosis.LENGTH).all()
    assert (np.diff(x[..., -1], axis=1) > 0).all()


@pytest.mark.thorough
def test_comparison_of_a_checkout_with_itself(capfd: pytest.CaptureFixture[str]) -> None:
    against.main(["--against", str(diagnosis.HERE), "--cases", "diagnosis_4"])
    row = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert row["same"]
    assert row["cpu_s here / other"] > 0
