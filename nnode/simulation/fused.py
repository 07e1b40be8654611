"""The fused solver, which computes all steps of a simulation and its gradient in compiled code."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.errors import ConfigError, unknown_value
from nnode.model.steps import METHODS
from nnode.model.system import System, with_parameters
from nnode.simulation.base import (
    Trajectory,
    check_finite,
    observed,
    simulated_batch,
    substeps,
)
from nnode.simulation.kernels import crowds, lanes
from nnode.simulation.ode import TorchdiffeqSolver

log = logging.getLogger(__name__)


class FusedSolver:
    """A fixed-step method with the exact gradient of its discrete scheme, in compiled code.

    With ``method="euler"``, the default for laws of first order, states equal those of
    ``TorchdiffeqSolver("euler")`` up to rounding. In float32, traffic states are closer to the
    float64 states, because steps are added with compensation. The gradient is that of
    ``TorchdiffeqSolver("euler", "discrete")``. It differs by O(dt) from the paper's continuous
    adjoint. ``rk4`` is the classic Runge-Kutta method; torchdiffeq's ``rk4`` is the 3/8 rule, from
    which it differs by O(dt^4).

    Compiled code covers models whose law and effects are formulas (see
    :mod:`nnode.model.terms`). A model with a term that is PyTorch code runs by torchdiffeq, which
    gives the same gradient at the speed and with the memory of PyTorch. The solver warns once.

    The first call for a law compiles (seconds) and stores the result in the user's cache folder,
    or in the folder of the environment variable NNODE_CACHE.

    Args:
        dt: step, s; None takes the domain's default, as TorchdiffeqSolver.
        threads: largest number of threads for blocks of simulations.
        cutoff: in crowds, distance (m) beyond which people do not interact with each other and
            with wall points. It must be larger than the distance 2 r of people who touch. For a
            force network it changes the model, because such a force need not decay. None derives
            it from ``cutoff_error`` for social forces of many people, and otherwise computes all
            pairs.
        cutoff_error: without a ``cutoff``, the largest omitted social force of one partner, in
            units of A. The error of a person's acceleration is then below ``cutoff_error`` A / m
            through people, and as much through walls; see
            :func:`nnode.simulation.kernels.crowds.cutoff_distance`. 0 computes all pairs.
        method: for lanes, one of :data:`nnode.model.steps.METHODS`. None takes the law's method,
            ``rk4`` for smooth laws, or else ``ballistic`` for accelerations and ``euler`` for
            speeds.

    Attributes:
        uncompiled: why the model of the warning is not compiled; empty without a warning.

    Raises:
        ConfigError: fewer than one thread, a cutoff that is not positive, or an error outside
            [0, 1).
    """

    def __init__(
        self,
        dt: float | None = None,
        threads: int = 1,
        cutoff: float | None = None,
        cutoff_error: float = 1e-10,
        method: str | None = None,
    ) -> None:
        if threads < 1:
            raise ConfigError(f"solver.threads={threads} must be a whole number of at least 1")
        if method is not None and method not in METHODS:
            raise unknown_value(
                "solver=fused solver.method", method, METHODS, ", or null for the law's own"
            )
        crowds.check_cutoff(cutoff, cutoff_error)
        self.dt, self.threads = dt, threads
        self.cutoff, self.cutoff_error = cutoff, cutoff_error
        self.method, self.uncompiled = method, ""

    def __call__(self, system: System, batch: Batch) -> Trajectory:
        """Simulate from the first measured state, at the batch's sampling times.

        Raises:
            ConfigError: a step that does not divide the sampling interval, or a cutoff for a
                model that cannot have one.
            DataError: the batch is of another domain, or has no sampling interval.
            SimulationError: a simulated state is not a finite number.
        """
        return check_finite(self.unchecked(system, batch), batch)

    def unchecked(self, system: System, batch: Batch) -> Trajectory:
        """Simulate without the check that states are finite."""
        n, near, origin = self._prepare(system, batch)
        lane, law = lanes.supports(system, batch), crowds.supports(system, batch)
        if lane is not None:
            y = lanes.simulate(system, lane, near, n, self.threads, method=self.method)[:, 0]
        elif law is not None:
            y = crowds.simulate(system, law, near, n, self.threads, self.cutoff, self.cutoff_error)
        else:
            # relaxation without interactions is a cheap baseline
            if not self.uncompiled and not crowds.without_partners(system):
                self.uncompiled = _reason(system)
                log.warning(
                    "solver=fused works in PyTorch and not in compiled code: %s; the gradient is "
                    "the same, but costs up to hundreds of times as much, see docs/performance.md",
                    self.uncompiled,
                )
            return TorchdiffeqSolver(self.method, "discrete", self.dt).solve(system, batch)
        return observed(system, y, batch, origin)

    def ensemble(
        self, system: System, parameters: Mapping[str, Tensor], batch: Batch
    ) -> Trajectory:
        """Simulate R runs with separate parameters at the same time.

        A run that blows up keeps its non-finite states and does not affect other runs.

        Args:
            parameters: name in ``system.named_parameters()`` to values with a leading axis of R
                runs; the trajectory is differentiable with respect to them. Missing parameters
                have the system's values in all runs.

        Returns:
            x and v of shape ``(K, R, B, N, D)``.

        Raises:
            ConfigError: as in a single run; an unknown name; or shapes that do not fit.
            DataError: as in a single run.
        """
        stacked = _stack(system, parameters)
        lane = lanes.supports(system, batch)
        if lane is None:
            runs = [
                self.unchecked(
                    with_parameters(system, {name: value[r] for name, value in stacked.items()}),
                    batch,
                )
                for r in range(len(next(iter(stacked.values()))))
            ]
        else:
            n, near, origin = self._prepare(system, batch)
            y = lanes.simulate(system, lane, near, n, self.threads, stacked, self.method)
            runs = [observed(system, states, batch, origin) for states in y.unbind(1)]
        v = [run.v for run in runs if run.v is not None]
        return Trajectory(torch.stack([run.x for run in runs], 1), torch.stack(v, 1) if v else None)

    def _prepare(self, system: System, batch: Batch) -> tuple[int, Batch, Tensor | None]:
        """Steps in a sampling interval, the simulated batch, and the origins of its positions."""
        if batch.x.shape[-1] != system.dim:
            system.scene(batch)  # raises the error
        if self.cutoff is not None and not (
            crowds.supports(system, batch) or crowds.without_partners(system)
        ):
            raise ConfigError(
                f"solver.cutoff={self.cutoff:g} m works for crowds whose terms are formulas, as "
                "model=sf or model=nn, only; set it to null"
            )
        return substeps(batch.dt, self.dt, system), *simulated_batch(system, batch)


def _reason(system: System) -> str:
    """Why compiled code is not used: the names of terms that it does not cover."""
    terms = system.term_list
    names = ", ".join(t.name for t in terms if t.rule_for(system.order) is None)
    if names:
        return f"it does not cover {names}"
    alone = "models that begin with a law of the gap, without people who meet themselves and others"
    return f"it covers {alone} on the CPU, without a gradient by what was measured"


def _stack(system: System, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """All parameters of the system with a leading axis of runs."""
    defaults = dict(system.named_parameters())
    unknown = sorted(set(parameters) - set(defaults))
    if unknown or not parameters:
        raise ConfigError(
            f"an ensemble needs parameters of the model, found {unknown or 'none'}; the model "
            f"has: {', '.join(defaults)}"
        )
    runs = {len(value) if value.ndim else 0 for value in parameters.values()}
    for name, value in parameters.items():
        shape = defaults[name].shape
        if len(runs) > 1 or value.shape[1:] != shape or 0 in runs:
            raise ConfigError(
                f"{name} of an ensemble must have shape (R, {', '.join(map(str, shape))})"
                f" with the same R >= 1 for all parameters, found {tuple(value.shape)}"
            )
    number = runs.pop()
    return {
        name: parameters[name] if name in parameters else value.expand(number, *value.shape)
        for name, value in defaults.items()
    }
