"""Separate parameters of each pair, shrunk towards pooled parameters, and their evaluation.

Parameters of a pair must be evaluated on other data than those of their calibration. They are
calibrated on first halves and evaluated on second halves. The covariance between both halves
(method of moments) estimates the variance of permanent differences between drivers. Its root is
the unit of deviations from the pooled parameters in the penalty.
"""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Sequence as ListLike
from dataclasses import dataclass

import numpy as np

from nnode.calibrate.problem import ResidualProblem, pooled, separate

#: Factors, in the unit of the cost, on squared deviations from the pooled parameters.
STRENGTHS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
#: A parameter's standard deviation between pairs is at least this share of the pooled value.
LEAST_SPREAD = 0.02


@dataclass(frozen=True)
class Halves:
    """Calibrations on the first halves of B pairs.

    Attributes:
        centre: ``(P,)`` pooled parameters.
        between: ``(P,)`` standard deviation of the pairs' separate parameters.
        spread: ``(P,)`` root of the covariance between both halves.
        pooled, alone, shrunk: ``(B,)`` costs of second halves.
        strengths: strength of shrinkage of every fold, the best for the other folds' pairs.
    """

    centre: np.ndarray
    between: np.ndarray
    spread: np.ndarray
    pooled: np.ndarray
    alone: np.ndarray
    shrunk: np.ndarray
    strengths: list[float]


def calibrated_halves(
    first: ResidualProblem,
    second: ResidualProblem,
    row: np.ndarray,
    others: Iterable[np.ndarray],
    pair_fold: np.ndarray,
) -> Halves:
    """Pooled, separate and shrunk calibrations of first halves, evaluated on second halves.

    Args:
        row: ``(P,)`` start of the pooled calibration.
        others: further starts of the separate calibrations.
        pair_fold: ``(B,)`` fold of every pair.
    """
    centre = pooled(first, row).row
    begin = [centre, *others]
    apart = [separate(cost, begin)[0] for cost in (first, second)]
    spread = _shared_deviation(apart)
    scale = np.maximum(spread, LEAST_SPREAD * np.where(centre == 0, 1.0, np.abs(centre)))
    candidates = [
        separate(first, [centre], penalty=(centre, s / scale**2))[0] if s else apart[0]
        for s in STRENGTHS
    ]
    costs = np.stack([second.costs(candidate) for candidate in candidates])
    shrunk, chosen = np.zeros(len(pair_fold)), []
    for k in range(int(pair_fold.max()) + 1):
        i = int(np.argmin(costs[:, pair_fold != k].mean(1)))
        shrunk[pair_fold == k] = costs[i, pair_fold == k]
        chosen.append(STRENGTHS[i])
    return Halves(
        centre=centre,
        between=np.std(apart[0], axis=0),
        spread=spread,
        pooled=second.costs(centre),
        alone=costs[0],
        shrunk=shrunk,
        strengths=chosen,
    )


def _shared_deviation(apart: ListLike[np.ndarray]) -> np.ndarray:
    """``(P,)`` root of the covariance between both halves of the pairs; at least 0.

    Values are clipped to the middle 90 % of each half, because a parameter that a half does not
    determine may have any value.
    """
    clipped = [np.clip(rows, *np.quantile(rows, [0.05, 0.95], axis=0)).T for rows in apart]
    shared = [np.cov(*halves)[0, 1] for halves in zip(*clipped, strict=True)]
    return np.sqrt(np.maximum(shared, 0.0))
