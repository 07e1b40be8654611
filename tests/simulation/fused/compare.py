"""Comparisons of trajectories and gradients."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from nnode.calibrate.cost import sequence_costs
from nnode.data.sequence import Batch, Sequence, collate
from nnode.model import System
from nnode.simulation import Solver, TorchdiffeqSolver, Trajectory
from nnode.simulation.ode import Rates


class RungeKutta:
    """The classic Runge-Kutta method; torchdiffeq's ``rk4`` is the 3/8 rule.

    Args:
        substeps: number of steps in a sampling interval.
    """

    def __init__(self, substeps: int = 1) -> None:
        self.substeps = substeps

    def __call__(self, system: System, batch: Batch) -> Trajectory:
        rates = Rates(system, batch, self.substeps, "rk4")
        y = system.initial(batch, batch.dt / self.substeps)
        states = [y]
        for step in range(self.substeps * (batch.n_samples - 1)):
            t = torch.tensor(float(step), dtype=y.dtype)
            k1 = rates(t, y)
            k2 = rates(t + 0.5, y + k1 / 2)
            k3 = rates(t + 0.5, y + k2 / 2)
            k4 = rates(t + 1, y + k3)
            y = y + (k1 + 2 * k2 + 2 * k3 + k4) / 6
            if (step + 1) % self.substeps == 0:
                states.append(y)
        return Trajectory(*system.observe(torch.stack(states), batch))


def single(items: list[Sequence]) -> Batch:
    """A float64 batch whose numbers are exact in float32."""
    return collate(items).to(dtype=torch.float32).to(dtype=torch.float64)


def flat_gradient(parameters: Iterable[Tensor]) -> Tensor:
    """The gradients of all parameters, with zeros of those without a gradient."""
    parts = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
    return torch.cat([part.flatten() for part in parts]).detach()


def gradient(model: System, solver: Solver, batch: Batch) -> tuple[Trajectory, Tensor]:
    """A trajectory, and the gradient of a function of all its states by parameters and start."""
    model.zero_grad()
    free = getattr(model, "leader", "") != "measured"  # compiled code refuses this gradient
    start = {name: getattr(batch, name).clone().requires_grad_(free) for name in "xv"}
    path = solver(model, replace(batch, **start))
    cost = sequence_costs(path, batch).sum()
    if path.v is not None:
        cost = cost + 0.02 * path.v.masked_fill(~batch.valid[..., None], 0.0).square().sum()
    cost.backward()
    parts = [flat_gradient(model.parameters())]
    parts += [t.grad[0].flatten() for t in start.values() if t.grad is not None]
    return path, torch.cat(parts)


def difference(gradient: Tensor, exact: Tensor) -> float:
    """Norm of the difference relative to the norm."""
    return float((gradient.double() - exact.double()).norm() / exact.double().norm())


def compare(
    model: System,
    batch: Batch,
    dt: float,
    *solvers: Solver,
    limit: float = 1e-10,
    single_precision: bool = False,
    **close: float,
) -> None:
    """Compare states and gradients with those of torchdiffeq in float64.

    Args:
        limit: largest relative difference of the gradient.
        close: tolerances of states.
    """
    exact, expected = gradient(model, TorchdiffeqSolver("euler", "discrete", dt), batch)
    assert expected.abs().max() > 0
    if single_precision:
        model, batch = model.to(torch.float32), batch.to(dtype=torch.float32)
    for solver in solvers:
        path, computed = gradient(model, solver, batch)
        assert {p.grad.dtype for p in model.parameters() if p.grad is not None} == {batch.dtype}
        for states, reference in ((path.x, exact.x), (path.v, exact.v)):
            if reference is not None and states is not None:
                pair = states[batch.valid].double(), reference[batch.valid]
                torch.testing.assert_close(*pair, **({"rtol": 1e-12, "atol": 1e-12} | close))
        assert difference(computed, expected) < limit
