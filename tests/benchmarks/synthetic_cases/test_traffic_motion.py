"""The motion of platoons against closed forms and another integrator."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.synthetic_cases.traffic.motion import Base, Hidden, inside, simulate

V0 = {"lin": 30.0, "log": 12.0}
L = 8.0


def drive(
    law: str,
    hidden: Hidden,
    *,
    speed=lambda t: 15.0 + 0 * t,
    place=lambda t: 15.0 * t,
    vehicles: int = 4,
    gap: float = 20.0,
    duration: float = 60.0,
    step: float = 0.05,
    driver_factor: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """``(M + 1, N)`` positions and speeds of a platoon; followers start 20 m apart."""
    half = np.arange(2 * round(duration / step) + 1) * step / 2
    x = place(half)[0] - gap * np.arange(vehicles)[::-1].astype(float)
    v = np.full(vehicles, float(speed(half)[0]))
    moved, rates = simulate(
        Base(V0[law], L, law == "log"),
        hidden,
        np.full((1, vehicles), driver_factor),
        (place(half)[None], speed(half)[None]),
        (x[None, None], v[None, None]),
        np.zeros((1, len(half) // 2 + 1, vehicles)),
        np.zeros(1),
        0.0,
        step,
    )
    return moved[0], rates[0]


def sine(t):
    return 15 + 3 * np.sin(0.5 * t)


def sine_place(t):
    return 15 * t - 6 * np.cos(0.5 * t)


# the effective factor or length in equilibrium behind a leader of 15 m/s
@pytest.mark.parametrize(
    ("hidden", "driver_factor", "factor", "length"),
    [
        (Hidden(), 1.0, 1.0, L),
        (Hidden(), 0.8, 0.8, L),
        (Hidden(kappa_open=0.4, kappa_close=0.2, c=0.3), 1.0, 1.0, L),
        (Hidden(T=0.4), 1.0, 1.0, L),
        (Hidden(tau_v=0.5), 1.0, 1.0, L),
        (Hidden(zone_alpha=0.7, zone_a=-1e4, zone_b=1e4), 1.0, 0.7, L),
        (Hidden(period_alpha=0.7, period_a=-1e4, period_b=1e4), 1.0, 0.7, L),
        (Hidden(h=0.2), 1.0, 1.0, L + 0.2 * 15),
    ],
)
@pytest.mark.parametrize("law", ["lin", "log"])
def test_equilibrium_gaps_of_platoons(law, hidden, driver_factor, factor, length):
    x, v = drive(law, hidden, driver_factor=driver_factor, duration=200.0)
    ratio = 15.0 / (V0[law] * factor)
    gap = length / (1 - ratio) if law == "lin" else length * np.exp(ratio)
    np.testing.assert_allclose(np.diff(x[-1]), gap, rtol=1e-6)
    np.testing.assert_allclose(v[-1], 15.0, rtol=1e-6)


def test_top_speed_limits_followers():
    _, v = drive("lin", Hidden(v_max=12.0))
    assert v[:, :-1].max() == 12.0


@pytest.mark.parametrize("T", [0.0, 0.4])
def test_errors_are_of_fourth_order(T):
    hidden = Hidden(kappa_open=0.3, kappa_close=0.3, c=0.3, T=T, tau_v=0.3)
    ends = [
        drive("lin", hidden, speed=sine, place=sine_place, duration=8.0, step=step)[0][-1, :-1]
        for step in (0.1, 0.05, 0.025)
    ]
    ratio = np.abs(ends[0] - ends[1]).max() / np.abs(ends[1] - ends[2]).max()
    assert 11 < ratio < 22


def test_motion_as_another_integrator():
    hidden = Hidden(kappa_open=0.3, kappa_close=0.3, c=0.25, tau_v=0.6, h=0.1)
    law = np.vectorize(lambda gap, length: V0["lin"] * (1 - length / gap))

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        x = np.append(y[:3], sine_place(t))
        v = np.append(y[3:], sine(t))
        gap = np.diff(x)
        speed = law(gap, L + 0.1 * v[1:])
        speed[:-1] += 0.25 * (law(gap[1:], L + 0.1 * v[1:-1]) - speed[:-1])
        speed += 0.3 * (v[1:] - speed)
        return np.concatenate([y[3:], (speed - y[3:]) / 0.6])

    start = np.concatenate([sine_place(0.0) - 20.0 * np.array([3, 2, 1]), np.full(3, 15.0)])
    expected = solve_ivp(rates, (0, 20), start, method="DOP853", rtol=1e-10, atol=1e-10)
    x, v = drive("lin", hidden, speed=sine, place=sine_place, duration=20.0, step=0.02)
    np.testing.assert_allclose(x[-1, :3], expected.y[:3, -1], atol=1e-6)
    np.testing.assert_allclose(v[-1, :3], expected.y[3:, -1], atol=1e-6)


def test_delayed_driver_responds_to_the_earlier_gap():
    x, v = drive("log", Hidden(T=0.4), speed=sine, place=sine_place, duration=20.0, step=0.05)
    before = np.diff(x, axis=1)[:-8]
    np.testing.assert_allclose(v[8:, :-1], V0["log"] * np.log(before / L), rtol=1e-12)


def test_asymmetric_response_to_opening_gaps():
    x, v = drive("lin", Hidden(kappa_open=0.6), speed=sine, place=sine_place, duration=20.0)
    base = V0["lin"] * (1 - L / np.diff(x, axis=1))
    excess = v[:, 1:] - base
    np.testing.assert_allclose(v[:, :-1], base + 0.6 * np.maximum(excess, 0), rtol=1e-12)
    assert (excess > 0.1).any()
    assert (excess < -0.1).any()


def test_smoothed_edges_of_a_zone():
    assert inside(10.0, 10.0, 90.0, 20.0) == pytest.approx(0.5)
    assert [inside(p, 10.0, 90.0, 20.0) for p in (0.0, 20.0, 80.0, 100.0)] == [0.0, 1.0, 1.0, 0.0]
    assert [inside(p, 10.0, 90.0, 0.0) for p in (9.9, 10.0, 90.0, 90.1)] == [0.0, 1.0, 1.0, 0.0]
