"""Measured platoons of one linear law with one hidden effect, behind leaders of given speeds."""

from __future__ import annotations

import numpy as np

from benchmarks.synthetic_cases.noise import ornstein_uhlenbeck
from benchmarks.synthetic_cases.traffic.motion import Base, Hidden, simulate

#: Sampling interval, s, and steps of Runge–Kutta's method in it.
DT, SUBSTEPS = 0.2, 4


def waves(rng: np.random.Generator, number: int, seconds: float, mean: float) -> np.ndarray:
    """``(P, 2 M + 1)`` speeds of leaders at whole and half steps, m/s: sums of three slow waves."""
    t = 0.5 * DT / SUBSTEPS * np.arange(2 * SUBSTEPS * round(seconds / DT) + 1)
    size, period, phase = (
        rng.uniform(low, high, (3, number, 1))
        for low, high in ((0.3, 1.5), (8, 40), (0, 2 * np.pi))
    )
    return mean + (size * np.sin(2 * np.pi * t / period + phase)).sum(0)


def platoons(
    rng: np.random.Generator,
    speed: np.ndarray,
    v0: float,
    L: float,
    hidden: Hidden,
    *,
    vehicles: int,
    push: float,
    correlation: float,
    error: float,
    before: float,
) -> np.ndarray:
    """``(P, K + 1, N)`` measured positions, m; the leader is the last vehicle.

    Args:
        speed: ``(P, 2 M + 1)`` of the leaders at whole and half steps, m/s.
        v0, L: of the linear law, m/s and m.
        push, correlation: standard deviation of the followers' speeds, m/s, and its correlation
            time, s.
        error: of measured positions, m.
        before: s that are simulated and not returned.
    """
    step, number = DT / SUBSTEPS, len(speed)
    mean = 0.5 * (speed[:, 1:] + speed[:, :-1])
    lead = np.insert(np.cumsum(mean, 1) * step / 2, 0, 0.0, axis=1)
    gap = L * v0 / (v0 - speed[:, :1])
    start = -gap * np.arange(vehicles - 1, -1, -1.0)
    shape = (number, vehicles, (speed.shape[1] + 1) // 2)
    kick = push * ornstein_uhlenbeck(rng, shape, step=step, correlation=correlation)
    x, _ = simulate(
        Base(v0, L),
        hidden,
        np.ones((number, vehicles)),
        (lead, speed),
        (start[:, None], np.repeat(speed[:, :1], vehicles, 1)[:, None]),
        kick.transpose(0, 2, 1),
        np.zeros(number),
        -before,
        step,
        SUBSTEPS,
    )
    x = x[:, round(before / DT) :]
    return x + error * rng.normal(size=x.shape)
