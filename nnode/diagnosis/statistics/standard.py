"""Sums over clusters on the scale of a standard normal variable."""

from __future__ import annotations

import numpy as np
from scipy import stats

from nnode.diagnosis import thresholds

#: Median of the square of a standard normal variable.
MEDIAN = 0.4549


def cluster_variance_of(parts: np.ndarray, sizes: np.ndarray, variance: float) -> float:
    """Variance of a cluster's score in units of its information.

    It equals the residuals' variance if they are independent, and is larger if they are
    autocorrelated. The median is robust to some clusters with an effect.
    """
    informative = sizes > 1e-9 * max(float(sizes.max()), 1e-300)
    if not informative.any():
        return variance
    robust = float(np.median(parts[informative] ** 2 / sizes[informative])) / MEDIAN
    return max(robust, variance)


def standardised(
    parts: np.ndarray, sizes: np.ndarray, signs: np.ndarray, cluster_variance: float
) -> np.ndarray:
    """``(F, C)`` absolute sums on the scale of a standard normal variable.

    The error excludes the part that the effect itself explains; otherwise no statistic could
    exceed the square root of the number of clusters. If few clusters carry the information, the
    error is shrunk towards ``cluster_variance``.

    Args:
        parts, sizes: ``(G, C)`` scores and their information.
        signs: ``(F, G)``.
        cluster_variance: see :func:`cluster_variance_of`.
    """
    total, squares, size = signs @ parts, (parts**2).sum(0), sizes.sum(0)
    empty = ~(size > 0)
    if empty.all():
        return np.zeros(total.shape)
    sizes, size = np.where(empty, 1.0, sizes), np.where(empty, float(len(sizes)), size)
    amount = total / size
    residual_squares = (
        squares - 2 * amount * (signs @ (parts * sizes)) + amount**2 * (sizes**2).sum(0)
    )
    blocks = size**2 / (sizes**2).sum(0)
    prior = thresholds.PRIOR
    variance = (blocks * np.maximum(residual_squares, 0) + prior * cluster_variance * size) / (
        blocks + prior
    )
    return _wallace(total**2 / variance, blocks + prior - 1)


def joint(parts: np.ndarray, grams: np.ndarray, signs: np.ndarray, variance: float) -> np.ndarray:
    """``(F,)`` the joint statistic of the k sums ``(G, k)`` under flips."""
    k = parts.shape[1]
    if k == 1:
        sizes = grams[:, :, 0]
        return standardised(parts, sizes, signs, cluster_variance_of(parts, sizes, variance))[:, 0]
    total = signs @ parts
    amount = total @ np.linalg.pinv(grams.sum(0), rcond=1e-10)
    residual_parts = signs[:, :, None] * parts - np.einsum("bij,fj->fbi", grams, amount)
    information = grams.sum(0)
    size = np.trace(grams, axis1=1, axis2=2)
    blocks = float(size.sum() ** 2 / (size**2).sum())
    spread = np.einsum("fbi,fbj->fij", residual_parts, residual_parts)
    cluster_variance = cluster_variance_of(parts, np.einsum("bii->bi", grams), variance)
    prior = thresholds.PRIOR
    spread = (blocks * spread + prior * cluster_variance * information) / (blocks + prior)
    spread += 1e-12 * np.trace(information) * np.eye(k)
    squares = np.einsum("fi,fi->f", total, np.linalg.solve(spread, total[..., None])[..., 0])
    degrees = np.array(blocks + prior - 1)
    return _normal(_wallace(squares, degrees) ** 2, k)


def _wallace(squares: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Squares of Student's t on the scale of a normal variable.

    Source: Wallace 1959, Annals of Mathematical Statistics 30.
    """
    factor = (8 * degrees + 1) / (8 * degrees + 3)
    normal_scale: np.ndarray = factor * np.sqrt(degrees * np.log1p(squares / degrees))
    return normal_scale


def _normal(squares: np.ndarray, k: int) -> np.ndarray:
    """Sums of k squares on the scale of a standard normal variable."""
    if k == 1:
        return np.sqrt(np.maximum(squares, 0))
    tail = stats.chi2.sf(np.maximum(squares, 0), k)
    normal_scale: np.ndarray = np.sqrt(stats.chi2.isf(np.maximum(tail, 1e-300), 1))
    return normal_scale
