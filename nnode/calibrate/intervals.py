"""How sure estimates of least squares are, by how clusters of the data differ."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.stats import t as students_t

from nnode.calibrate.problem import ResidualProblem

#: Level of intervals.
LEVEL = 0.95
#: An interval that is wider than this share of the admissible set does not identify a parameter,
#: and so does one as wide as the value itself where the set is open.
VAGUE = 0.5
#: A direction of the parameters is flat where the scaled curvature is this share of the largest
#: one, and a cluster alone tells of it where the others have this share of what all know.
FLAT, UNKNOWN = 1e-8, 1e-9
#: A parameter has no variance where its unit vector has such a share in directions that are flat,
#: or that one cluster alone tells of: rounding leaves 1e-5 and 1e-9 at most.
FLAT_PART, ALONE_PART = 1e-3, 1e-6


class ClusterInfluence:
    """What each of G clusters contributes to estimates of least squares of P parameters.

    With X the derivatives of the residuals r, linearised at the minimum, and M the inverse of
    X'X, the coordinates M^(-1/2) p of the parameters p are orthonormal: of each direction the
    clusters' shares K_g = M^(1/2) X_g'X_g M^(1/2) sum to one.

    Args:
        grams: ``(G, P, P)`` X_g'X_g.
        scores: ``(G, P)`` X_g'r_g.

    Attributes:
        flat: ``(P,)`` True for parameters that nothing depends on, alone or together with others.
    """

    def __init__(self, grams: np.ndarray, scores: np.ndarray) -> None:
        whole = grams.sum(0)
        scale = np.sqrt(np.maximum(np.diag(whole), 1e-300))
        values, vectors = np.linalg.eigh(whole / np.outer(scale, scale))
        kept = values > FLAT * values.max(initial=0.0)
        self.flat = (vectors[:, ~kept] ** 2).sum(1) > FLAT_PART
        self._back = vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None]
        self._share = self._back.T @ grams @ self._back
        rest = np.eye(len(self._back.T)) - self._share
        self._others, self._ways = np.linalg.eigh(rest)
        self._scores = scores @ self._back

    def moved(self, power: float, least: float = UNKNOWN) -> np.ndarray:
        """``(G, P)`` changes of the estimates by each cluster.

        With power 1 those that leaving it out makes, by a step of Gauss and Newton's. A direction
        stays where the other clusters know less than the share ``least`` of what all know.
        """
        return self._weighted(power, self._scores[..., None], least)[..., 0] @ self._back.T

    def covariance(self, power: float = 0.5) -> np.ndarray:
        """``(P, P)`` CR2: the mean is exact where residuals are independent and alike.

        The variance is infinite of parameters of which one cluster alone tells.

        Args:
            power: 1 gives the jackknife's (CV3), which is too large on average.

        Source:
            Bell & McCaffrey 2002, Survey Methodology 28; Pustejovsky & Tipton 2018, Journal of
            Business & Economic Statistics 36; MacKinnon, Nielsen & Webb 2023, Journal of
            Econometrics 232.
        """
        moved, number = self.moved(power), len(self._scores)
        found: np.ndarray = moved.T @ moved * (1.0 if power < 1 else (number - 1) / number)
        ways = (self._back @ self._ways) ** 2
        alone = (ways * (self._others <= UNKNOWN)[:, None]).sum(2)
        lost = np.flatnonzero((alone > ALONE_PART * np.maximum(ways.sum(2), 1e-300)).any(0))
        found[lost, lost] = math.inf
        return found

    def degrees(self) -> np.ndarray:
        """``(P,)`` Satterthwaite's degrees of freedom of the variances, at least 1.

        They are those of a multiple of chi squared with the variance's mean and variance, were
        residuals independent and alike.
        """
        back = np.broadcast_to(self._back.T, self._share.shape[:1] + self._back.T.shape)
        known = self._weighted(0.0, back, UNKNOWN)
        own = np.einsum("mp,gmn,gnp->gp", self._back.T, self._share, known)
        adjusted = self._share @ self._weighted(0.5, back, UNKNOWN)
        products = np.einsum("gmp,gnp->pmn", adjusted, adjusted)
        square = (adjusted**2).sum(1)
        total = (own**2 - square**2).sum(0) + (products**2).sum((1, 2))
        return np.maximum(own.sum(0) ** 2 / np.maximum(total, 1e-300), 1.0)

    def standard_errors(self) -> np.ndarray:
        """``(P,)`` infinite of flat parameters."""
        return np.where(self.flat, math.inf, np.sqrt(np.diag(self.covariance())))

    def correlation(self) -> np.ndarray:
        """``(P, P)`` of the estimates; NaN of flat parameters."""
        error = self.standard_errors()
        spread = np.where((error > 0) & np.isfinite(error), error, np.nan)
        found: np.ndarray = self.covariance() / np.outer(spread, spread)
        return found

    def half_widths(self, level: float = LEVEL) -> np.ndarray:
        """``(P,)`` half the width of confidence intervals, by Student's quantiles; infinite of
        flat parameters."""
        found: np.ndarray = students_t.ppf(0.5 + level / 2, self.degrees()) * self.standard_errors()
        return found

    def _weighted(self, power: float, vectors: np.ndarray, least: float) -> np.ndarray:
        """``(I - K_g)^(-power)`` times vectors ``(G, M, n)``."""
        factor = np.where(self._others > least, np.maximum(self._others, least) ** -power, 0.0)
        turned = self._ways.transpose(0, 2, 1) @ vectors
        return self._ways @ (factor[..., None] * turned)


def influence(
    problem: ResidualProblem, row: np.ndarray, cluster: np.ndarray, free: np.ndarray
) -> ClusterInfluence:
    """Of clusters of sequences on pooled parameters.

    Args:
        row: ``(P,)`` at the minimum.
        cluster: ``(B,)`` which cluster a sequence belongs to.
        free: ``(P,)`` True for parameters that are at no bound; others are left out.
    """
    each = problem(row)
    member = (np.unique(cluster)[:, None] == cluster) / len(cluster)
    grams, scores = (np.tensordot(member, part, 1) for part in (each.hessian, each.gradient))
    return ClusterInfluence(grams[:, free][:, :, free], scores[:, free])


def at_bounds(problem: ResidualProblem, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(P,)`` twice: which parameters are at the lower and at the upper end of what is allowed."""
    near = 1e-6 * (1 + np.abs(row))
    return row <= problem.low + near, row >= problem.high - near


def intervals(problem: ResidualProblem, row: np.ndarray, cluster: np.ndarray) -> dict[str, Any]:
    """What calibrated parameters are, and what the data say of them.

    A parameter at a bound has no interval: it is where the admissible set ends, and the others'
    intervals hold for it being there.

    Args:
        row: ``(P,)`` at the minimum.
        cluster: ``(B,)`` which cluster a sequence belongs to.

    Returns:
        ``parameters``: address to ``value``, ``low``, ``high``, ``std_error``, the degrees of
        freedom ``df``, ``at_bound`` and ``identified``, None where there is one cluster, and the
        cost depends on the parameter;
        ``correlation``: address to address to correlation; ``clusters``: their number. Weights of
        networks are not listed.
    """
    low, high = at_bounds(problem, row)
    free = ~(low | high)
    found, number = influence(problem, row, cluster, free), len(np.unique(cluster))
    half, lost = np.zeros(len(row)), ~free
    error, degrees = half.copy(), half.copy()
    half[free], error[free] = found.half_widths(), found.standard_errors()
    degrees[free] = found.degrees()
    # with one cluster nothing tells how sure the others are
    lost[free] = found.flat | (len(problem.batch) < 2)
    parameters: dict[str, Any] = {}
    for i in np.flatnonzero(problem.physical):
        known = bool(free[i] and np.isfinite(half[i]))
        whole = problem.high[i] - problem.low[i]
        scale = VAGUE * whole if np.isfinite(whole) else abs(row[i])
        parameters[problem.names[i]] = {
            "value": float(row[i]),
            "low": float(max(row[i] - half[i], problem.low[i])) if known else None,
            "high": float(min(row[i] + half[i], problem.high[i])) if known else None,
            "std_error": float(error[i]) if known else None,
            "df": float(degrees[i]) if known else None,
            "at_bound": "low" if low[i] else "high" if high[i] else None,
            "identified": bool(known and 2 * half[i] < scale) if number > 1 or lost[i] else None,
        }
    table = np.full((len(row), len(row)), np.nan)
    table[np.ix_(free, free)] = found.correlation()
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
