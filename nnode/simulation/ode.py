"""Solver by torchdiffeq, with the continuous adjoint or the discrete scheme's exact gradient."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torchdiffeq import odeint, odeint_adjoint
from torchdiffeq._impl.odeint import SOLVERS
from torchdiffeq._impl.solvers import FixedGridODESolver

from nnode.data.sequence import Batch
from nnode.errors import ConfigError, unknown_value
from nnode.model.steps import METHODS, STAGES
from nnode.model.system import System
from nnode.simulation.base import (
    Trajectory,
    check_finite,
    observed,
    simulated_batch,
    substeps,
)

FIXED_STEP = tuple(
    name for name, solver in SOLVERS.items() if issubclass(solver, FixedGridODESolver)
)
GRADIENTS = ("adjoint", "discrete")


def whole_steps(func: Any, y0: Tensor, t: Tensor) -> Tensor:
    """Time grid with one step per unit between the first and the last time, in either direction."""
    steps = torch.arange(round(float((t[-1] - t[0]).abs())) + 1)
    return t[0] + (t[-1] - t[0]).sign() * steps.to(t)


class Rates(nn.Module):
    """Change of the state in one step. Time is counted in steps, which is exact in any precision.

    A sequence that is shorter than its batch does not move after its end, so that it cannot blow
    up there and corrupt the gradient of the other sequences.

    Args:
        steps: number of steps in a sampling interval.
        method: method of stepping for laws of vehicles, see :mod:`nnode.model.steps`.
    """

    def __init__(self, system: System, batch: Batch, steps: int, method: str = "euler") -> None:
        super().__init__()
        self.system, self.dt = system, batch.dt / steps
        self.scene = replace(system.scene(batch), step=self.dt, method=method)
        last = batch.valid.any(-1).sum(0) - 1
        self.end = steps * last[:, None, None]
        self.ragged = bool((last < batch.n_samples - 1).any())

    def forward(self, step: Tensor, y: Tensor) -> Tensor:
        """``(B, N, order * D + M)``: change of ``y`` from ``step`` to the next step."""
        return self.until_the_end(step, self.dt * self.system(step * self.dt, y, self.scene))

    def until_the_end(self, step: Tensor, rate: Tensor) -> Tensor:
        """The change of the state, which is 0 for sequences that have ended."""
        # the last step is included, because the backward integration starts there
        return rate.where(step <= self.end, 0.0) if self.ragged else rate


class TorchdiffeqSolver:
    """Solve with torchdiffeq.

    The unit of time is the step, so that the grid consists of whole numbers and the number of
    steps is exact, also in float32. Only sampling times are outputs.

    Args:
        method: a torchdiffeq method, or ``ballistic`` or ``semi_implicit``, which are Euler's
            method on a changed formula (see :mod:`nnode.model.steps`). None takes the law's
            method, ``rk4`` for smooth laws, or else ``ballistic`` for accelerations of vehicles
            and ``euler`` for everything else. Fixed-step methods use ``dt``, adaptive methods
            ``rtol`` and ``atol``. torchdiffeq's ``rk4`` is the 3/8 rule.
        gradient: ``adjoint`` integrates the adjoint equation backwards (the continuous
            adjoint of the paper, discretised: differs from the exact gradient of the
            discrete scheme by O(dt)); ``discrete`` differentiates the scheme itself.
        dt: step, s; None takes the domain's default (0.002 s in traffic; at most 0.0625 s,
            dividing the sampling interval, in crowds).
        rtol: relative tolerance of adaptive methods.
        atol: absolute tolerance of adaptive methods, m and m/s.

    Raises:
        ConfigError: an unknown method or gradient, a method and a gradient that exclude each
            other, or tolerances that are not positive.
    """

    def __init__(
        self,
        method: str | None = None,
        gradient: str = "adjoint",
        dt: float | None = None,
        rtol: float = 1e-6,
        atol: float = 1e-8,
    ) -> None:
        if method is not None and method not in {*SOLVERS, *METHODS}:
            raise unknown_value("solver.method", method, sorted({*SOLVERS, *METHODS}))
        if gradient not in GRADIENTS:
            raise unknown_value("solver.gradient", gradient, GRADIENTS)
        if gradient == "discrete" and method == "scipy_solver":
            raise ConfigError(
                "solver.method=scipy_solver leaves no graph to differentiate; use "
                "solver.gradient=adjoint, or another method"
            )
        if not (rtol > 0 and atol > 0):
            raise ConfigError(f"solver.rtol={rtol} and solver.atol={atol} must be positive")
        self.method, self.gradient, self.dt = method, gradient, dt
        self.rtol, self.atol = rtol, atol

    def __call__(self, system: System, batch: Batch) -> Trajectory:
        """Simulate from the first measured state, at the batch's sampling times.

        Raises:
            SimulationError: a simulated state is not a finite number.
        """
        return check_finite(self.solve(system, batch), batch)

    def solve(self, system: System, batch: Batch) -> Trajectory:
        """Simulate without the check that states are finite."""
        n = substeps(batch.dt, self.dt, system)
        method = self.method or system.step
        near, origin = simulated_batch(system, batch)
        rates = Rates(system, near, n, method if method in METHODS else "euler")
        y0 = system.initial(near, batch.dt / n)
        t = n * torch.arange(batch.n_samples, dtype=y0.dtype, device=y0.device)
        method = STAGES.get(method, method)
        options = {"grid_constructor": whole_steps} if method in FIXED_STEP else {}
        kwargs: dict[str, Any] = {
            "method": method,
            "rtol": self.rtol,
            "atol": self.atol,
            "options": options,
        }
        trained = tuple(p for p in system.parameters() if p.requires_grad)
        if self.gradient == "adjoint" and trained and torch.is_grad_enabled():
            y = odeint_adjoint(rates, y0, t, adjoint_params=trained, **kwargs)
        else:
            y = odeint(rates, y0, t, **kwargs)
        return observed(system, y, batch, origin)
