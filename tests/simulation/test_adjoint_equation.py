"""The paper's adjoint equation and gradient formula, by hand for the law Lin.

Source: Göttlich & Totzeck, section 4. With f the right-hand side and p the adjoint state, the
gradient of the cost is int (df/du)ᵀ p dt, as the paper prints it, if p solves

    -dp/dt = (df/dx)ᵀ p + (x - z),   p(T) = 0.

The paper prints the last term as -(x - z); its p is the negative of this one, and with that sign
the printed integral is minus the gradient. The sign used here is the one that makes the printed
gradient formula the gradient.

The cost of sampled data is J = 1/2 sum_k dt |x(t_k) - z_k|²: between samples the source vanishes,
and going back in time p jumps by dt (x(t_k) - z_k) at every sampling time.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from nnode.calibrate.cost import sequence_costs
from nnode.data.sequence import Sequence, collate
from nnode.model import Traffic, make_law
from nnode.simulation import TorchdiffeqSolver
from tests.simulation.scenes import platoon

V0, LENGTH = 21.0, 4.5
TIGHT = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}


def rates(x: np.ndarray) -> np.ndarray:
    """f: Lin for the followers, v0 for the leader."""
    return np.append(V0 * (1 - LENGTH / np.diff(x)), V0)


def transposed_jacobian(x: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(df/dx)ᵀ p: x_i lessens its own gap and widens that of the vehicle behind."""
    slope = V0 * LENGTH / np.diff(x) ** 2 * p[:-1]
    out = np.zeros_like(p)
    out[:-1] -= slope
    out[1:] += slope
    return out


def gradient_density(x: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(df/du)ᵀ p for u = (v0, L)."""
    gap = np.diff(x)
    return np.array([((1 - LENGTH / gap) * p[:-1]).sum() + p[-1], (-V0 / gap * p[:-1]).sum()])


def by_hand(item: Sequence) -> tuple[float, np.ndarray]:
    """Cost and gradient, state and adjoint integrated by scipy."""
    z, time, n = item.x[..., 0], item.time - item.time[0], item.n_agents
    span = (0.0, time[-1])
    forward = solve_ivp(lambda t, x: rates(x), span, z[0], dense_output=True, **TIGHT)
    x = forward.sol

    def backward(t: float, y: np.ndarray) -> np.ndarray:
        p = y[:n]
        return np.concatenate([-transposed_jacobian(x(t), p), -gradient_density(x(t), p)])

    y = np.zeros(n + 2)  # adjoint state and gradient
    for k in range(len(time) - 1, 0, -1):
        y[:n] += item.dt * (x(time[k]) - z[k])
        y = solve_ivp(backward, (time[k], time[k - 1]), y, **TIGHT).y[:, -1]
    cost = 0.5 * item.dt * ((x(time).T - z) ** 2).sum()
    return float(cost), y[n:]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("method", "dt"), [("rk4", 0.01), ("dopri5", 0.2), ("implicit_adams", 0.005)]
)
@pytest.mark.parametrize("gradient", ["adjoint", "discrete"])
def test_autograd_solves_the_adjoint_equation(method, dt, gradient) -> None:  # type: ignore[no-untyped-def]
    item = platoon([9.0, 16.0, 12.0], samples=8, noise=1.0)
    expected_cost, expected = by_hand(item)
    model, batch = Traffic([make_law("lin", v0=V0, L=LENGTH)]), collate([item])
    solver = TorchdiffeqSolver(method, gradient, dt, rtol=1e-10, atol=1e-10)
    cost = sequence_costs(solver(model, batch), batch).sum()
    cost.backward()
    by_autograd = [model.terms[0].v0.grad.item(), model.terms[0].L.grad.item()]
    assert cost.item() == pytest.approx(expected_cost, rel=1e-7)
    np.testing.assert_allclose(by_autograd, expected, rtol=1e-6)


def test_the_paper_s_cost_is_the_limit_of_ever_denser_samples() -> None:
    # continuous source instead of jumps, against a measurement z known at all times
    t_end, n = 1.0, 3
    start = np.array([12.0, 21.0, 37.0])

    def z(t: float | np.ndarray) -> np.ndarray:
        return start[:, None] + np.array([14.0, 16.0, 20.0])[:, None] * np.atleast_1d(t)

    x = solve_ivp(lambda t, x: rates(x), (0.0, t_end), start, dense_output=True, **TIGHT).sol

    def backward(t: float, y: np.ndarray) -> np.ndarray:
        p, away = y[:n], x(t) - z(t)[:, 0]
        return np.concatenate([-transposed_jacobian(x(t), p) - away, -gradient_density(x(t), p)])

    expected = solve_ivp(backward, (t_end, 0.0), np.zeros(n + 2), **TIGHT).y[n:, -1]

    errors = []
    for samples in (50, 100):
        time = np.linspace(0, t_end, samples + 1)
        item = Sequence(name="dense", recording="r", time=time, x=z(time).T[:, :, None])
        model, batch = Traffic([make_law("lin", v0=V0, L=LENGTH)]), collate([item])
        solver = TorchdiffeqSolver("rk4", "discrete", item.dt)
        sequence_costs(solver(model, batch), batch).sum().backward()
        by_autograd = np.array([model.terms[0].v0.grad.item(), model.terms[0].L.grad.item()])
        errors.append(abs(by_autograd - expected) / abs(expected))
    # the sum over samples is a Riemann sum of the integral
    assert np.all(errors[1] < 0.02)
    np.testing.assert_allclose(errors[0] / errors[1], 2.0, rtol=0.05)
