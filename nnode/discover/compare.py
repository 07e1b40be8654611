"""Held-out costs of calibrated models by sequence, and tests of their differences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from nnode.discover.fit import Fit, sums

#: What the other sequences know less of than this share of what all know is not changed by
#: leaving one out: nothing follows from them.
ALONE = 0.02


def heldout(fit: Fit, sequence: np.ndarray) -> np.ndarray:
    """``(S,)`` cost of each sequence under the parameters that the other sequences give.

    See :meth:`Fit.left_out`.
    """
    columns, residual = fit.tangents, fit.residual
    if columns.shape[1]:
        moved = fit.left_out(sequence, ALONE)
        residual = residual + (columns * moved[sequence]).sum(1)
    return sums(residual**2, sequence)


@dataclass(frozen=True)
class Comparison:
    """Of two models on the same sequences.

    Attributes:
        gain: mean over the sequences of (first - second) / max(first, second).
        low, high: its interval of 95 %.
        p_value: that the second is not better, one-sided.
    """

    gain: float
    low: float
    high: float
    p_value: float


def compare(first: np.ndarray, second: np.ndarray) -> Comparison:
    """Paired by sequence; each one's difference is relative to its greater cost, so that no
    sequence dominates.

    Args:
        first, second: ``(S,)`` held-out costs.
    """
    larger = np.maximum(first, second)
    share = np.where(larger > 0, (first - second) / np.where(larger > 0, larger, 1), 0.0)
    number = len(share)
    mean = float(share.mean())
    if number < 2:
        return Comparison(mean, -np.inf, np.inf, 1.0)
    error = float(share.std(ddof=1) / np.sqrt(number))
    half = float(stats.t.ppf(0.975, number - 1)) * error
    p_value = float(stats.t.sf(mean / error, number - 1)) if error > 0 else float(mean <= 0)
    return Comparison(mean, mean - half, mean + half, p_value)
