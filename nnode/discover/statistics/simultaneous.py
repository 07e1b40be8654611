"""Do agents behave alike who are there at one time but share nobody?

The mean residuals of two clusters of a site over the seconds that they have in common are
multiplied. Where they have nothing to do with each other, the sum of these products is as large
when each cluster is shifted along its own time, which keeps how long its residuals last. What all
sequences have in common as functions of the time since their start is the model's and is taken out
first; where all start at one time nothing can be told from it.

Source: surrogates by circular shifts, as in Theiler et al. 1992 for other statistics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nnode.discover.residuals.engine import Engine
from nnode.discover.residuals.fit import Fit

#: Time over which residuals are averaged, s.
BIN = 1.0
#: Shifts that the p-value comes from, and its level.
SHIFTS, ALPHA = 999, 0.05


@dataclass(frozen=True)
class Simultaneous:
    """What the test said.

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
        """Whether what is simultaneous is one cluster."""
        return self.p_value <= ALPHA

    def plain(self) -> str:
        """In a sentence."""
        if not self.pairs:
            return "no two clusters of a site were there at one time"
        kept = "they are one cluster" if self.together else "they are taken as independent"
        return (
            f"{self.pairs} pairs of clusters that were there at one time: correlation of their "
            f"residuals {self.correlation:.2f}, one-sided p = {self.p_value:.3f}; {kept}"
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
    """Sum over all pairs of the products of what they have in common."""
    start = min(first for first, _ in members)
    length = max(first + len(residuals) for first, residuals in members) - start
    total = np.zeros((length, members[0][1].shape[1]))
    squares = 0.0
    for first, residuals in members:
        total[first - start : first - start + len(residuals)] += residuals
        squares += float((residuals**2).sum())
    return (float((total**2).sum()) - squares) / 2


def _pairs(members: list[_Member]) -> tuple[int, float]:
    """How many pairs have two seconds in common, and the sum of their sizes there."""
    number, size = 0, 0.0
    for i, (first_start, first_residuals) in enumerate(members):
        for second_start, second_residuals in members[i + 1 :]:
            start, end = (
                max(first_start, second_start),
                min(first_start + len(first_residuals), second_start + len(second_residuals)),
            )
            if end - start >= 2:
                a, b = (
                    first_residuals[start - first_start : end - first_start],
                    second_residuals[start - second_start : end - second_start],
                )
                number += 1
                size += float(np.sqrt((a**2).sum() * (b**2).sum()))
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
