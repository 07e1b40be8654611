"""Disturbances that are correlated in time."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

#: Degrees of freedom of heavy-tailed kicks: their variance exists, their fourth moment does not.
TAIL = 3


def ornstein_uhlenbeck(
    rng: np.random.Generator,
    shape: tuple[int, ...],
    *,
    step: float,
    correlation: np.ndarray | float,
    heavy_tails: bool = False,
) -> np.ndarray:
    """Stationary Ornstein–Uhlenbeck paths of variance 1, exact at any step.

    Args:
        shape: ``(..., K)``; time is the last axis.
        step: between two values, s.
        correlation: time after which the correlation has fallen to 1/e, s; broadcast against
            ``shape[:-1]``.
        heavy_tails: the kicks follow Student's t with 3 degrees of freedom, scaled to the same
            variance.

    Returns:
        An array of ``shape``.
    """
    kicks = rng.standard_t(TAIL, shape) if heavy_tails else rng.standard_normal(shape)
    if heavy_tails:
        kicks *= np.sqrt((TAIL - 2) / TAIL)
    memory = np.broadcast_to(np.exp(-step / np.asarray(correlation, dtype=float)), shape[:-1])
    flat, decay = kicks.reshape(-1, shape[-1]), memory.reshape(-1)
    # the first value is stationary already; every later kick keeps the variance at 1
    flat[:, 1:] *= np.sqrt(1 - decay**2)[:, None]
    for row, factor in zip(flat, decay, strict=True):
        row[:] = lfilter([1.0], [1.0, -factor], row)
    return flat.reshape(shape)
