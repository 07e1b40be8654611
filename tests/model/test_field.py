"""The field's laws against formulas written out from their sources, and against what is known of
them on paper."""

from __future__ import annotations

from math import exp, log, sqrt, tanh
from typing import Any

import numpy as np
import pytest
import torch

from nnode.data.sequence import collate
from nnode.model.laws import NEURONS
from nnode.simulation import TorchdiffeqSolver
from tests.builders import lane
from tests.model.following import (
    DT,
    accelerations,
    behind,
    each_follower,
    idm,
    model,
    numbers,
    set_,
    states,
)

#: Length of every vehicle here, m.
LONG = 4.0


def optimal(s: float, p: Any) -> float:
    """A speed that is 0 at no gap and v0 at a long one (Bando et al. 1995)."""
    bend = tanh(p.s_c / p.w)
    return p.v0 * (tanh((max(s, 0.1) - p.s_c) / p.w) + bend) / (1 + bend)


def ovm(s: float, v: float, u: float, p: Any) -> float:
    """Bando et al. 1995."""
    return p.kappa * (optimal(s, p) - v)


def fvdm(s: float, v: float, u: float, p: Any) -> float:
    """Jiang, Wu & Zhu 2001, equation (5)."""
    return p.kappa * (optimal(s, p) - v) + p.lam * (u - v)


def gipps_speed(s: float, v: float, u: float, p: Any) -> float:
    """Gipps 1981, equation (2), braking as a positive number; no root: it stops."""
    free = v + 2.5 * p.a * p.T * (1 - v / p.v0) * sqrt(0.025 + v / p.v0)
    left = (p.b * p.T) ** 2 + p.b * (2 * (max(s, 0.1) - p.s0) - v * p.T + u * u / p.b_1)
    safe = sqrt(left) - p.b * p.T if left > 0 else 0.0
    return max(0.0, min(free, safe))


def gipps(s: float, v: float, u: float, p: Any) -> float:
    return (gipps_speed(s, v, u, p) - v) / p.T


def krauss(s: float, v: float, u: float, p: Any) -> float:
    """Krauss, Wagner & Gawron 1997, equations (1) to (3), without dawdling."""
    gap = s - p.s0
    safe = -p.b * p.T + sqrt((p.b * p.T) ** 2 + u * u + 2 * p.b * gap) if gap > 0 else 0.0
    return (max(0.0, min(v + p.a * DT, p.v0, safe)) - v) / DT


def helly(s: float, v: float, u: float, p: Any) -> float:
    """Helly 1959: c1 (u - v) + c2 (s - D), D = s0 + T v."""
    return p.c_v * (u - v) + p.c_s * (s - (p.s0 + p.T * v))


def newell(s: float, v: float, u: float, p: Any) -> float:
    """Newell 2002: where the leader was T ago, d further back; he came at his first speed."""
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
def test_accelerations_are_those_of_the_source(name: str) -> None:
    system, batch = model(name), states()
    with torch.no_grad():
        for p in system.parameters():
            p.mul_(1.07)  # no two parameters are the same number
    found, law = accelerations(system, batch), numbers(system)
    seen = each_follower(batch)
    assert len(seen) > 70
    assert min(v for *_, v, _ in seen) == 0
    assert min(gap for _, _, gap, *_ in seen) <= LONG
    for b, i, gap, v, u in seen:
        wanted = BY_HAND[name](gap - LONG, v, u, law)
        # nobody drives backwards
        assert found[b, i] == pytest.approx(max(wanted, -v / DT), rel=1e-12, abs=1e-12)
    assert np.isfinite(found).sum() == len(seen)


@pytest.mark.parametrize("name", NEURONS)
def test_networks_are_their_weights_of_gap_speed_and_difference(name: str) -> None:
    system, batch = model(name), states()
    with torch.no_grad():
        for p in system.parameters():
            p.uniform_(-1, 1, generator=torch.Generator().manual_seed(5))
    inside, outside = (
        [p.detach().numpy() for p in layer.parameters()] for layer in system.terms[0].network.layers
    )
    found = accelerations(system, batch)
    for b, i, gap, v, u in each_follower(batch):
        given = (gap / 20, v / 10, (v - u) / 2)
        sums = [float(bias + np.dot(w, given)) for w, bias in zip(*inside, strict=True)]
        wanted = outside[1][0] + sum(
            float(w) * log(1 + exp(s)) for w, s in zip(outside[0][0], sums, strict=True)
        )
        assert found[b, i] == pytest.approx(max(wanted, -v / DT), rel=1e-8)


@pytest.mark.parametrize("law", ["idm", "helly"])
def test_a_network_beside_a_law_starts_as_nothing(law: str) -> None:
    alone, beside = (accelerations(m, states()) for m in (model(law), model(law, network=4)))
    np.testing.assert_array_equal(alone, beside)
    trained = model(law, network=4)
    with torch.no_grad():
        trained.terms[0].network.layers[-1].bias.fill_(0.25)
    found = accelerations(trained, states())
    standing = alone <= found  # where nobody is stopped by v = 0, it is 0.25 more
    free = found - alone > 0.24
    np.testing.assert_allclose((found - alone)[free], 0.25, rtol=1e-9)
    assert free.sum() > 40
    assert standing[np.isfinite(alone)].all()


#: Speed in equilibrium at a net gap s, solved for on paper.
EQUILIBRIUM = {
    "ovm": lambda s, p: optimal(s, p),
    "fvdm": lambda s, p: optimal(s, p),
    "gipps": lambda s, p: min((s - p.s0) / (1.5 * p.T), p.v0),  # b = b_1
    "krauss": lambda s, p: min((s - p.s0) / p.T, p.v0),
    "helly": lambda s, p: (s - p.s0) / p.T,
    "newell": lambda s, p: min((s - p.d) / p.T, p.v0),
}


@pytest.mark.parametrize("name", EQUILIBRIUM)
def test_speeds_in_equilibrium(name: str) -> None:
    system = model(name)
    gaps = [8.0, 12.5, 20.0, 31.0]
    found = system.terms[0].speed(torch.tensor(gaps, dtype=torch.float64)).detach()
    wanted = [EQUILIBRIUM[name](s, numbers(system)) for s in gaps]
    np.testing.assert_allclose(found, wanted, rtol=1e-9)


def test_the_intelligent_driver_s_gap_of_equilibrium() -> None:
    """s_e(v) = (s0 + v T) / sqrt(1 - (v / v0)^4): Treiber, Hennecke & Helbing 2000, (4)."""
    law = model("idm").terms[0]
    v = torch.tensor([1.0, 8.0, 15.0, 29.0], dtype=torch.float64)
    gap = (law.s0 + v * law.T) / torch.sqrt(1 - (v / law.v0) ** 4)
    torch.testing.assert_close(law.speed(gap.detach()), v, rtol=1e-9, atol=0)


def _transfer(name: str, p: Any, omega: float) -> float:
    """How much longer a wave of small amplitude is behind a vehicle than ahead of it."""
    s = 1j * omega
    if name == "helly":
        return abs((p.c_s + s * p.c_v) / (p.c_s + s * s + s * (p.c_v + p.c_s * p.T)))
    lam = p.lam if name == "fvdm" else 0.0
    bend = tanh(p.s_c / p.w)
    slope = p.v0 / p.w / (1 + bend)  # V' at the inflection
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
def test_waves_grow_along_a_platoon_where_the_law_is_unstable(
    name: str, values: dict[str, float], stable: bool
) -> None:
    system = set_(model(name), **values)
    law, omega, small, step = numbers(system), 0.5, 1e-3, 0.25
    s = 15.0 if name != "helly" else 20.0
    v = float(system.terms[0].speed(torch.tensor([s], dtype=torch.float64)))
    if name == "helly":
        rule = law.c_s * law.T**2 + 2 * law.c_v * law.T > 2
    else:
        slope = law.v0 / law.w / (1 + tanh(law.s_c / law.w))
        rule = slope < law.kappa / 2 + (law.lam if name == "fvdm" else 0)
    assert rule is stable
    batch = behind(lambda t: v * t + small * np.sin(omega * t), [s + LONG] * 6, 63.0, LONG, step)
    with torch.no_grad():
        found = TorchdiffeqSolver("rk4", "discrete", step)(system, batch)
    assert found.v is not None
    # the last two periods are a wave of one frequency
    last = found.v[-101:-1, 0, :, 0] - v
    high = (last.max(0).values - last.min(0).values)[:-1].flip(0).numpy() / (2 * small * omega)
    wanted = _transfer(name, law, omega) ** np.arange(1, 7)
    np.testing.assert_allclose(high, wanted, rtol=0.02)
    assert (high[-1] < high[0] < 1) if stable else (high[-1] > high[0] > 1)


def _braking(start: float, b: float) -> Any:
    """Places of a leader that drives for 2 s, and then brakes with b m/s² until it stands."""

    def lead(t: np.ndarray) -> np.ndarray:
        braked = np.clip(t - 2, 0, start / b)
        return start * np.minimum(t, 2) + start * braked - b * braked**2 / 2

    return lead


def test_gipps_steps_are_his_and_he_stops_behind_who_brakes_as_expected() -> None:
    """With steps of T the ballistic method is Gipps' own scheme, equation (2)."""
    system = set_(model("gipps"), T=0.5, b_1=3.0, b=3.0)
    law, per = numbers(system), 0.5
    batch = behind(_braking(20.0, 3.0), [18.0 + LONG, 25.0 + LONG, 40.0], 20.0, LONG, per)
    with torch.no_grad():
        found = TorchdiffeqSolver(None, "discrete", per)(system, batch)
        x, v = batch.x[0, 0, :, 0].numpy().copy(), batch.v[0, 0, :, 0].numpy().copy()
        for k in range(1, batch.n_samples):
            ahead = [(x[i + 1] - x[i] - LONG, float(v[i]), float(v[i + 1]), law) for i in range(3)]
            new = np.array([gipps_speed(*one) for one in ahead])
            x[:-1] += per * (v[:-1] + new) / 2
            v[:-1] = new
            x[-1], v[-1] = batch.x[k, 0, -1, 0], batch.v[k, 0, -1, 0]
            np.testing.assert_allclose(found.x[k, 0, :, 0], x, rtol=1e-12)
    gaps = torch.diff(found.x[:, 0, :, 0]) - LONG
    assert gaps.min() > 0.5 * law.s0
    assert found.v is not None
    assert found.v[-1].abs().max() < 0.05


def test_krauss_does_not_collide_behind_who_brakes_as_hard() -> None:
    system = model("krauss")
    draw = np.random.default_rng(11)
    for speed in (8.0, 20.0, 29.0):
        # at least the gap at which everybody can follow at this speed
        safe = speed + 2.0 + LONG
        batch = behind(_braking(speed, 4.5), list(safe + draw.uniform(0, 9, 5)), 24.0, LONG)
        with torch.no_grad():
            found = TorchdiffeqSolver(None, "discrete", DT)(system, batch)
        assert found.v is not None
        assert (torch.diff(found.x[:, 0, :, 0]) - LONG).min() > 2.0 - 1e-9  # s0
        assert found.v.min() >= 0
        assert found.v[-1].max() < 0.5


@pytest.mark.parametrize("T", [0.5, 1.3])
def test_newell_drives_the_leader_s_path_later_and_farther_back(T: float) -> None:
    """x_n(t) = x_0(t - n T) - n (d + length), down a whole platoon."""
    system = set_(model("newell"), T=T, d=7.0)
    time = DT * np.arange(90)

    def lead(t: np.ndarray) -> np.ndarray:
        return 14 * t + np.where(t > 0, 5 * (1 - np.cos(0.7 * t)), 0.0)

    x = np.stack([lead(time - i * T) - i * (7 + LONG) for i in (3, 2, 1, 0)], 1)
    with torch.no_grad():
        batch = collate([lane(x, DT, v=14.0, length=LONG)])  # of v the first one is read
        found = TorchdiffeqSolver(None, "discrete", DT)(system, batch)
    assert np.ptp(x[:, -1] - 14 * time) > 8
    np.testing.assert_allclose(found.x[:, 0, :, 0], x, rtol=0, atol=1e-9)
