"""The result of a paired comparison of two models."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Comparison:
    """A paired comparison of two models on the same clusters.

    Attributes:
        gain: mean over the clusters of (first - second) / max(first, second).
        low, high: its interval of 95 %.
        p_value: one-sided, of the null hypothesis that the second is not better.
        clusters: their number.
    """

    gain: float
    low: float
    high: float
    p_value: float
    clusters: int = 0
