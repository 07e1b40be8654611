"""Resampling: intervals and paired tests where sequences that share vehicles go together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

#: Draws of every resampling here; its own error is then below what a table shows.
DRAWS = 4000


def group_weights(group: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """``(draws, S)`` weights of S items whose groups are drawn with replacement; rows sum to 1.

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
    """Compare two models by sequence; groups are exchangeable, sequences within them are not."""
    rng = np.random.default_rng(seed)
    away = first - second
    low, high = np.quantile(group_weights(group, DRAWS, rng) @ away, [0.025, 0.975])
    total = np.bincount(group, weights=away)
    signs = rng.choice([-1.0, 1.0], size=(DRAWS, len(total)))
    beyond = np.abs(signs @ total) >= abs(total.sum()) * (1 - 1e-12)
    return Paired(
        difference=float(away.mean()),
        low=float(low),
        high=float(high),
        p=float((1 + beyond.sum()) / (1 + DRAWS)),
        better=float((away < 0).mean()),
    )


def holm(p: Mapping[str, float]) -> dict[str, float]:
    """p values corrected for their number, by Holm's step-down method (1979)."""
    order = sorted(p, key=lambda name: p[name])
    found: dict[str, float] = {}
    least = 0.0
    for rank, name in enumerate(order):
        least = max(least, min(1.0, (len(order) - rank) * p[name]))
        found[name] = least
    return {name: found[name] for name in p}
