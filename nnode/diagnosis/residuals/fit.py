"""Calibration of a model to an engine's residuals, all its derivatives from one simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy import stats

from nnode.calibrate.intervals import LEVEL, ClusterInfluence
from nnode.calibrate.least_squares import Quadratic, least_squares
from nnode.calibrate.parameters import ParameterVector
from nnode.data.clusters import group_sums
from nnode.diagnosis.residuals.engine import Engine
from nnode.errors import SimulationError
from nnode.model.system import System

if TYPE_CHECKING:
    from nnode.diagnosis.residuals.variables import Curves

#: Dampings that are tried in parallel, relative to the curvature.
DAMPINGS = (1e-6, 1e-2, 1.0, 30.0)
#: Tolerance of calibrations that are compared with very different ones, and with similar ones.
ROUGH, FINE = 1e-3, 1e-6


@dataclass
class Fit:
    """A calibrated model in the residuals of an engine.

    Attributes:
        system: the model, with the parameters of the fit.
        names: of the K parameters, as in ``system.named_parameters()``.
        row: ``(K,)`` parameters.
        residual: ``(n,)``.
        jacobian: ``(n, K)`` derivatives of the residuals.
        free: ``(K,)`` False where a parameter is held at a bound.
        curves: curves in the residuals, once they were computed.
        simulated: ``(K,)`` standard errors of a bias correction by simulation; None without one.
    """

    system: System
    names: list[str]
    row: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    free: np.ndarray
    curves: list[Curves] | None = None
    simulated: np.ndarray | None = None

    @property
    def cost(self) -> float:
        """Sum of squared residuals."""
        return float(self.residual @ self.residual)

    @property
    def tangents(self) -> np.ndarray:
        """``(n, F)`` derivatives with respect to the parameters that are free."""
        return self.jacobian[:, self.free]

    def influence(self, cluster: np.ndarray) -> ClusterInfluence:
        """The influence of the clusters on the free parameters."""
        columns = self.tangents
        scores = group_sums(columns * self.residual[:, None], cluster)
        return ClusterInfluence(grams(columns, cluster), scores)

    def errors(self, cluster: np.ndarray, power: float = 1.0) -> np.ndarray:
        """``(K,)`` standard errors that allow for any dependence within a cluster, by the
        jackknife.

        NaN for parameters at a bound, for those that only one cluster identifies, and with fewer
        than three clusters.

        Args:
            power: see :meth:`~nnode.calibrate.intervals.ClusterInfluence.covariance`.
        """
        return self._errors(self.influence(cluster), cluster, power)

    def _errors(self, influence: ClusterInfluence, cluster: np.ndarray, power: float) -> np.ndarray:
        errors = np.full(len(self.row), np.nan)
        if len(np.unique(cluster)) >= 3 and self.free.any():
            variance = np.diag(influence.covariance(power))
            errors[self.free] = np.sqrt(np.where(np.isfinite(variance), variance, np.nan))
        return errors if self.simulated is None else np.hypot(errors, self.simulated)

    def jackknife_intervals(self, cluster: np.ndarray, level: float = LEVEL) -> np.ndarray:
        """``(K, 2)`` conservative intervals that decide whether an effect is kept: :meth:`errors`
        with Student's quantiles by the number of clusters."""
        number = len(np.unique(cluster))
        half = stats.t.ppf(0.5 + level / 2, max(number - 1, 1)) * self.errors(cluster)
        return np.stack([self.row - half, self.row + half], 1)

    def intervals(self, cluster: np.ndarray, level: float = LEVEL) -> np.ndarray:
        """``(K, 2)`` confidence intervals, by CR2 with Satterthwaite's degrees of freedom; NaN
        as of :meth:`errors`."""
        influence = self.influence(cluster)
        half = self._errors(influence, cluster, 0.5)
        half[self.free] *= stats.t.ppf(0.5 + level / 2, influence.degrees())
        return np.stack([self.row - half, self.row + half], 1)


def members(label: np.ndarray) -> list[np.ndarray]:
    """The rows of each label 0 ... G - 1, in their order."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label))[:-1])


def grams(z: np.ndarray, label: np.ndarray) -> np.ndarray:
    """``(G, k, k)`` products of the columns ``(n, k)`` with each other over each label's rows."""
    return np.stack([z[rows].T @ z[rows] for rows in members(label)])


class _EngineProblem:
    """The residuals of an engine as a least-squares problem.

    The derivatives at the first trial parameters reuse its simulation.
    """

    def __init__(self, engine: Engine, system: System) -> None:
        self.engine, self.system = engine, system
        self.vector = ParameterVector(system)
        self.low, self.high = self.vector.bounds
        self._rows, self._residuals = np.empty((0, len(self.low))), np.empty((0, 0))
        self._fit: Fit | None = None

    def costs(self, trials: np.ndarray) -> np.ndarray:
        """``(T, 1)`` costs of trials ``(T, 1, K)``; inf if one diverges."""
        self._rows = trials[:, 0]
        self._residuals = self.engine.residuals(self.system, torch.from_numpy(self._rows)).numpy()
        finite = np.isfinite(self._residuals).all(1)
        return np.where(finite, (self._residuals**2).sum(1), np.inf)[:, None]

    def __call__(self, rows: np.ndarray) -> Quadratic:
        """Costs and their derivatives ``(1, ...)``.

        Raises:
            SimulationError: it cannot be simulated.
        """
        fit = self.fit(rows[0])
        if not np.isfinite(fit.residual).all():
            raise SimulationError(
                "the model blows up on these data at its present parameters; start from others"
            )
        gradient, curvature = fit.jacobian.T @ fit.residual, fit.jacobian.T @ fit.jacobian
        return Quadratic(np.array([fit.cost]), 2 * gradient[None], 2 * curvature[None])

    def fit(self, row: np.ndarray) -> Fit:
        """The model with parameters ``(K,)``; derivatives are zero if it diverges."""
        if self._fit is not None and np.array_equal(self._fit.row, row):
            return self._fit
        if not (self._rows == row).all(1).any():
            self.costs(row[None, None])
        residual = self._residuals[np.flatnonzero((self._rows == row).all(1))[0]]
        jacobian = np.zeros((len(residual), len(row)))
        if np.isfinite(residual).all():
            jacobian = self.engine.tangents(self.system, torch.from_numpy(row)).numpy().T
        gradient = jacobian.T @ residual
        pressed = ((row <= self.low) & (gradient > 0)) | ((row >= self.high) & (gradient < 0))
        free = ~pressed & ((jacobian**2).sum(0) > 0)
        self._fit = Fit(self.system, self.vector.names, row, residual, jacobian, free)
        return self._fit


def refine(
    engine: Engine,
    system: System,
    *,
    steps: int = 15,
    tolerance: float = 1e-4,
    hopeless: float = 0.0,
) -> Fit:
    """Calibrate from the system's own parameters, within their bounds.

    Args:
        steps: largest number of simulations of all trials and derivatives.
        tolerance: the search ends when a step lowers the cost by less than this share.
        hopeless: see :func:`~nnode.calibrate.least_squares.least_squares`.

    Raises:
        SimulationError: the start cannot be simulated.
    """
    problem = _EngineProblem(engine, system)
    solution = least_squares(
        problem,
        problem.costs,
        problem.vector.row.numpy()[None],
        problem.low,
        problem.high,
        steps=steps,
        tolerance=tolerance,
        dampings=DAMPINGS,
        hopeless=hopeless,
    )
    problem.vector.fill_(solution.row[0])
    return problem.fit(solution.row[0])


def evaluated(engine: Engine, system: System) -> Fit:
    """A model without calibration, in the residuals of an engine."""
    return _EngineProblem(engine, system).fit(ParameterVector(system).row.numpy())
