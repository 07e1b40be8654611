"""Calibration of a model to an engine's residuals, all its derivatives from one simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy import stats
from scipy.sparse import csr_array

from nnode.calibrate.least_squares import box_step
from nnode.calibrate.parameters import ParameterVector
from nnode.discover.residuals.engine import Engine
from nnode.errors import SimulationError
from nnode.model.system import System

if TYPE_CHECKING:
    from nnode.discover.residuals.variables import Curves

#: Dampings that are tried side by side, relative to the curvature.
DAMPINGS = (1e-6, 1e-2, 1.0, 30.0)

#: Singular values of scaled tangents below this share of the largest one say nothing.
COLLINEAR = 1e-4
#: A share of the knowledge of a parameter that is none, but for rounding.
UNKNOWN = 1e-9
#: From this share on, a direction that is not known makes a parameter unknown.
APIECE = 1e-6

#: Tolerance of calibrations whose result is compared with others that are far off, and with
#: others that are near.
ROUGH, FINE = 1e-3, 1e-6


#: Shares ``(M,)`` of knowledge, directions ``(F, M)``, and where they are pulled.
_Others = tuple[np.ndarray, np.ndarray, np.ndarray]


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
        curves: what a deviation depends on, once that was asked for.
        simulated: ``(K,)`` standard errors of a correction by simulations; None without one.
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

    def left_out(self, cluster: np.ndarray, least: float) -> np.ndarray:
        """``(G, F)`` how the free parameters move when each cluster is left out of the fit.

        One Gauss and Newton step from the full fit. A direction of the parameters stays where the
        other clusters know less than the share ``least`` of what all know of it.
        """
        return _moved(self._others(cluster), least)

    def _others(self, cluster: np.ndarray) -> list[_Others]:
        """What is known without each cluster: directions ``(F, M)`` of the free parameters, the
        share ``(M,)`` of the knowledge of each that the others have, and where they pull it."""
        columns = self.tangents
        scale = np.sqrt((columns**2).sum(0))
        # an orthonormal basis: what the others know of a direction is then a share of the whole
        basis, size, turn = np.linalg.svd(columns / scale, full_matrices=False)
        kept = size > COLLINEAR * size[0]
        basis, back = basis[:, kept], (turn[kept] / size[kept, None] / scale).T
        found = []
        for rows in members(cluster):
            part, residual = basis[rows], self.residual[rows]
            known, vector = np.linalg.eigh(np.eye(part.shape[1]) - part.T @ part)
            # at the minimum the gradient of the others is minus that of this cluster
            found.append((known, back @ vector, vector.T @ (part.T @ residual)))
        return found

    def errors(self, cluster: np.ndarray) -> np.ndarray:
        """``(K,)`` standard errors that allow for any dependence within a cluster.

        By the jackknife over clusters. NaN for parameters at a bound, for those of which one
        cluster alone tells, and where there are fewer than three clusters.

        Source: MacKinnon, Nielsen & Webb 2023, Journal of Econometrics 232 (CV3).
        """
        found = np.full(len(self.row), np.nan)
        number = len(np.unique(cluster))
        if number >= 3 and self.free.any():
            parts = self._others(cluster)
            own = np.sqrt((number - 1) / number * (_moved(parts, UNKNOWN) ** 2).sum(0))
            for known, ways, _ in parts:
                share = ways**2 / np.maximum((ways**2).sum(1, keepdims=True), 1e-300)
                own[share[:, known <= UNKNOWN].sum(1) > APIECE] = np.nan
            found[self.free] = own
        return found if self.simulated is None else np.hypot(found, self.simulated)

    def intervals(self, cluster: np.ndarray, level: float = 0.95) -> np.ndarray:
        """``(K, 2)`` confidence intervals: :meth:`errors` with Student's quantile."""
        number = len(np.unique(cluster))
        half = stats.t.ppf(0.5 + level / 2, max(number - 1, 1)) * self.errors(cluster)
        return np.stack([self.row - half, self.row + half], 1)


def _moved(parts: list[_Others], least: float) -> np.ndarray:
    """``(G, F)``: see :meth:`Fit.left_out`."""
    return np.stack(
        [
            ways @ np.where(known > least, pull / np.maximum(known, least), 0.0)
            for known, ways, pull in parts
        ]
    )


def sums(values: np.ndarray, label: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """``(G, ...)`` sums of ``values`` ``(n, ...)`` over the rows of each label 0 ... G - 1, each
    times its ``weight`` ``(n,)``."""
    number, count = int(label.max()) + 1, len(label)
    weight = np.ones(count) if weight is None else weight
    member = csr_array((weight, (label, np.arange(count))), (number, count))
    found: np.ndarray = member @ values
    return found


def members(label: np.ndarray) -> list[np.ndarray]:
    """The rows of each label 0 ... G - 1, in their order."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label))[:-1])


def grams(z: np.ndarray, label: np.ndarray) -> np.ndarray:
    """``(G, k, k)`` products of the columns ``(n, k)`` with each other over each label's rows."""
    return np.stack([z[rows].T @ z[rows] for rows in members(label)])


class _Linear:
    """Residuals and their derivatives; derivatives come with the first of several trials."""

    def __init__(self, engine: Engine, system: System) -> None:
        self.engine, self.system = engine, system
        self.low, self.high = ParameterVector(system).bounds

    def at(self, trials: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals ``(T, n)`` of all trials ``(T, K)``, derivatives ``(n, K)`` at the first.

        The derivatives are zero where the first trial blows up.
        """
        found = self.engine.residuals(self.system, torch.from_numpy(trials)).numpy()
        if not np.isfinite(found[0]).all():
            return found, np.zeros((found.shape[1], trials.shape[1]))
        return found, self.engine.tangents(self.system, torch.from_numpy(trials[0])).numpy().T


def refine(
    engine: Engine,
    system: System,
    *,
    steps: int = 15,
    tolerance: float = 1e-4,
    hopeless: float = 0.0,
) -> Fit:
    """Levenberg and Marquardt's method from the system's own parameters, within their bounds.

    Args:
        steps: simulations of all trials and derivatives at most.
        tolerance: ends when a step lowers the cost by less than this share.
        hopeless: ends as soon as the cost has nearly stopped to fall (by less than a tenth of
            what is missing) and is still above this one.

    Raises:
        SimulationError: the start cannot be simulated.
    """
    linear = _Linear(engine, system)
    low, high = linear.low, linear.high
    row = np.clip(ParameterVector(system).row.numpy(), low, high)
    found, jacobian = linear.at(row[None])
    residual = found[0]
    if not np.isfinite(residual).all():
        raise SimulationError(
            "the model blows up on these data at its present parameters; start from others"
        )
    first = 0
    for _ in range(steps):
        cost = float(residual @ residual)
        gradient, curvature = jacobian.T @ residual, jacobian.T @ jacobian
        dampings = DAMPINGS[first:] + DAMPINGS[:first]
        trials = np.stack([box_step(row, gradient, curvature, d, low, high) for d in dampings])
        found, ahead = linear.at(trials)
        costs = np.where(np.isfinite(found).all(1), (found**2).sum(1), np.inf)
        best = int(np.argmin(costs))
        if not costs[best] < cost:
            break
        gained = cost - costs[best]
        row, residual = trials[best], found[best]
        # the trial that was best is tried first, with its derivatives, from now on
        first = (first + best) % len(DAMPINGS)
        small = gained < tolerance * cost
        if small or (costs[best] > hopeless > 0 and gained < 0.1 * (costs[best] - hopeless)):
            if best == 0:
                jacobian = ahead
            break
        jacobian = ahead if best == 0 else linear.at(row[None])[1]
    ParameterVector(system).fill_(torch.from_numpy(row))
    return _fit(system, row, residual, jacobian, low, high)


def evaluated(engine: Engine, system: System) -> Fit:
    """A model as it is, in the residuals of an engine."""
    linear = _Linear(engine, system)
    row = ParameterVector(system).row.numpy()
    found, jacobian = linear.at(row[None])
    return _fit(system, row, found[0], jacobian, linear.low, linear.high)


def _fit(
    system: System,
    row: np.ndarray,
    residual: np.ndarray,
    jacobian: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> Fit:
    gradient = jacobian.T @ residual
    at_low, at_high = (row <= low) & (gradient > 0), (row >= high) & (gradient < 0)
    moves = (jacobian**2).sum(0) > 0
    return Fit(
        system, ParameterVector(system).names, row, residual, jacobian, ~(at_low | at_high) & moves
    )
