"""What a comparison of two models came to, in plain numbers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Comparison:
    """Of two models on the same clusters.

    Attributes:
        gain: mean over the clusters of (first - second) / max(first, second).
        low, high: its interval of 95 %.
        p_value: that the second is not better, one-sided.
        clusters: their number.
    """

    gain: float
    low: float
    high: float
    p_value: float
    clusters: int = 0
