"""What the tests of the fused solver compare: a trajectory and all its gradients."""

from __future__ import annotations

import torch
from torch import Tensor

from nnode.calibrate.cost import sequence_costs
from nnode.data.sequence import Batch, Sequence, collate
from nnode.model import System
from nnode.simulation import Solver, Trajectory
from nnode.simulation.ode import Rates


class RungeKutta:
    """Runge and Kutta's classic method, written out; torchdiffeq's ``rk4`` is its 3/8 rule.

    Args:
        substeps: in a sampling interval.
    """

    def __init__(self, substeps: int = 1) -> None:
        self.substeps = substeps

    def __call__(self, system: System, batch: Batch) -> Trajectory:
        rates = Rates(system, batch, self.substeps, "rk4")
        y = system.initial(batch, batch.dt / self.substeps)
        found = [y]
        for step in range(self.substeps * (batch.n_samples - 1)):
            t = torch.tensor(float(step), dtype=y.dtype)
            k1 = rates(t, y)
            k2 = rates(t + 0.5, y + k1 / 2)
            k3 = rates(t + 0.5, y + k2 / 2)
            k4 = rates(t + 1, y + k3)
            y = y + (k1 + 2 * k2 + 2 * k3 + k4) / 6
            if (step + 1) % self.substeps == 0:
                found.append(y)
        return Trajectory(*system.observe(torch.stack(found), batch))


def single(items: list[Sequence]) -> Batch:
    """A batch whose numbers are float32 numbers, in float64: the same problem in both."""
    return collate(items).to(dtype=torch.float32).to(dtype=torch.float64)


def gradient(model: System, solver: Solver, batch: Batch) -> tuple[Trajectory, Tensor]:
    """A trajectory, and the gradient of the summed costs by all parameters and the start."""
    model.zero_grad()
    x = batch.x.clone().requires_grad_(getattr(model, "leader", "") != "measured")
    moving = Batch(**{**vars(batch), "x": x})
    found = solver(model, moving)
    # the measured positions of the cost carry no gradient, the first ones of the start do
    sequence_costs(found, batch).sum().backward()
    parts = [torch.zeros_like(p) if p.grad is None else p.grad for p in model.parameters()]
    parts += [] if x.grad is None else [x.grad[0]]
    return found, torch.cat([part.flatten() for part in parts]).detach()


def difference(found: Tensor, exact: Tensor) -> float:
    """Norm of the difference relative to the norm."""
    return float((found.double() - exact.double()).norm() / exact.double().norm())
