"""The adjoint equation and gradient formula of Göttlich & Totzeck, section 4, for the law Lin.

With the right-hand side f and the adjoint state p, the gradient of the cost is int (df/du)ᵀ p dt if

    -dp/dt = (df/dx)ᵀ p + (x - z),   p(T) = 0.

The paper prints -(x - z), with which the integral is minus the gradient.

The cost of samples is J = 1/2 sum_k dt |x(t_k) - z_k|². Then p has no source between samples, and
jumps by dt (x(t_k) - z_k) at each sample.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
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
    """(df/dx)ᵀ p: x_i shortens its own gap and lengthens the gap behind it."""
    slope = V0 * LENGTH / np.diff(x) ** 2 * p[:-1]
    out = np.zeros_like(p)
    out[:-1] -= slope
    out[1:] += slope
    return out


def adjoint_rates(x: np.ndarray, p: np.ndarray, source: float | np.ndarray = 0.0) -> np.ndarray:
    """Rates of p, and of the gradient int (df/du)ᵀ p dt for u = (v0, L), backward in time."""
    gap = np.diff(x)
    density = [((1 - LENGTH / gap) * p[:-1]).sum() + p[-1], (-V0 / gap * p[:-1]).sum()]
    return np.concatenate([-transposed_jacobian(x, p) - source, -np.array(density)])


def by_scipy(item: Sequence) -> tuple[float, np.ndarray]:
    """Cost and gradient; SciPy integrates state and adjoint."""
    z, time, n = item.x[..., 0], item.time - item.time[0], item.n_agents
    span = (0.0, time[-1])
    forward = solve_ivp(lambda t, x: rates(x), span, z[0], dense_output=True, **TIGHT)
    x = forward.sol

    def backward(t: float, y: np.ndarray) -> np.ndarray:
        return adjoint_rates(x(t), y[:n])

    y = np.zeros(n + 2)  # adjoint state and gradient
    for k in range(len(time) - 1, 0, -1):
        y[:n] += item.dt * (x(time[k]) - z[k])
        y = solve_ivp(backward, (time[k], time[k - 1]), y, **TIGHT).y[:, -1]
    cost = 0.5 * item.dt * ((x(time).T - z) ** 2).sum()
    return float(cost), y[n:]


def by_autograd(item: Sequence, solver: TorchdiffeqSolver) -> tuple[float, np.ndarray]:
    model, batch = Traffic([make_law("lin", v0=V0, L=LENGTH)]), collate([item])
    cost = sequence_costs(solver(model, batch), batch).sum()
    slope = torch.autograd.grad(cost, [model.terms[0].v0, model.terms[0].L])
    return cost.item(), torch.stack(slope).numpy()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("method", "dt"), [("rk4", 0.01), ("dopri5", 0.2), ("implicit_adams", 0.005)]
)
@pytest.mark.parametrize("gradient", ["adjoint", "discrete"])
def test_gradient_by_the_adjoint_equation(method, dt, gradient) -> None:
    item = platoon([9.0, 16.0, 12.0], samples=8, noise=1.0)
    expected_cost, expected = by_scipy(item)
    solver = TorchdiffeqSolver(method, gradient, dt, rtol=1e-10, atol=1e-10)
    cost, slope = by_autograd(item, solver)
    assert cost == pytest.approx(expected_cost, rel=1e-7)
    np.testing.assert_allclose(slope, expected, rtol=1e-6)


def test_cost_of_dense_samples_approaches_the_continuous_cost() -> None:
    t_end, n = 1.0, 3
    start = np.array([12.0, 21.0, 37.0])

    def z(t: float | np.ndarray) -> np.ndarray:
        return start[:, None] + np.array([14.0, 16.0, 20.0])[:, None] * np.atleast_1d(t)

    x = solve_ivp(lambda t, x: rates(x), (0.0, t_end), start, dense_output=True, **TIGHT).sol

    def backward(t: float, y: np.ndarray) -> np.ndarray:
        return adjoint_rates(x(t), y[:n], x(t) - z(t)[:, 0])

    expected = solve_ivp(backward, (t_end, 0.0), np.zeros(n + 2), **TIGHT).y[n:, -1]

    errors = []
    for samples in (50, 100):
        time = np.linspace(0, t_end, samples + 1)
        item = Sequence(name="dense", recording="r", time=time, x=z(time).T[:, :, None])
        _, slope = by_autograd(item, TorchdiffeqSolver("rk4", "discrete", item.dt))
        errors.append(abs(slope - expected) / abs(expected))
    # the sum over samples is a Riemann sum of the integral
    assert np.all(errors[1] < 0.02)
    np.testing.assert_allclose(errors[0] / errors[1], 2.0, rtol=0.05)
