"""Exact derivatives by eight parameters, and the states alone."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.speed.problems import Problem, pose
from nnode.errors import SimulationError
from nnode.model import Traffic
from nnode.simulation.kernels import lanes

#: Tangents are timed if they agree so well with the gradient.
_AGREE = 1e-9


def calls(problem: Problem) -> dict[str, Callable[[], Tensor]]:
    """``forward``: states alone; ``tangents``: with their derivatives by all parameters."""
    system, batch, per = problem.system, problem.batch, problem.shape.per
    assert isinstance(system, Traffic)
    lane = lanes.supports(system, batch)
    assert lane is not None
    names = list(lane.owned)

    def forward() -> Tensor:
        with torch.no_grad():
            return lanes.simulate(system, lane, batch, per)[:, 0, ..., 0]

    def tangents() -> Tensor:
        return lanes.tangents(system, lane, batch, per, names)[1][..., 0]

    return {"forward": forward, "tangents": tangents}


def check(problem: Problem) -> float:
    """The largest relative deviation of the tangents from the gradient, in float64.

    The derivative of a random sum of positions is compared: reverse mode and forward mode share no
    code but the formula.

    Raises:
        SimulationError: the deviation is too large.
    """
    exact = pose(problem.shape, problem.model, torch.float64)
    system, batch = exact.system, exact.batch
    lane = lanes.supports(system, batch)
    assert lane is not None
    x = lanes.simulate(system, lane, batch, problem.shape.per)[:, 0, ..., 0]
    weight = torch.randn(x.shape, generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    gradient = torch.stack(torch.autograd.grad((weight * x).sum(), list(system.parameters())))
    forward = (calls(exact)["tangents"]() * weight).sum((1, 2, 3))
    away = float(((forward - gradient).abs() / gradient.abs().clamp(min=1e-9)).max())
    if not away <= _AGREE:
        raise SimulationError(
            f"tangents of {problem.label} differ from the gradient by {away:.3g}, at most "
            f"{_AGREE:g} is expected; this problem was not timed"
        )
    return away
