"""Linear stability against analytic solutions and simulated platoons."""

from __future__ import annotations

import numpy as np
import pytest

from nnode.model.build import build_model
from nnode.model.laws import CAR_FOLLOWING_LAWS
from nnode.model.system import System
from studies.following import stability
from studies.following.stability import FREQUENCIES, Slopes, passed
from studies.following.tasks import EVERY

LENGTH = 4.5


def system(name: str, effects: tuple[str, ...] = (), leader: str = "measured") -> System:
    return build_model(
        {
            "term": "formula",
            "name": name,
            "leader": leader,
            "law": CAR_FOLLOWING_LAWS[name],
            "effects": [{"name": effect} for effect in effects],
        }
    )


def idm_gap(v: float) -> float:
    """The equilibrium gap (s0 + T v) / sqrt(1 - (v/v0)^4) with the default parameters."""
    return float((2 + 1.2 * v) / np.sqrt(1 - (v / 30) ** 4))


def test_equilibrium_of_idm() -> None:
    speeds = np.array([2.0, 8.0, 15.0])
    result = stability.equilibrium(system("idm"), speeds, LENGTH)
    assert result == pytest.approx([idm_gap(v) for v in speeds], abs=2e-3)


def test_slopes_of_idm() -> None:
    v, a, b, desired_gap = 8.0, 1.3, 1.7, 2 + 1.2 * 8.0
    s = idm_gap(v)
    result = stability.slopes(system("idm"), s, v, LENGTH)
    assert result.s == pytest.approx(2 * a * desired_gap**2 / s**3, rel=1e-5)
    assert result.v == pytest.approx(
        -a * (4 * v**3 / 30**4 + 2 * desired_gap * 1.2 / s**2), rel=1e-5
    )
    assert result.dv == pytest.approx(
        -a * 2 * desired_gap * v / (2 * np.sqrt(a * b) * s**2), rel=1e-5
    )


@pytest.mark.parametrize("name", [n for n in EVERY if not n.startswith(stability.MAPS)])
def test_every_candidate_has_slopes(name: str) -> None:
    law = EVERY[name].system()
    by_gap = [stability.slopes(law, gap, 6.0, LENGTH).s for gap in (8.0, 12.0, 20.0)]
    assert np.isfinite(by_gap).all()
    assert np.abs(by_gap).max() > 0


@pytest.mark.parametrize("dv", [0.0, -0.3, -1.0])
@pytest.mark.parametrize("s", [0.02, 0.1, 0.4])
@pytest.mark.parametrize("v", [-0.1, -0.5, -1.0])
def test_margin_is_negative_if_a_frequency_is_amplified(s: float, v: float, dv: float) -> None:
    slope = Slopes(s, v, dv)
    amplified = passed(slope, np.geomspace(1e-4, 5, 5000)).max() > 1 + 1e-9
    assert amplified == (slope.margin < 0)


def test_stability_limit_of_the_optimal_velocity_model() -> None:
    # Bando et al. 1995: stable where V'(s) < kappa / 2; f_s = kappa V', f_v = -kappa
    for share, stable in ((0.49, True), (0.51, False)):
        assert (Slopes(0.8 * 0.8 * share, -0.8, 0.0).margin > 0) == stable


@pytest.mark.parametrize("effects", [(), ("inertia",), ("reaction_delay",)])
def test_gain_of_a_simulated_platoon(effects: tuple[str, ...]) -> None:
    law, v = system("helly", effects), 10.0
    gap = 2 + 1.2 * v
    slope = stability.slopes(law, gap, v, LENGTH)
    w = 2 * np.pi / 25
    gain = float(passed(slope, np.array([w]), **stability.lateness(law))[0])
    swing = stability.platoon(law, v, gap, LENGTH, w, followers=3, periods=20)
    assert swing[0] == pytest.approx(0.05, rel=1e-6)
    assert swing[1:] / swing[:-1] == pytest.approx([gain] * 3, rel=0.01)


def test_gain_at_the_lowest_frequency_is_one() -> None:
    assert passed(Slopes(0.1, -0.5, -0.3), FREQUENCIES[:1])[0] == pytest.approx(1, abs=1e-3)
