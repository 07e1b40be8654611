"""Published car-following laws against their sources' formulas and analytic solutions."""

from __future__ import annotations

from math import sqrt, tanh
from typing import Any

import numpy as np
import pytest
import torch

from nnode.data.sequence import collate
from nnode.model.laws import NEURONS
from tests.builders import lane
from tests.model.following import (
    DT,
    accelerations,
    each_follower,
    idm,
    model,
    parameters_of,
    platoon_behind,
    set_,
    simulate,
    states,
)

#: Length of every vehicle, m.
LENGTH = 4.0


def optimal(s: float, p: Any) -> float:
    """Optimal velocity of Bando et al. 1995, 0 without a gap and v0 at a long gap."""
    bend = tanh(p.s_c / p.w)
    return p.v0 * (tanh((max(s, 0.1) - p.s_c) / p.w) + bend) / (1 + bend)


def ovm(s: float, v: float, u: float, p: Any) -> float:
    """Bando et al. 1995."""
    return p.kappa * (optimal(s, p) - v)


def fvdm(s: float, v: float, u: float, p: Any) -> float:
    """Jiang, Wu & Zhu 2001, equation (5)."""
    return p.kappa * (optimal(s, p) - v) + p.lam * (u - v)


def gipps_speed(s: float, v: float, u: float, p: Any) -> float:
    """Gipps 1981, equation (2), with positive b; a vehicle without a safe speed stops."""
    free = v + 2.5 * p.a * p.T * (1 - v / p.v0) * sqrt(0.025 + v / p.v0)
    left = (p.b * p.T) ** 2 + p.b * (2 * (max(s, 0.1) - p.s0) - v * p.T + u * u / p.b_1)
    safe = sqrt(left) - p.b * p.T if left > 0 else 0.0
    return max(0.0, min(free, safe))


def gipps(s: float, v: float, u: float, p: Any) -> float:
    return (gipps_speed(s, v, u, p) - v) / p.T


def krauss(s: float, v: float, u: float, p: Any) -> float:
    """Krauss, Wagner & Gawron 1997, equations (1) to (3), without dawdling; speeds above v0 fall by
    b at most, as in SUMO."""
    gap = s - p.s0
    safe = -p.b * p.T + sqrt((p.b * p.T) ** 2 + u * u + 2 * p.b * gap) if gap > 0 else 0.0
    return (max(0.0, min(v + p.a * DT, max(p.v0, v - p.b * DT), safe)) - v) / DT


def helly(s: float, v: float, u: float, p: Any) -> float:
    """Helly 1959: c1 (u - v) + c2 (s - D), D = s0 + T v."""
    return p.c_v * (u - v) + p.c_s * (s - (p.s0 + p.T * v))


def newell(s: float, v: float, u: float, p: Any) -> float:
    """Newell 2002: the leader's position T ago minus d; the leader's earlier speed was constant."""
    target = s + u * (DT - p.T) - p.d
    return (min(max(target / DT, 0.0), p.v0) - v) / DT


BY_HAND = {
    "idm": idm,
    "ovm": ovm,
    "fvdm": fvdm,
    "gipps": gipps,
    "krauss": krauss,
    "helly": helly,
    "newell": newell,
}


@pytest.mark.parametrize("name", BY_HAND)
def test_accelerations_by_formula(name: str) -> None:
    system, batch = model(name), states()
    with torch.no_grad():
        for p in system.parameters():
            p.mul_(1.07)  # otherwise some parameters are equal
    simulated, law = accelerations(system, batch), parameters_of(system)
    followers = each_follower(batch)
    assert len(followers) > 70
    assert min(v for *_, v, _ in followers) == 0
    assert min(gap for _, _, gap, *_ in followers) <= LENGTH
    for b, i, gap, v, u in followers:
        expected = max(BY_HAND[name](gap - LENGTH, v, u, law), -v / DT)  # speeds stay positive
        assert simulated[b, i] == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert np.isfinite(simulated).sum() == len(followers)


@pytest.mark.parametrize("name", NEURONS)
def test_neural_network_laws(name: str) -> None:
    system, batch = model(name), states()
    with torch.no_grad():
        for p in system.parameters():
            p.uniform_(-1, 1, generator=torch.Generator().manual_seed(5))
    (w1, b1), (w2, b2) = (
        [p.detach().numpy() for p in layer.parameters()] for layer in system.terms[0].network.layers
    )
    simulated = accelerations(system, batch)
    for b, i, gap, v, u in each_follower(batch):
        inputs = np.array([gap / 20, v / 10, (v - u) / 2])
        output = float(w2[0] @ np.log(1 + np.exp(w1 @ inputs + b1)) + b2[0])
        assert simulated[b, i] == pytest.approx(max(output, -v / DT), rel=1e-8)


@pytest.mark.parametrize("law", ["idm", "helly"])
def test_network_added_to_a_law(law: str) -> None:
    alone, hybrid = accelerations(model(law), states()), model(law, network=4)
    np.testing.assert_array_equal(alone, accelerations(hybrid, states()))
    with torch.no_grad():
        hybrid.terms[0].network.layers[-1].bias.fill_(0.25)
    change = accelerations(hybrid, states()) - alone
    change = change[np.isfinite(alone)]
    free = change > 0.24  # of vehicles that the bound v >= 0 does not stop
    np.testing.assert_allclose(change[free], 0.25, rtol=1e-9)
    assert free.sum() > 40
    assert (change >= 0).all()


#: Equilibrium speed at a net gap s.
EQUILIBRIUM = {
    "ovm": lambda s, p: optimal(s, p),
    "fvdm": lambda s, p: optimal(s, p),
    "gipps": lambda s, p: min((s - p.s0) / (1.5 * p.T), p.v0),  # b = b_1
    "krauss": lambda s, p: min((s - p.s0) / p.T, p.v0),
    "helly": lambda s, p: (s - p.s0) / p.T,
    "newell": lambda s, p: min((s - p.d) / p.T, p.v0),
}


@pytest.mark.parametrize("name", EQUILIBRIUM)
def test_equilibrium_speed(name: str) -> None:
    system, gaps = model(name), [8.0, 12.5, 20.0, 31.0]
    speeds = system.terms[0].speed(torch.tensor(gaps, dtype=torch.float64)).detach()
    expected = [EQUILIBRIUM[name](s, parameters_of(system)) for s in gaps]
    np.testing.assert_allclose(speeds, expected, rtol=1e-9)


def test_equilibrium_gap_of_idm() -> None:
    """s_e(v) = (s0 + v T) / sqrt(1 - (v / v0)^4): Treiber, Hennecke & Helbing 2000, (4)."""
    law = model("idm").terms[0]
    v = torch.tensor([1.0, 8.0, 15.0, 29.0], dtype=torch.float64)
    gap = (law.s0 + v * law.T) / torch.sqrt(1 - (v / law.v0) ** 4)
    torch.testing.assert_close(law.speed(gap.detach()), v, rtol=1e-9, atol=0)


def amplification(name: str, p: Any, omega: float) -> float:
    """Ratio of the amplitudes of a small wave behind a vehicle and ahead of it."""
    s = 1j * omega
    if name == "helly":
        return abs((p.c_s + s * p.c_v) / (p.c_s + s * s + s * (p.c_v + p.c_s * p.T)))
    lam = p.lam if name == "fvdm" else 0.0
    bend = tanh(p.s_c / p.w)
    slope = p.v0 / p.w / (1 + bend)  # V'(s_c)
    return abs((p.kappa * slope + s * lam) / (p.kappa * slope + s * s + s * (p.kappa + lam)))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "values", "stable"),
    [
        # V'(s_c) = 30/12/(1 + tanh(1.25)) = 1.353/s; V' < kappa/2 (Bando et al. 1995, (12))
        ("ovm", {"kappa": 3.2}, True),
        ("ovm", {"kappa": 2.2}, False),
        # V' < kappa/2 + lam (Jiang, Wu & Zhu 2001)
        ("fvdm", {"kappa": 1.0, "lam": 1.1}, True),
        ("fvdm", {"kappa": 1.0, "lam": 0.6}, False),
        # c_s T² + 2 c_v T > 2
        ("helly", {"c_s": 0.4, "c_v": 0.7, "T": 1.2}, True),
        ("helly", {"c_s": 0.4, "c_v": 0.2, "T": 1.2}, False),
    ],
)
def test_string_stability(name: str, values: dict[str, float], stable: bool) -> None:
    """A small oscillation of the leader shrinks along a platoon where the law is stable."""
    system = set_(model(name), **values)
    law, omega, small, step = parameters_of(system), 0.5, 1e-3, 0.25
    s = 15.0 if name != "helly" else 20.0
    v = float(system.terms[0].speed(torch.tensor([s], dtype=torch.float64)))
    batch = platoon_behind(
        lambda t: v * t + small * np.sin(omega * t), [s + LENGTH] * 6, 63.0, LENGTH, step
    )
    # the last two periods, without transients
    last = simulate(system, batch, "rk4", step).v[-101:-1, 0, :, 0] - v
    high = (last.max(0).values - last.min(0).values)[:-1].flip(0).numpy() / (2 * small * omega)
    np.testing.assert_allclose(high, amplification(name, law, omega) ** np.arange(1, 7), rtol=0.02)
    assert (high[-1] < high[0] < 1) if stable else (high[-1] > high[0] > 1)


def braking(start: float, b: float) -> Any:
    """Positions of a leader that drives for 2 s, and then brakes with b m/s² to a stop."""

    def lead(t: np.ndarray) -> np.ndarray:
        braked = np.clip(t - 2, 0, start / b)
        return start * np.minimum(t, 2) + start * braked - b * braked**2 / 2

    return lead


def test_gipps_scheme_behind_a_braking_leader() -> None:
    """With steps of T the ballistic method is Gipps' scheme, equation (2), without collisions."""
    system, step = set_(model("gipps"), T=0.5, b_1=3.0, b=3.0), 0.5
    law = parameters_of(system)
    gaps = [18.0 + LENGTH, 25.0 + LENGTH, 40.0]
    batch = platoon_behind(braking(20.0, 3.0), gaps, 20.0, LENGTH, step)
    path = simulate(system, batch, step=step)
    x, v = batch.x[0, 0, :, 0].numpy().copy(), batch.v[0, 0, :, 0].numpy().copy()
    for k in range(1, batch.n_samples):
        new = [gipps_speed(x[i + 1] - x[i] - LENGTH, v[i], v[i + 1], law) for i in range(3)]
        x[:-1] += step * (v[:-1] + new) / 2
        v[:-1] = new
        x[-1], v[-1] = batch.x[k, 0, -1, 0], batch.v[k, 0, -1, 0]
        np.testing.assert_allclose(path.x[k, 0, :, 0], x, rtol=1e-12)
    assert (torch.diff(path.x[:, 0, :, 0]) - LENGTH).min() > 0.5 * law.s0
    assert path.v[-1].abs().max() < 0.05


@pytest.mark.parametrize("speed", [8.0, 20.0, 29.0])
def test_krauss_does_not_collide(speed: float) -> None:
    """The leader brakes as hard as the followers; all start at least at their safe gap."""
    gaps = speed + 2.0 + LENGTH + np.random.default_rng(11).uniform(0, 9, 5)
    batch = platoon_behind(braking(speed, 4.5), gaps, 24.0, LENGTH)
    path = simulate(model("krauss"), batch)
    assert (torch.diff(path.x[:, 0, :, 0]) - LENGTH).min() > 2.0 - 1e-9  # s0
    assert path.v.min() >= 0
    assert path.v[-1].max() < 0.5


def test_krauss_speed_above_v0_falls_by_at_most_b() -> None:
    system = set_(model("krauss"), v0=10.0, b=3.0)
    time = DT * np.arange(40)
    x = np.stack([14 * time, 500 + 14 * time], 1)
    speed = simulate(system, collate([lane(x, DT, v=14.0, length=LENGTH)])).v[:, 0, 0, 0]
    np.testing.assert_allclose(speed, np.maximum(14 - 3 * time, 10), rtol=0, atol=1e-9)


@pytest.mark.parametrize("T", [0.5, 1.3])
def test_newell_path(T: float) -> None:
    """x_n(t) = x_0(t - n T) - n (d + length), down a whole platoon."""
    system = set_(model("newell"), T=T, d=7.0)
    time = DT * np.arange(90)

    def lead(t: np.ndarray) -> np.ndarray:
        return 14 * t + np.where(t > 0, 5 * (1 - np.cos(0.7 * t)), 0.0)

    x = np.stack([lead(time - i * T) - i * (7 + LENGTH) for i in (3, 2, 1, 0)], 1)
    assert np.ptp(x[:, -1] - 14 * time) > 8
    # only the first speed of this law is read
    path = simulate(system, collate([lane(x, DT, v=14.0, length=LENGTH)]))
    np.testing.assert_allclose(path.x[:, 0, :, 0], x, rtol=0, atol=1e-9)
