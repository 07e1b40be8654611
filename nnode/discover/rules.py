"""The numbers that decide what is said, each with its reason: levels of tests, and shares.

They hold for the whole of a diagnosis; :func:`applied` sets them. What halving and doubling each
does to names and false names: ``python -m benchmarks.discovery.sensitivity``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass
class Rules:
    """Numbers that no derivation gives, beside ``discover.alpha``."""

    # of every test after the first screen: whether held-out and sealed clusters lean an effect's
    # way, whether two effects are told apart, whether a curve outdoes an effect
    level: float = 0.05
    # of what would mislead most: structure without a name, and kin, which differ by little
    sure: float = 0.01
    least: float = 0.02  # share of the squared errors below which nothing is worth a name
    minimal: float = 0.1  # of an effect's least usual size: taken for none, a crowd's bias is less
    rival: float = 0.25  # of the best score's gain: effects from there on are calibrated, for time
    near: float = 0.97  # of the best held-out gain: from there on the simpler effect is as good
    # what is left, relative to what names removed: from there on they do not explain the data
    too_much: float = 0.5
    # of an effect's trace: with less inside its plausible range it speaks for something else; a
    # strong effect's linear estimate may overshoot
    forbidden: float = 0.2
    # of the past's size: so far it is taken to be known; what a wrong model leaves of data without
    # noise is smooth, and could be extrapolated so well that only wriggles count; a tenth cost
    # effects that come second a tenth of their standardized distance
    trust: float = 0.03
    prior: float = 12.0  # usual clusters that are added to those that give an error
    power: float = 0.8  # what counts as likely to be found; Cohen 1988


_RULES: ContextVar[Rules | None] = ContextVar("rules", default=None)


def rules() -> Rules:
    """Those that hold now."""
    return _RULES.get() or Rules()


@contextmanager
def applied(chosen: Rules) -> Iterator[None]:
    """Other rules for a while."""
    token = _RULES.set(chosen)
    try:
        yield
    finally:
        _RULES.reset(token)
