"""Held-out costs of calibrated models by cluster, and tests of their differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import stats

from nnode.data.clusters import better, group_sums
from nnode.diagnosis.residuals.comparison import Comparison
from nnode.diagnosis.residuals.fit import Fit

#: A direction in which the other clusters hold less than this share of the information is not
#: changed by leaving a cluster out.
ALONE = 0.02


def heldout(fit: Fit, cluster: np.ndarray) -> np.ndarray:
    """``(G,)`` cost of each cluster with the parameters estimated from the other clusters.

    See :meth:`~nnode.calibrate.intervals.ClusterInfluence.moved`.
    """
    return group_sums(_left_out(fit, cluster) ** 2, cluster)


def presence_pvalue(before: Fit, after: Fit, cluster: np.ndarray) -> float:
    """One-sided p-value of the score test of a model toward its extension, on held-out residuals;
    see :func:`score_toward`."""
    first, second = _left_out(before, cluster), _left_out(after, cluster)
    return better(score_toward(first, second, cluster))


def j_test(first: Fit, second: Fit, cluster: np.ndarray) -> Comparison:
    """J test of non-nested models: whether held-out residuals of the first correlate with the
    difference of the predictions, which they do not if the first one is true.

    The p-value is that of sign flips. A test of different costs has half the standardised distance,
    and its null hypothesis is that both models are equally wrong.

    Source: Davidson & MacKinnon 1981 (tests of non-nested models).
    """
    scores = score_toward(_left_out(first, cluster), _left_out(second, cluster), cluster)
    return replace(_student(scores), p_value=better(scores))


def score_toward(first: np.ndarray, second: np.ndarray, cluster: np.ndarray) -> np.ndarray:
    """``(G,)`` scores of one model toward another by cluster: products of its residuals with the
    change of predictions, relative to the cluster's larger cost.

    The mean is positive if the second model changes predictions in the right direction. Predictions
    improve, see :func:`gains`, only if more than half of the change is true; that test has half the
    standardised distance.

    Args:
        first, second: ``(n,)`` residuals of the two models. cluster: ``(n,)``.

    Source: Rao 1948 (scores).
    """
    with np.errstate(invalid="ignore"):
        scores = 2 * group_sums(first * (first - second), cluster)
        larger = np.maximum(group_sums(first**2, cluster), group_sums(second**2, cluster))
        relative: np.ndarray = scores / np.where(larger > 0, larger, 1)
    return relative


def _left_out(fit: Fit, cluster: np.ndarray) -> np.ndarray:
    columns, residual = fit.tangents, fit.residual
    if not columns.shape[1]:
        return residual
    moved = fit.influence(cluster).moved(1.0, ALONE)
    left_out: np.ndarray = residual + (columns * moved[cluster]).sum(1)
    return left_out


def gains(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """``(G,)`` (first - second) / max(first, second), 0 where both vanish."""
    larger = np.maximum(first, second)
    relative: np.ndarray = np.where(larger > 0, first - second, 0.0) / np.where(
        larger > 0, larger, 1
    )
    return relative


def compare(first: np.ndarray, second: np.ndarray) -> Comparison:
    """Paired comparison by cluster; differences are relative to the larger cost, so that no
    cluster dominates.

    Args:
        first, second: ``(G,)`` held-out costs.
    """
    return _student(gains(first, second))


def _student(share: np.ndarray) -> Comparison:
    number = len(share)
    mean = float(share.mean())
    if number < 2:
        return Comparison(mean, -np.inf, np.inf, 1.0, number)
    error = float(share.std(ddof=1) / np.sqrt(number))
    half = float(stats.t.ppf(0.975, number - 1)) * error
    p_value = float(stats.t.sf(mean / error, number - 1)) if error > 0 else float(mean <= 0)
    return Comparison(mean, mean - half, mean + half, p_value, number)


def clusters_to_tell(test: Comparison, level: float, power: float = 0.9) -> int | None:
    """The approximate number of clusters that distinguishes two models with a given power, if the
    observed difference is the true one.

    For the one-sided t-test, (n mean²/variance)^½ is the sum of Student's quantiles of the level
    and of the power with n - 1 degrees of freedom. The number is as uncertain as the observed
    difference.

    Args:
        test: of the two models.
        level: of the test.
        power: of the test.

    Returns:
        The number; None if the second model is no better.
    """
    if test.clusters < 2 or not test.gain > 0 or not math.isfinite(test.high):
        return None
    error = (test.high - test.gain) / float(stats.t.ppf(0.975, test.clusters - 1))
    ratio = error**2 * test.clusters / test.gain**2
    number = 2
    for _ in range(50):  # the quantiles depend on the number
        degrees = max(number - 1, 1)
        quantiles = float(stats.t.ppf(1 - level, degrees) + stats.t.ppf(power, degrees))
        needed = max(2, math.ceil(ratio * quantiles**2))
        if needed == number:
            break
        number = max(needed, 2) if needed < number else (number + needed + 1) // 2
    return max(number, test.clusters)
