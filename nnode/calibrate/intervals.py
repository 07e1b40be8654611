"""Cluster-robust confidence intervals of least-squares estimates."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.special import stdtrit

from nnode.calibrate.problem import ResidualProblem

#: Level of intervals.
LEVEL = 0.95
#: A parameter is not identified if its interval is wider than this share of the admissible set, or
#: as wide as the absolute value if the set is unbounded.
VAGUE = 0.5
#: A direction of the parameters is flat if its scaled curvature is below this share of the largest
#: one. It depends on a single cluster if the share of the others is below the second number.
FLAT, UNKNOWN = 1e-8, 1e-9
#: A parameter has no finite variance if its unit vector has such a share in flat directions, or in
#: directions that depend on a single cluster. Rounding errors are at most 1e-5 and 1e-9.
FLAT_PART, ALONE_PART = 1e-3, 1e-6


class ClusterInfluence:
    """The contributions of G clusters to least-squares estimates of P parameters.

    X are the derivatives of the residuals r at the minimum, and M is the inverse of X'X. In the
    orthonormal coordinates M^(-1/2) p of the parameters p, the clusters' shares
    K_g = M^(1/2) X_g'X_g M^(1/2) sum to the identity.

    Args:
        grams: ``(G, P, P)`` X_g'X_g.
        scores: ``(G, P)`` X_g'r_g.

    Attributes:
        flat: ``(P,)`` True for parameters in directions on which the residuals do not depend.
    """

    def __init__(self, grams: np.ndarray, scores: np.ndarray) -> None:
        total = grams.sum(0)
        scale = np.sqrt(np.maximum(np.diag(total), 1e-300))
        values, vectors = np.linalg.eigh(total / np.outer(scale, scale))
        kept = values > FLAT * values.max(initial=0.0)
        self.flat = (vectors[:, ~kept] ** 2).sum(1) > FLAT_PART
        self._back = vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None]
        self._share = self._back.T @ grams @ self._back
        others_share = np.eye(len(self._back.T)) - self._share
        self._others, self._ways = np.linalg.eigh(others_share)
        self._scores = scores @ self._back

    def moved(self, power: float, min_share: float = UNKNOWN) -> np.ndarray:
        """``(G, P)`` changes of the estimates by each cluster.

        With power 1 they are the changes by omitting the cluster, to first order (one Gauss-Newton
        step). Directions in which the other clusters' share is below ``min_share`` do not change.
        """
        return self._weighted(power, self._scores[..., None], min_share)[..., 0] @ self._back.T

    def covariance(self, power: float = 0.5) -> np.ndarray:
        """``(P, P)`` covariance CR2, unbiased for independent residuals of equal variance.

        The variance of parameters that depend on a single cluster is infinite.

        Args:
            power: 1 gives the jackknife covariance (CV3), which is too large on average.

        Source:
            Bell & McCaffrey 2002, Survey Methodology 28; Pustejovsky & Tipton 2018, Journal of
            Business & Economic Statistics 36; MacKinnon, Nielsen & Webb 2023, Journal of
            Econometrics 232.
        """
        changes, number = self.moved(power), len(self._scores)
        covariance: np.ndarray = changes.T @ changes * (1.0 if power < 1 else (number - 1) / number)
        parts = (self._back @ self._ways) ** 2
        alone = (parts * (self._others <= UNKNOWN)[:, None]).sum(2)
        undetermined = np.flatnonzero(
            (alone > ALONE_PART * np.maximum(parts.sum(2), 1e-300)).any(0)
        )
        covariance[undetermined, undetermined] = math.inf
        return covariance

    def degrees(self) -> np.ndarray:
        """``(P,)`` Satterthwaite's degrees of freedom of the variances, at least 1.

        They are those of a scaled chi-squared distribution with the mean and the variance that the
        estimated variance has for independent residuals of equal variance.
        """
        back = np.broadcast_to(self._back.T, self._share.shape[:1] + self._back.T.shape)
        weighted = self._weighted(0.0, back, UNKNOWN)
        within = np.einsum("mp,gmn,gnp->gp", self._back.T, self._share, weighted)
        adjusted = self._share @ self._weighted(0.5, back, UNKNOWN)
        products = np.einsum("gmp,gnp->pmn", adjusted, adjusted)
        square = (adjusted**2).sum(1)
        total = (within**2 - square**2).sum(0) + (products**2).sum((1, 2))
        return np.maximum(within.sum(0) ** 2 / np.maximum(total, 1e-300), 1.0)

    def standard_errors(self) -> np.ndarray:
        """``(P,)`` standard errors; infinite for flat parameters."""
        return np.where(self.flat, math.inf, np.sqrt(np.diag(self.covariance())))

    def correlation(self) -> np.ndarray:
        """``(P, P)`` correlation of the estimates; NaN for flat parameters."""
        error = self.standard_errors()
        spread = np.where((error > 0) & np.isfinite(error), error, np.nan)
        correlation: np.ndarray = self.covariance() / np.outer(spread, spread)
        return correlation

    def half_widths(self) -> np.ndarray:
        """``(P,)`` half the width of confidence intervals of :data:`LEVEL` by Student's quantiles;
        infinite for flat parameters."""
        widths: np.ndarray = stdtrit(self.degrees(), 0.5 + LEVEL / 2) * self.standard_errors()
        return widths

    def _weighted(self, power: float, vectors: np.ndarray, min_share: float) -> np.ndarray:
        """``(I - K_g)^(-power)`` times vectors ``(G, M, n)``."""
        factor = np.where(
            self._others > min_share, np.maximum(self._others, min_share) ** -power, 0.0
        )
        rotated = self._ways.transpose(0, 2, 1) @ vectors
        return self._ways @ (factor[..., None] * rotated)


def influence(
    problem: ResidualProblem, row: np.ndarray, cluster: np.ndarray, free: np.ndarray
) -> ClusterInfluence:
    """The influence of clusters of sequences on pooled parameters.

    Args:
        row: ``(P,)`` parameters at the minimum.
        cluster: ``(B,)`` the cluster of every sequence.
        free: ``(P,)`` True for parameters that are not at a bound; others are excluded.
    """
    each = problem(row)
    member = (np.unique(cluster)[:, None] == cluster) / len(cluster)
    grams, scores = (np.tensordot(member, part, 1) for part in (each.hessian, each.gradient))
    return ClusterInfluence(grams[:, free][:, :, free], scores[:, free])


def at_bounds(row: Any, low: Any, high: Any, near: Any = None) -> np.ndarray:
    """``(P,)`` ``low`` or ``high`` for parameters at a bound, and an empty text for others.

    Args:
        row, low, high: ``(P,)`` parameters, and the bounds of the admissible set.
        near: largest distance from the bound; None is a rounding error of the parameters.
    """
    near = 1e-6 * (1 + np.abs(row)) if near is None else near
    return np.where(row <= low + near, "low", np.where(row >= high - near, "high", ""))


def intervals(problem: ResidualProblem, row: np.ndarray, cluster: np.ndarray) -> dict[str, Any]:
    """Confidence intervals of calibrated parameters, without weights of networks.

    A parameter at a bound has no interval. The intervals of other parameters are conditional on
    it being there.

    Args:
        row: ``(P,)`` parameters at the minimum.
        cluster: ``(B,)`` the cluster of every sequence.

    Returns:
        ``parameters``: address to ``value``, ``low``, ``high``, ``std_error``, the degrees of
        freedom ``df``, ``at_bound`` and ``identified``, which is None if there is one cluster and
        the cost depends on the parameter;
        ``correlation``: address to address to correlation;
        ``clusters``: their number.
    """
    bound = at_bounds(row, problem.low, problem.high)
    free = bound == ""
    clusters, number = influence(problem, row, cluster, free), len(np.unique(cluster))
    half, undetermined = np.zeros(len(row)), ~free
    error, degrees = half.copy(), half.copy()
    half[free], error[free] = clusters.half_widths(), clusters.standard_errors()
    degrees[free] = clusters.degrees()
    # with one cluster, only parameters without any effect on the cost are known to be undetermined
    undetermined[free] = clusters.flat | (len(problem.batch) < 2)
    parameters: dict[str, Any] = {}
    for i in np.flatnonzero(problem.physical):
        has_interval = bool(free[i] and np.isfinite(half[i]))
        width = problem.high[i] - problem.low[i]
        scale = VAGUE * width if np.isfinite(width) else abs(row[i])
        parameters[problem.names[i]] = {
            "value": float(row[i]),
            "low": float(max(row[i] - half[i], problem.low[i])) if has_interval else None,
            "high": float(min(row[i] + half[i], problem.high[i])) if has_interval else None,
            "std_error": float(error[i]) if has_interval else None,
            "df": float(degrees[i]) if has_interval else None,
            "at_bound": str(bound[i]) or None,
            "identified": bool(has_interval and 2 * half[i] < scale)
            if number > 1 or undetermined[i]
            else None,
        }
    table = np.full((len(row), len(row)), np.nan)
    table[np.ix_(free, free)] = clusters.correlation()
    names = dict(zip(problem.names, table, strict=True))
    correlation = {
        name: {
            other: round(float(r), 4) if np.isfinite(r) else None
            for other, r in zip(problem.names, names[name], strict=True)
            if other in parameters
        }
        for name in parameters
    }
    return {"parameters": parameters, "correlation": correlation, "clusters": number}
