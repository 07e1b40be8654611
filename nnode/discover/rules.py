"""Levels and thresholds of the decisions of a diagnosis, each with its reason.

They apply to a whole diagnosis; :func:`applied` sets them. The sensitivity of true and false
positives to halving and doubling each: ``benchmark_discovery.kinds=[rules]``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass
class Rules:
    """Chosen levels and thresholds, in addition to ``discover.alpha``."""

    # level of the tests between models in exploration clusters: score tests on held-out clusters,
    # J tests between effects, comparisons of effects with curves
    level: float = 0.05
    # level that the first screen and the confirmation clusters must each reach on their own. The
    # error rate is that of both together, discover.alpha; without this one, strong evidence in
    # one part would name an effect that the other part contradicts
    each: float = 0.25
    # stricter level, where errors mislead most: unexplained structure, and similar effects
    sure: float = 0.01
    least: float = 0.02  # smallest share of the squared errors that is worth naming
    minimal: float = 0.1  # negligible share of an effect's minimum size; a crowd's bias is smaller
    rival: float = (
        0.25  # share of the best score's gain from which effects are calibrated, for time
    )
    near: float = 0.97  # share of the best held-out gain from which a simpler effect is as good
    # largest ratio of unexplained structure to what the named effects removed
    too_much: float = 0.5
    # smallest share of an effect's estimate inside its plausible range, below which it indicates
    # another effect; the linear estimate of a strong effect may overshoot
    forbidden: float = 0.2
    # ridge of the autoregressive filter, relative to the past residuals; without noise, a wrong
    # model's residuals are smooth and could be extrapolated almost exactly; a value of 0.1 costs
    # effects that are added second a tenth of their standardised distance
    trust: float = 0.03
    prior: float = 12.0  # prior weight of the pooled variance, in clusters
    power: float = 0.8  # power that counts as detectable; Cohen 1988


_RULES: ContextVar[Rules | None] = ContextVar("rules", default=None)


def rules() -> Rules:
    """The present values."""
    return _RULES.get() or Rules()


@contextmanager
def applied(chosen: Rules) -> Iterator[None]:
    """Use other values within a context."""
    token = _RULES.set(chosen)
    try:
        yield
    finally:
        _RULES.reset(token)
