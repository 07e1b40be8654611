"""Gauss and Newton's method as an optimiser of the training loop, one damped step at a time."""

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
    """A damped step of Gauss and Newton's, refused steps with more damping.

    Derivatives are exact tangents of lanes, and differences of people.

    It is told by :meth:`attach` what is minimised, in place of a closure.

    Args:
        system: the model; its calibrated parameters are changed in place.
        damping: of the first step, relative to the curvature of each parameter.
        tolerance: it has converged when a step lowers the cost by less than this share.

    Attributes:
        converged: whether no step lowers the cost any more.

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
        """Say what the next step lowers.

        Raises:
            ConfigError: another solver than the compiled one, or a model that is no formula.
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
        self._problem.last_speeds = self.started(batch).v[0, ..., 0].double().numpy()
        if self._problem.lane is None and not self._problem.physical.all():
            raise ConfigError(
                "optimizer=gauss_newton needs a model of people whose terms are formulas without "
                "networks, as model=sf; take another optimizer"
            )

    def started(self, batch: Batch) -> Batch:
        """A batch with the first speeds that were fitted to its sequences, if any were."""
        known = self.param_groups[0]["starts"]
        if not known:
            return batch
        v = batch.v.clone()
        for b, name in enumerate(batch.names):
            own = known.get(name, [])
            v[0, b, : len(own), 0] = v.new_tensor(own)
        return replace(batch, v=v)

    def step(self, closure: Callable[[], Any] | None = None) -> float:  # type: ignore[override]
        """Take a step; returns the mean cost before it.

        Raises:
            SimulationError: the model cannot be simulated with its present parameters.
        """
        from nnode.calibrate.problem import pooled

        problem, group = self._problem, self.param_groups[0]
        vector = ParameterVector(self.system, problem.vector.places)
        row = np.clip(vector.row.numpy(), problem.low, problem.high)
        if not group.get("begun", True):  # states of earlier versions have begun
            row, group["begun"] = problem.begin(row), True
        found = pooled(problem, row, steps=1, damping=group["damping"])
        now, value = float(found.before[0]), float(found.cost)
        if not math.isfinite(now):
            problem.complain(problem.costs(row))
        vector.fill_(found.row)
        if value < now:
            group["damping"] = float(found.damping[0])
        group["starts"] = problem.start_speeds(found.row)
        group["converged"] = not now - value > self.tolerance * now
        return now
