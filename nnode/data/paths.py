"""Smooth paths and the noise of measured ones."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.linalg.lapack import dpbsv

#: Order of the differences that are kept small: the third, so that a constant acceleration is
#: not smoothed away.
ORDER = 3
#: Weights of smoothness that cross-validation chooses from.
WEIGHTS = np.logspace(-2, 7, 37)
#: From so many samples on, ends do not matter for how much a weight smooths.
LONG = 1000


def smooth(x: np.ndarray) -> np.ndarray:
    """Paths ``(K, ...)``, smoothed by :func:`whittaker`."""
    return whittaker(x)[0]


def whittaker(x: np.ndarray) -> tuple[np.ndarray, float]:
    """Whittaker's smoother along the first axis, ``(K, ...)`` to ``(K, ...)``, all columns alike,
    and its weight of smoothness.

    The weight is the one with the least generalised cross-validation error over all columns. Fewer
    than six samples are returned as they are, with weight 0.

    Raises:
        ValueError: a position is not finite.

    Source: Eilers 2003, Analytical Chemistry 75.
    """
    if len(x) < 6:
        return x.copy(), 0.0
    columns = np.asarray_chkfinite(x).reshape(len(x), -1)
    values, penalty = _sizes(len(x)), _penalty(len(x))
    identity = np.eye(ORDER + 1, 1)
    best, best_weight, best_score = columns, 0.0, np.inf
    for weight in WEIGHTS:
        _, smoothed, _ = dpbsv(identity + weight * penalty, columns, lower=True)
        kept = (1 / (1 + weight * values)).sum()
        score = ((columns - smoothed) ** 2).sum() / (len(x) - kept) ** 2
        if score < best_score:
            best, best_weight, best_score = smoothed, float(weight), score
    return best.reshape(x.shape), best_weight


@cache
def _penalty(samples: int) -> np.ndarray:
    """That on differences, as lower diagonals ``(ORDER + 1, K)``."""
    step = np.diff(np.eye(ORDER + 1), ORDER, axis=0)[0]
    bands = np.zeros((ORDER + 1, samples))
    for i in range(ORDER + 1):
        for j in range(i + 1):
            bands[i - j, j : samples - ORDER + j] += step[i] * step[j]
    return bands


@cache
def _sizes(samples: int) -> np.ndarray:
    """Eigenvalues of the penalty on differences; of many samples those of a circle, which differ
    at the ends alone."""
    if samples > LONG:
        waves = np.pi * np.arange(samples) / samples
        eigenvalues: np.ndarray = (2 - 2 * np.cos(waves)) ** ORDER
        return eigenvalues
    difference = np.diff(np.eye(samples), ORDER, axis=0)
    return np.maximum(np.linalg.eigvalsh(difference.T @ difference), 0.0)


def noise_variance(x: np.ndarray) -> float:
    """Variance of the measurement noise of paths ``(K, ...)``, in their unit squared.

    From differences of fourth order, in which motion hardly shows; an upper limit where the
    sampling interval is long. NaN with fewer than five samples.
    """
    if len(x) < 5:
        return float("nan")
    # 70 is the sum of the squared binomial coefficients of order 4
    return float((np.diff(x, 4, axis=0) ** 2).mean() / 70)


def velocity(x: np.ndarray, dt: float) -> np.ndarray:
    """``(K, ...)`` m/s by central differences, of second order at the ends as well."""
    if len(x) < 3:
        return np.broadcast_to(np.diff(x, axis=0) / dt, x.shape).copy()
    return np.asarray(np.gradient(x, dt, axis=0, edge_order=2))
