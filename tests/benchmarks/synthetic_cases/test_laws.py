"""Platoons of laws from the literature, against their equilibrium gaps."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.synthetic_cases.laws import RANGES, STEP, followed, measured, still
from nnode.errors import ConfigError

MIDDLE = {law: {k: (a + b) / 2 for k, (a, b) in ranges.items()} for law, ranges in RANGES.items()}
SPEED, AHEAD = 7.0, 4.5


def steady(law: str) -> float:
    """The analytic net gap (m) at a steady speed behind a vehicle of 4.5 m."""
    p = MIDDLE[law]
    share = SPEED / p.get("v0", np.inf)
    if law == "lin":
        return float(p["L"] / (1 - share) - AHEAD)
    if law == "log":
        return float(p["L"] * np.exp(share) - AHEAD)
    if law == "idm":
        return float((p["s0"] + SPEED * p["T"]) / np.sqrt(1 - share**4))
    if law in ("krauss", "helly"):
        return p["s0"] + SPEED * p["T"]
    if law == "gipps":  # drivers assume the leader's true braking
        return p["s0"] + 1.5 * SPEED * p["T"]
    offset = np.tanh(p["s_c"] / p["w"])
    return float(p["s_c"] + p["w"] * np.arctanh(share * (1 + offset) - offset))


@pytest.mark.parametrize("law", RANGES)
def test_equilibrium_gaps(law: str) -> None:
    steps = round(240 / STEP)
    lead = SPEED * STEP * np.arange(steps)
    x = followed(law, MIDDLE[law], lead, np.full(3, AHEAD), np.zeros((steps, 2)))
    gaps = np.diff(x[-1]) - AHEAD
    assert gaps == pytest.approx(steady(law), abs=0.02)
    assert still(law, MIDDLE[law], SPEED, AHEAD) == pytest.approx(steady(law), abs=1e-6)


@pytest.mark.parametrize("law", RANGES)
def test_no_collisions_or_reversing(law: str) -> None:
    table, _ = measured(law, 3, sequences=4, seconds=20.0)
    for _, run in table.groupby("sequence"):
        x = run.pivot(index="time", columns="agent", values="x").to_numpy()
        # the data contain measurement errors of up to 0.3 m and driver noise
        assert (np.diff(x[::25], axis=0) > -2.0).all()
        assert (np.diff(x, axis=1) > 1.0).all()


def test_tables_are_reproducible() -> None:
    first, repeated, other = (measured("idm", s, sequences=2, seconds=5.0)[0] for s in (7, 7, 8))
    assert first.equals(repeated)
    assert not first.equals(other)
    _, parameters = measured("idm", 7, sequences=1, seconds=5.0)
    assert all(a <= parameters[k] <= b for k, (a, b) in RANGES["idm"].items())
    assert first.groupby("sequence")["agent"].nunique().tolist() == [5, 5]
    with pytest.raises(ConfigError, match="law=newell is unknown"):
        measured("newell", 0)
