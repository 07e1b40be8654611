"""A leader that follows its record."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nnode.calibrate.cost import sequence_costs
from nnode.data.sequence import Sequence, collate
from nnode.model import Traffic, make_law
from nnode.simulation import TorchdiffeqSolver
from tests.simulation.scenes import platoon

V0, LENGTH, DT, STEPS = 21.0, 4.0, 0.02, 10


def followers_loop(item: Sequence, v0: complex = V0, length: complex = LENGTH) -> np.ndarray:
    """Euler for the followers behind a leader on straight lines between its samples."""
    time = item.time - item.time[0]
    x = item.x[0, :-1, 0]
    states = [x]
    for step in range(STEPS * (item.n_samples - 1)):
        lead = np.interp(step * DT, time, item.x[:, -1, 0])
        gap = np.diff(np.append(x, lead))
        x = x + DT * v0 * (1 - length / gap)
        if (step + 1) % STEPS == 0:
            states.append(x)
    return np.array(states)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_the_record_leads(dtype: torch.dtype, tolerance: float) -> None:
    items = [platoon([12.0, 18.0], samples=14, noise=1.0), platoon([9.0], samples=4, noise=1.0)]
    batch = collate(items).to(dtype=dtype)
    model = Traffic([make_law("lin", v0=V0, L=LENGTH)], leader="measured").to(dtype)
    x = TorchdiffeqSolver("euler", dt=DT)(model, batch).x.detach()
    for b, item in enumerate(items):
        k, n = item.n_samples, item.n_agents
        leader = x[:k, b, n - 1, 0]
        assert torch.equal(leader, batch.x[:k, b, n - 1, 0])
        np.testing.assert_allclose(
            x[:k, b, : n - 1, 0], followers_loop(item), rtol=tolerance, atol=tolerance
        )


@pytest.mark.parametrize("gradient", ["adjoint", "discrete"])
def test_a_speed_that_nobody_drives_at_has_no_gradient(gradient: str) -> None:
    term = make_law("network_speed", hidden=2, generator=torch.Generator().manual_seed(0))
    model, batch = Traffic([term], leader="measured"), collate([platoon([12.0, 18.0])])
    sequence_costs(
        TorchdiffeqSolver(gradient=gradient, dt=DT)(model, batch), batch
    ).sum().backward()
    assert term.v0.grad is not None
    assert term.v0.grad.item() == 0.0
    assert all(p.grad.abs().max() > 0 for p in term.network.parameters())


def test_gradient_behind_the_record() -> None:
    item = platoon([12.0, 18.0, 9.0], samples=6, noise=1.0)
    batch, term = collate([item]), make_law("lin", v0=V0, L=LENGTH)
    solver = TorchdiffeqSolver("euler", "discrete", DT)
    sequence_costs(solver(Traffic([term], leader="measured"), batch), batch).sum().backward()

    def cost(v0: complex, length: complex) -> complex:
        away = followers_loop(item, v0, length) - item.x[:, :-1, 0]
        return 0.5 * item.dt * (away**2).sum()

    h = 1e-30  # differentiation along the imaginary axis loses no digits
    expected = [cost(V0 + 1j * h, LENGTH).imag / h, cost(V0, LENGTH + 1j * h).imag / h]
    np.testing.assert_allclose([term.v0.grad.item(), term.L.grad.item()], expected, rtol=1e-10)
