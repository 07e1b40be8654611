"""Test whether simultaneous clusters without common agents are correlated.

The statistic is the sum of products of the mean residuals of two clusters of a site over their
common seconds. Under independence, its distribution is invariant to circular shifts of each cluster
along its own time, which preserve autocorrelation. The mean residual as a function of the time
since the start is a misfit of the model and is subtracted first; if all sequences start at one
time, the test has no power.

Source: surrogates by circular shifts, as in Theiler et al. 1992 for other statistics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nnode.diagnosis.residuals.engine import Engine
from nnode.diagnosis.residuals.fit import Fit

#: Time over which residuals are averaged, s.
BIN = 1.0
#: Shifts that the p-value comes from, and its level.
SHIFTS, ALPHA = 999, 0.05


@dataclass(frozen=True)
class Simultaneous:
    """The result of the test.

    Attributes:
        pairs: of clusters of a site that have at least two seconds in common.
        correlation: of their mean residuals; NaN without a pair.
        p_value: one-sided; 1 without a pair.
    """

    pairs: int
    correlation: float
    p_value: float

    @property
    def together(self) -> bool:
        """Whether simultaneous sequences are treated as one cluster."""
        return self.p_value <= ALPHA

    def plain(self) -> str:
        """In a sentence."""
        if not self.pairs:
            return "no two clusters of a site overlap in time"
        kept = "one cluster" if self.together else "independent"
        return (
            f"{self.pairs} pairs of clusters overlap in time and are treated as {kept} "
            f"(correlation of residuals {self.correlation:.2f}, one-sided p = {self.p_value:.3f})"
        )


def simultaneous(engine: Engine, fit: Fit, seed: int = 0) -> Simultaneous:
    """Test the clusters of an engine's sequences."""
    series = _series(engine, fit)
    rng = np.random.default_rng(seed)
    pairs, observed, size, shifted = 0, 0.0, 0.0, np.zeros(SHIFTS)
    for site in sorted({name for name, _, _ in series}):
        members = [(first, residuals) for name, first, residuals in series if name == site]
        number, length = _pairs(members)
        if not number:
            continue
        pairs, size = pairs + number, size + length
        observed += _products(members)
        for k in range(SHIFTS):
            shifted[k] += _products(
                [
                    (first, np.roll(residuals, int(rng.integers(len(residuals))), 0))
                    for first, residuals in members
                ]
            )
    if not pairs:
        return Simultaneous(0, float("nan"), 1.0)
    p_value = float(1 + (shifted >= observed).sum()) / (1 + SHIFTS)
    return Simultaneous(pairs, observed / max(size, 1e-300), p_value)


_Member = tuple[int, np.ndarray]


def _products(members: list[_Member]) -> float:
    """Sum over all pairs of the products of their residuals in common seconds."""
    start = min(first for first, _ in members)
    length = max(first + len(residuals) for first, residuals in members) - start
    total = np.zeros((length, members[0][1].shape[1]))
    squares = 0.0
    for first, residuals in members:
        total[first - start : first - start + len(residuals)] += residuals
        squares += float((residuals**2).sum())
    return (float((total**2).sum()) - squares) / 2


def _pairs(members: list[_Member]) -> tuple[int, float]:
    """The number of pairs with at least two common seconds, and the sum of their norms there."""
    number, size = 0, 0.0
    for i, (start_a, a) in enumerate(members):
        for start_b, b in members[i + 1 :]:
            start, end = max(start_a, start_b), min(start_a + len(a), start_b + len(b))
            if end - start >= 2:
                overlap_a = a[start - start_a : end - start_a]
                overlap_b = b[start - start_b : end - start_b]
                number += 1
                size += float(np.sqrt((overlap_a**2).sum() * (overlap_b**2).sum()))
    return number, size


def _series(engine: Engine, fit: Fit) -> list[tuple[str, int, np.ndarray]]:
    """Of each cluster its site, its first second, and ``(T, C)`` mean residuals of every
    second and component from then on; 0 where there is none."""
    second = np.floor(engine.clock / BIN).astype(int)
    kinds = int(engine.component.max()) + 1
    start = np.array([s.time[0] for s in engine.sequences])[engine.sequence]
    since = np.floor((engine.clock - start) / BIN).astype(int) * kinds + engine.component
    common = np.bincount(since, fit.residual) / np.maximum(np.bincount(since), 1)
    residual = fit.residual - common[since]
    series = []
    for label in range(int(engine.cluster.max()) + 1):
        members = engine.cluster == label
        first_second = int(second[members].min())
        at = (second[members] - first_second) * kinds + engine.component[members]
        number = (int(second[members].max()) - first_second + 1) * kinds
        count = np.bincount(at, minlength=number)
        mean = np.bincount(at, residual[members], number) / np.maximum(count, 1)
        sequence = engine.sequences[int(engine.sequence[members][0])]
        series.append((sequence.site or sequence.recording, first_second, mean.reshape(-1, kinds)))
    return series
