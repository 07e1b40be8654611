"""Padding: a batch gives the same results as its sequences alone, in any order."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from nnode.calibrate.cost import sequence_costs
from nnode.data.sequence import Sequence, collate
from nnode.model import Crowd, System, Traffic, make_law
from nnode.simulation import TorchdiffeqSolver
from tests.builders import social_forces
from tests.simulation.fused.compare import flat_gradient
from tests.simulation.scenes import LAWS, crowd, network_force

TRAFFIC = {
    "lin": lambda: Traffic([LAWS["lin"]()]),
    "log": lambda: Traffic([LAWS["log"]()]),
    "n4": lambda: Traffic([LAWS["n4"]()]),
    "lin_measured": lambda: Traffic([LAWS["lin"]()], leader="measured"),
}
CROWD = {
    "sf": lambda: Crowd(social_forces(B=0.1)),
    "nn": lambda: Crowd([make_law("relaxation"), network_force()]),
}


@pytest.fixture(scope="session")
def crowds() -> list[Sequence]:
    # with two, zero, one and two walls
    return [
        crowd(4, samples=4, name="a"),
        crowd(1, samples=5, name="b"),
        crowd(2, samples=2, name="c"),
        crowd(3, samples=3, name="d"),
    ]


def run(
    model: System, items: list[Sequence], solver: TorchdiffeqSolver, dtype: torch.dtype
) -> tuple[list[Tensor], Tensor]:
    """Trajectories without the padding, and the gradient of the summed costs."""
    batch = collate(items).to(dtype=dtype)
    model.zero_grad()
    trajectory = solver(model, batch)
    sequence_costs(trajectory, batch).sum().backward()
    parts = [trajectory.x] if trajectory.v is None else [trajectory.x, trajectory.v]
    states = torch.cat(parts, -1).detach()
    rows = [states[: s.n_samples, b, : s.n_agents] for b, s in enumerate(items)]
    return rows, flat_gradient(model.parameters())


def check(model: System, items: list[Sequence], solver: TorchdiffeqSolver, dtype, rtol) -> None:
    model.to(dtype)
    alone = [run(model, [item], solver, dtype) for item in items]
    total = torch.stack([gradient for _, gradient in alone]).sum(0)
    largest = float(total.abs().max())
    assert largest > 0
    for order in ([0, 1, 2, 3], [2, 0, 3, 1]):
        rows, gradient = run(model, [items[i] for i in order], solver, dtype)
        for row, i in zip(rows, order, strict=True):
            torch.testing.assert_close(row, alone[i][0][0], rtol=rtol, atol=rtol)
        torch.testing.assert_close(gradient, total, rtol=rtol, atol=rtol * largest)


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-11), (torch.float32, 2e-4)])
@pytest.mark.parametrize("gradient", ["adjoint", "discrete"])
@pytest.mark.parametrize("model", TRAFFIC)
def test_traffic(ragged, model, gradient, dtype, rtol) -> None:
    check(TRAFFIC[model](), ragged, TorchdiffeqSolver("euler", gradient, 0.02), dtype, rtol)


@pytest.mark.thorough
@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-9), (torch.float32, 2e-3)])
@pytest.mark.parametrize("gradient", ["adjoint", "discrete"])
@pytest.mark.parametrize("model", CROWD)
def test_crowd(crowds, model, gradient, dtype, rtol) -> None:
    check(CROWD[model](), crowds, TorchdiffeqSolver("euler", gradient, 0.04), dtype, rtol)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["rk4", "dopri5"])
def test_other_methods(ragged, method: str) -> None:
    # an adaptive step depends on all sequences of a batch
    rtol = 1e-11 if method == "rk4" else 1e-6
    solver = TorchdiffeqSolver(method, "discrete", 0.02, rtol=1e-10, atol=1e-10)
    check(TRAFFIC["lin"](), ragged, solver, torch.float64, rtol)
