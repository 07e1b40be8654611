"""Least squares with few parameters, by finite differences: enough to recalibrate a base model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_ROUNDS = 30
#: Relative to a parameter's scale.
_DIFFERENCE = 1e-5
_ENOUGH = 1e-7


def least_squares(
    residuals: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    *,
    low: np.ndarray,
    scale: np.ndarray,
    enough: float = _ENOUGH,
) -> np.ndarray:
    """Parameters ``(p,)`` of a local minimum of the sum of squares, by Levenberg and Marquardt.

    Args:
        residuals: of parameters; values that are not finite count as infinitely bad.
        start: first guess.
        low: smallest admissible values.
        scale: typical sizes of the parameters.
        enough: the search ends where a step lowers the sum of squares by less than this share.
    """
    here = np.maximum(start, low)
    r = residuals(here)
    best, damping = _total(r), 1e-3
    for _ in range(_ROUNDS):
        slopes = np.stack(
            [
                (residuals(here + _DIFFERENCE * scale * unit) - r) / _DIFFERENCE
                for unit in np.eye(len(here))
            ],
            axis=1,
        )
        normal, gradient = slopes.T @ slopes, slopes.T @ r
        # a parameter without any influence stays where it is
        diagonal = np.maximum(np.diag(normal), 1e-12 * max(np.trace(normal), 1e-300))
        while damping < 1e8:
            step = np.linalg.solve(normal + damping * np.diag(diagonal), -gradient)
            there = np.maximum(here + scale * step, low)
            after = residuals(there)
            total = _total(after)
            if total < best:
                break
            damping *= 10
        else:
            return here
        gain, here, r, best = 1 - total / best, there, after, total
        damping = max(damping / 10, 1e-9)
        if gain < enough or best == 0:
            return here
    return here


def _total(r: np.ndarray) -> float:
    total = float(r @ r)
    return total if np.isfinite(total) else np.inf
