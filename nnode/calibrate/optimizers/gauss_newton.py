"""The Gauss-Newton method as an optimiser of the training loop, one damped step at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from torch.optim import Optimizer

from nnode.calibrate.cost import Convention
from nnode.calibrate.options import StartSpeeds
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Batch
from nnode.errors import ConfigError
from nnode.model.system import System
from nnode.simulation.base import Solver


class GaussNewton(Optimizer):
    """The damped Gauss-Newton method (Levenberg-Marquardt).

    Derivatives are exact tangents for lanes, and difference quotients for people. :meth:`attach`
    defines the cost in place of a closure.

    Args:
        system: the model, whose calibrated parameters are changed in place.
        damping: damping of the first step, relative to the curvature of each parameter.
        tolerance: the method has converged when a step lowers the cost by less than this share.

    Attributes:
        converged: whether the last step lowered the cost by less than the tolerance.

    Source:
        Nocedal & Wright, Numerical Optimization, 2nd ed., section 10.3.
    """

    def __init__(self, system: System, damping: float = 1e-3, tolerance: float = 1e-9) -> None:
        if not damping > 0:
            raise ValueError(f"damping={damping} must be positive")
        if not tolerance >= 0:
            raise ValueError(f"tolerance={tolerance} must not be negative")
        trained = [p for p in system.parameters() if p.requires_grad]
        first = {"damping": damping, "converged": False, "starts": {}, "begun": False}
        super().__init__(trained, first)
        self.system, self.tolerance = system, tolerance
        self._problem: Any = None
        self._batch: Batch | None = None

    @property
    def converged(self) -> bool:
        return bool(self.param_groups[0]["converged"])

    def attach(
        self,
        solver: Solver,
        batch: Batch,
        convention: Convention,
        starts: StartSpeeds = StartSpeeds.given,
    ) -> None:
        """Define the cost of the next step.

        Raises:
            ConfigError: the solver is not the compiled one, or the model is not a formula.
        """
        if self._batch is batch:
            return
        self._batch = batch
        # compiled code takes a second to import
        from nnode.calibrate.problem import ResidualProblem
        from nnode.simulation.fused import FusedSolver

        if not isinstance(solver, FusedSolver):
            raise ConfigError("optimizer=gauss_newton needs solver=fused, which has exact tangents")
        self._problem = ResidualProblem(self.system, batch, solver, convention, starts)
        self._problem.last_speeds = self.with_start_speeds(batch).v[0, ..., 0].double().numpy()
        if self._problem.lane is None and not self._problem.physical.all():
            raise ConfigError(
                "optimizer=gauss_newton needs a model of people whose terms are formulas without "
                "networks, as model=sf; take another optimizer"
            )

    def with_start_speeds(self, batch: Batch) -> Batch:
        """A batch with the fitted first speeds of its sequences, if there are any."""
        start_speeds = self.param_groups[0]["starts"]
        if not start_speeds:
            return batch
        v = batch.v.clone()
        for b, name in enumerate(batch.names):
            speeds = start_speeds.get(name, [])
            v[0, b, : len(speeds), 0] = v.new_tensor(speeds)
        return replace(batch, v=v)

    def step(self, closure: Callable[[], Any] | None = None) -> float:  # type: ignore[override]
        """Take a step, and return the mean cost before it.

        Raises:
            SimulationError: the model cannot be simulated with its present parameters.
        """
        from nnode.calibrate.problem import pooled

        problem, group = self._problem, self.param_groups[0]
        vector = ParameterVector(self.system, problem.vector.places)
        row = np.clip(vector.row.numpy(), problem.low, problem.high)
        if not group.get("begun", True):  # checkpoints without the key are past this fit
            row, group["begun"] = problem.initial_fit(row), True
        minimum = pooled(problem, row, steps=1, damping=group["damping"])
        before, value = float(minimum.before[0]), float(minimum.cost)
        if not math.isfinite(before):
            problem.raise_blow_up(problem.costs(row))
        vector.fill_(minimum.row)
        if value < before:
            group["damping"] = float(minimum.damping[0])
        group["starts"] = problem.start_speeds(minimum.row)
        group["converged"] = not before - value > self.tolerance * before
        return before
