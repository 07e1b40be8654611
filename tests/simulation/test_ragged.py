"""Padding changes nothing: a batch is its sequences, each simulated alone, in any order."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from nnode.calibrate.cost import sequence_costs
from nnode.data.sequence import Sequence, collate
from nnode.model import Crowd, System, Traffic, make_law
from nnode.simulation import TorchdiffeqSolver
from tests.builders import social_forces
from tests.simulation.scenes import crowd


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(3)


TRAFFIC = {
    "lin": lambda: Traffic([make_law("lin", v0=18.0, L=4.0)]),
    "log": lambda: Traffic([make_law("log", v0=18.0, L=6.0)]),
    "n4": lambda: Traffic([make_law("network_speed", hidden=4, v0=18.0, generator=seeded())]),
    "lin_measured": lambda: Traffic([make_law("lin", v0=18.0, L=4.0)], leader="measured"),
}
CROWD = {
    "sf": lambda: Crowd(social_forces(B=0.1)),
    "nn": lambda: Crowd(
        [make_law("relaxation"), make_law("network_force", hidden=4, generator=seeded())]
    ),
}


@pytest.fixture(scope="session")
def crowds() -> list[Sequence]:
    # with 4, 1, 2 and 3 people come two, no, one and two walls
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
    # without walls the network of the walls has no part in the cost
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in model.parameters()]
    return rows, torch.cat([g.flatten() for g in gradients])


def check(model: System, items: list[Sequence], solver: TorchdiffeqSolver, dtype, rtol) -> None:  # type: ignore[no-untyped-def]
    model.to(dtype)
    close = {"rtol": rtol, "atol": rtol}
    alone = [run(model, [item], solver, dtype) for item in items]
    together, gradient = run(model, items, solver, dtype)
    for row, (single, _) in zip(together, alone, strict=True):
        torch.testing.assert_close(row, single[0], **close)
    total = torch.stack([g for _, g in alone]).sum(0)
    assert total.abs().max() > 0
    torch.testing.assert_close(gradient, total, rtol=rtol, atol=rtol * float(total.abs().max()))
    order = [2, 0, 3, 1]
    shuffled, mixed = run(model, [items[i] for i in order], solver, dtype)
    for row, i in zip(shuffled, order, strict=True):
        torch.testing.assert_close(row, together[i], **close)
    torch.testing.assert_close(mixed, gradient, rtol=rtol, atol=rtol * float(total.abs().max()))


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-11), (torch.float32, 2e-4)])
@pytest.mark.parametrize("gradient", ["adjoint", "discrete"])
@pytest.mark.parametrize("model", TRAFFIC)
def test_traffic(ragged, model, gradient, dtype, rtol) -> None:  # type: ignore[no-untyped-def]
    check(TRAFFIC[model](), ragged, TorchdiffeqSolver("euler", gradient, 0.02), dtype, rtol)


@pytest.mark.thorough
@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-9), (torch.float32, 2e-3)])
@pytest.mark.parametrize("gradient", ["adjoint", "discrete"])
@pytest.mark.parametrize("model", CROWD)
def test_crowd(crowds, model, gradient, dtype, rtol) -> None:  # type: ignore[no-untyped-def]
    check(CROWD[model](), crowds, TorchdiffeqSolver("euler", gradient, 0.04), dtype, rtol)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["rk4", "dopri5"])
def test_other_methods(ragged, method: str) -> None:  # type: ignore[no-untyped-def]
    # an adaptive step suits all sequences of a batch: equal to tolerance, not to rounding
    rtol = 1e-11 if method == "rk4" else 1e-6
    solver = TorchdiffeqSolver(method, "discrete", 0.02, rtol=1e-10, atol=1e-10)
    check(TRAFFIC["lin"](), ragged, solver, torch.float64, rtol)
