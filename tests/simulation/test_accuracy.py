"""Trajectories against an analytic solution, in single precision, and of divergent models.

The gap of a follower with the law Lin behind a leader at v0 is g(t) = sqrt(g(0)² + 2 v0 L t).
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nnode.data.sequence import Sequence, collate
from nnode.errors import SimulationError
from nnode.model import Crowd, System, Traffic, make_law
from nnode.simulation import TorchdiffeqSolver
from tests.builders import social_forces
from tests.simulation.fused.compare import compare
from tests.simulation.scenes import crowd, platoon

V0, LENGTH, GAP = 20.0, 5.0, 8.0


def simulated_gap(method: str, dt: float, **tolerances: float) -> np.ndarray:
    batch = collate([platoon([GAP], samples=8)])
    model = Traffic([make_law("lin", v0=V0, L=LENGTH)])
    x = TorchdiffeqSolver(method, dt=dt, **tolerances)(model, batch).x.detach().numpy()
    return x[:, 0, 1, 0] - x[:, 0, 0, 0]


ANALYTIC = np.sqrt(GAP**2 + 2 * V0 * LENGTH * 0.2 * np.arange(8))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("method", "order"),
    [("euler", 1), ("midpoint", 2), ("heun3", 3), ("rk4", 4)],
)
def test_order_of_convergence(method: str, order: int) -> None:
    number = np.array([8, 16, 32, 64]) if order < 4 else np.array([2, 4, 8, 16])
    error = [abs(simulated_gap(method, 0.2 / n) - ANALYTIC).max() for n in number]
    slope = np.polyfit(np.log(0.2 / number), np.log(error), 1)[0]
    assert slope == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize("method", ["explicit_adams", "implicit_adams"])
def test_multistep_methods_step_inside_the_sampling_interval(method: str) -> None:
    coarse = abs(simulated_gap(method, 0.04) - ANALYTIC).max()
    fine = abs(simulated_gap(method, 0.01) - ANALYTIC).max()
    assert coarse > 0
    assert fine < coarse / 4**3.5


@pytest.mark.parametrize("method", ["dopri5", "scipy_solver"])
def test_tolerance_of_adaptive_methods(method: str) -> None:
    error = {}
    for tolerance in (1e-5, 1e-10):
        gap = simulated_gap(method, 0.2, rtol=tolerance, atol=tolerance)
        error[tolerance] = abs(gap - ANALYTIC).max()
        # positions are of the order of 50 m, and errors of several steps add up
        assert error[tolerance] < tolerance * 50 * 10
    assert error[1e-10] < error[1e-5] / 1e3


@pytest.mark.parametrize(
    ("model", "item"),
    [
        (
            Traffic([make_law("lin", v0=25.0, L=4.5)]),
            platoon([12.0, 30.0], samples=13, start=900.0),
        ),
        (Crowd(social_forces(A=1.0)), crowd(4)),
    ],
    ids=["lane", "crowd"],
)
def test_single_precision(model: System, item: Sequence) -> None:
    # a rounding error of 6e-8 of the position in each of at most 240 steps
    close = {"limit": 1e-3, "rtol": 6e-8 * 240, "atol": 1e-5}
    solver = TorchdiffeqSolver("euler", "discrete", 0.01)
    compare(model, collate([item]), 0.01, solver, single_precision=True, **close)


def test_trajectory_does_not_depend_on_the_gradient() -> None:
    model, batch = Traffic([make_law("lin", v0=25.0, L=4.5)]), collate([platoon([12.0, 30.0])])
    adjoint, discrete = (
        TorchdiffeqSolver(gradient=gradient, dt=0.02)(model, batch).x
        for gradient in ("adjoint", "discrete")
    )
    assert torch.equal(adjoint, discrete)


def divergent() -> Traffic:
    """A speed of 1e12 m/s per metre of gap, which overflows in float32 after a few steps."""
    term = make_law("network_speed", hidden=1, v0=0.0)
    with torch.no_grad():
        for weight, value in zip(term.network.parameters(), (1.0, 0.0, -1e12, 0.0), strict=True):
            weight.fill_(value)
    return Traffic([term]).to(torch.float32)


def test_time_of_an_overflow() -> None:
    batch = collate([platoon([30.0], samples=9, noise=0.0)]).to(dtype=torch.float32)
    # each Euler step of 0.2 s multiplies the gap by 0.2e12: 30 * (2e11)^k overflows at k = 4
    with pytest.raises(SimulationError, match=r"agent 0 at 0\.8 s"):
        TorchdiffeqSolver(dt=0.2)(divergent(), batch)


def test_states_after_the_end_of_a_sequence_are_constant() -> None:
    model = divergent()
    short, long = platoon([30.0], samples=3, noise=0.0), platoon([], samples=9)
    batch = collate([short, long]).to(dtype=torch.float32)
    trajectory = TorchdiffeqSolver(gradient="discrete", dt=0.2)(model, batch)
    x = trajectory.x.detach()
    assert x.isfinite().all()
    assert torch.equal(x[4:, 0], x[-1:, 0].expand_as(x[4:, 0]))
    # an overflow after the end would give NaN here, although it is masked
    (trajectory.x[..., 0] * batch.valid).sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())
