"""The cost against NumPy loops, and its gradient against their complex-step derivative.

The complex-step derivative Im f(u + i h) / h has no cancellation, so that h can be 1e-30.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from nnode.calibrate.cost import sequence_costs
from nnode.data.sequence import Batch, Sequence, collate
from nnode.model import Crowd, System, Traffic, make_law
from nnode.simulation import TorchdiffeqSolver
from tests.simulation.scenes import crowd, platoon

HIDDEN, R, B, TAU = 4, 0.25, 0.1, 0.5


def traffic_loop(
    speed: Callable, item: Sequence, u: np.ndarray, steps: int, measured: bool
) -> np.ndarray:
    """Cost by Euler's method; u[0] is v0, the speed of a leader without a measured path."""
    x, total = item.x[0, :, 0].astype(complex), 0.0
    for step in range(steps * (item.n_samples - 1)):
        if measured:
            x[-1] = np.interp(step / steps, np.arange(item.n_samples), item.x[:, -1, 0])
        x = x + item.dt / steps * np.append(speed(np.diff(x), u), u[0])
        k, part = divmod(step + 1, steps)
        if part == 0:
            error = (x - item.x[k, :, 0])[: item.n_agents - measured]
            total += 0.5 * item.dt * (error**2).sum()
    return total


def length(vector: np.ndarray) -> complex:
    return np.sqrt((vector**2).sum())


def social_force_loop(item: Sequence, u: np.ndarray, steps: int) -> np.ndarray:
    """Cost by Euler's method without walls; u is (A, k, kappa)."""
    n = item.n_agents
    x, v = item.x[0].astype(complex), item.velocity()[0].astype(complex)
    total = 0.0
    for k in range(1, item.n_samples):
        for _ in range(steps):
            a = np.zeros_like(v)
            for i in range(n):
                way = item.destination[i] - x[i]
                a[i] += (length(v[i]) * way / length(way) - v[i]) / TAU
                for j in range(n):
                    if j == i:
                        continue
                    d = length(x[i] - x[j])
                    e = (x[i] - x[j]) / d
                    t = np.array([-e[1], e[0]])
                    h = 2 * R - d if d.real < 2 * R else 0.0
                    push = u[0] * np.exp((2 * R - d) / B) + u[1] * h
                    a[i] += (push * e + u[2] * h * ((v[j] - v[i]) @ t) * t) / n
            x, v = x + item.dt / steps * v, v + item.dt / steps * a
        total += 0.5 * item.dt * ((x - item.x[k]) ** 2).sum()
    return total


def complex_gradient(cost: Callable, u: np.ndarray) -> np.ndarray:
    h = 1e-30
    return np.array([cost(u + 1j * h * e).imag / h for e in np.eye(len(u))])


def network(gap: np.ndarray, u: np.ndarray) -> np.ndarray:
    w1, b1, w2, b2 = np.split(u[1:], [HIDDEN, 2 * HIDDEN, 3 * HIDDEN])
    return np.log(1 + np.exp(gap[:, None] * w1 + b1)) @ w2 + b2


#: Laws, and their speeds at gaps with parameters u.
TRAFFIC = {
    "lin": (make_law("lin", v0=21.0, L=4.5), lambda gap, u: u[0] * (1 - u[1] / gap)),
    "log": (make_law("log", v0=21.0, L=6.5), lambda gap, u: u[0] * np.log(gap / u[1])),
    "n4": (
        make_law(
            "network_speed", hidden=HIDDEN, v0=16.0, generator=torch.Generator().manual_seed(4)
        ),
        network,
    ),
}


def people() -> Crowd:
    force = make_law("social_force", A=1.5, k=30.0, kappa=9.0, r=R, B=B)
    return Crowd([make_law("relaxation", tau=TAU), force])


def flat(model: System, gradient: bool = False) -> np.ndarray:
    values = [p.grad if gradient else p.detach() for p in model.parameters()]
    return torch.cat([value.flatten() for value in values]).numpy()


def gradient(model: System, batch: Batch, kind: str, dt: float) -> tuple[float, np.ndarray]:
    """The cost and its gradient."""
    model.zero_grad()
    cost = sequence_costs(TorchdiffeqSolver("euler", kind, dt)(model, batch), batch).sum()
    cost.backward()
    return float(cost.detach()), flat(model, gradient=True)


@pytest.mark.parametrize("leader", ["constant", "measured"])
@pytest.mark.parametrize("name", TRAFFIC)
def test_cost_and_discrete_gradient_in_traffic(name: str, leader: str) -> None:
    law, speed = TRAFFIC[name]
    # small gaps: PyTorch replaces softplus(x) by x for x > 20, which changes it by 2e-9
    item = platoon([6.0, 8.0, 5.5], samples=4, noise=1.0)
    model = Traffic([law], leader=leader)

    def cost(u: np.ndarray) -> np.ndarray:
        return traffic_loop(speed, item, u, 10, leader == "measured")

    simulated_cost, slope = gradient(model, collate([item]), "discrete", 0.02)
    assert simulated_cost == pytest.approx(cost(flat(model)).real, rel=1e-10)
    expected = complex_gradient(cost, flat(model))
    np.testing.assert_allclose(slope, expected, rtol=1e-10, atol=1e-10 * abs(expected).max())


def test_cost_and_discrete_gradient_in_crowds() -> None:
    item = crowd(4, samples=4)
    shaken = item.x + 0.05 * np.cos(9 * np.arange(4))[:, None, None]
    item = replace(item, walls=None, x=shaken)
    model = people()
    expected = complex_gradient(lambda u: social_force_loop(item, u, 5), flat(model))
    simulated_cost, slope = gradient(model, collate([item]), "discrete", 0.04)
    assert simulated_cost == pytest.approx(social_force_loop(item, flat(model), 5).real, rel=1e-9)
    assert abs(expected).min() > 0
    # the package smooths distances at 1e-6 m
    np.testing.assert_allclose(slope, expected, rtol=1e-9)


@pytest.mark.thorough
def test_adjoint_gradient_in_crowds_converges_at_first_order() -> None:
    model = people()
    # at 0.35 m neighbours stay in contact, so that the force has no kink
    batch, number = collate([crowd(3, samples=3, apart=0.35)]), np.array([32, 64, 128])
    deviation = []
    for n in number:
        discrete, adjoint = (
            gradient(model, batch, kind, 0.2 / n)[1] for kind in ("discrete", "adjoint")
        )
        deviation.append(np.linalg.norm(adjoint - discrete) / np.linalg.norm(discrete))
    slope = np.polyfit(np.log(0.2 / number), np.log(deviation), 1)[0]
    assert 0.9 < slope < 1.1
    assert deviation[-1] < 0.05
