"""Smooth paths and the noise of measured ones."""

from __future__ import annotations

import numpy as np

#: Order of the differences that are kept small: the third, so that a constant acceleration is
#: not smoothed away.
ORDER = 3
#: Weights of smoothness that cross-validation chooses from.
WEIGHTS = np.logspace(-2, 7, 37)


def smooth(x: np.ndarray) -> np.ndarray:
    """Whittaker's smoother along the first axis, ``(K, ...)`` to ``(K, ...)``, all columns alike.

    The weight of smoothness is the one with the least generalised cross-validation error over
    all columns. Fewer than six samples are returned as they are.

    Source: Eilers 2003, Analytical Chemistry 75.
    """
    if len(x) < 6:
        return x.copy()
    values, vectors = _modes(len(x))
    columns = x.reshape(len(x), -1)
    parts = vectors.T @ columns
    score = []
    for weight in WEIGHTS:
        keep = 1 / (1 + weight * values)
        left = (((1 - keep)[:, None] * parts) ** 2).sum()
        score.append(left / (len(x) - keep.sum()) ** 2)
    keep = 1 / (1 + WEIGHTS[int(np.argmin(score))] * values)
    found: np.ndarray = vectors @ (keep[:, None] * parts)
    return found.reshape(x.shape)


def _modes(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and eigenvectors of the penalty on differences."""
    difference = np.diff(np.eye(samples), ORDER, axis=0)
    values, vectors = np.linalg.eigh(difference.T @ difference)
    return np.maximum(values, 0.0), vectors


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
