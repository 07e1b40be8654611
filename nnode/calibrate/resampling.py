"""Intervals and paired tests by resampling of groups, such as sequences that share vehicles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

#: Number of draws; the Monte Carlo error is then below the digits of tables.
DRAWS = 4000


def group_weights(group: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """``(draws, S)`` bootstrap weights of S items by groups; rows sum to 1.

    Args:
        group: ``(S,)`` group of each item, counted from 0.
    """
    number = int(group.max()) + 1
    counts = rng.multinomial(number, np.full(number, 1 / number), size=draws)
    weights = counts[:, group].astype(float)
    return np.asarray(weights / weights.sum(1, keepdims=True))


def average_interval(
    values: list[np.ndarray], group: list[np.ndarray], seed: int, level: float = 0.95
) -> tuple[float, float]:
    """Percentile interval of the mean over recordings of the mean over a recording's sequences.

    Args:
        values, group: per recording ``(S,)`` values and groups; groups are resampled within
            their recording.
    """
    rng = np.random.default_rng(seed)
    means = [group_weights(g, DRAWS, rng) @ v for v, g in zip(values, group, strict=True)]
    low, high = np.quantile(np.mean(means, axis=0), [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


@dataclass(frozen=True)
class Paired:
    """A comparison of two models on the same sequences.

    Attributes:
        difference: mean of first minus second.
        low, high: 95 % percentile interval, groups resampled.
        p: two-sided, from random signs of whole groups.
        better: share of the sequences on which the first has the lower value.
    """

    difference: float
    low: float
    high: float
    p: float
    better: float


def paired(first: np.ndarray, second: np.ndarray, group: np.ndarray, seed: int) -> Paired:
    """Compare two models by sequence, with groups as the exchangeable units."""
    rng = np.random.default_rng(seed)
    difference = first - second
    low, high = np.quantile(group_weights(group, DRAWS, rng) @ difference, [0.025, 0.975])
    total = np.bincount(group, weights=difference)
    signs = rng.choice([-1.0, 1.0], size=(DRAWS, len(total)))
    exceeds = np.abs(signs @ total) >= abs(total.sum()) * (1 - 1e-12)
    return Paired(
        difference=float(difference.mean()),
        low=float(low),
        high=float(high),
        p=float((1 + exceeds.sum()) / (1 + DRAWS)),
        better=float((difference < 0).mean()),
    )


def holm(p: Mapping[str, float]) -> dict[str, float]:
    """p values corrected for their number, by Holm's step-down method (1979)."""
    order = sorted(p, key=lambda name: p[name])
    corrected: dict[str, float] = {}
    largest = 0.0
    for rank, name in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p[name]))
        corrected[name] = largest
    return {name: corrected[name] for name in p}
