"""Steps in NumPy, for models that live for a second: nothing is compiled for them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from torch import Tensor

Time = TypeVar("Time", float, Tensor)
States = TypeVar("States", np.ndarray, Tensor)


def runge_kutta(
    rate: Callable[[Time, States], States], t: Time, y: States, h: float, k1: States
) -> States:
    """The states after a step of ``h`` s by the classical method of fourth order, from those
    and their rates ``k1`` before."""
    k2 = rate(t + h / 2, y + h / 2 * k1)
    k3 = rate(t + h / 2, y + h / 2 * k2)
    k4 = rate(t + h, y + h * k3)
    return y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def simulated(
    rate: Callable[[float, np.ndarray], np.ndarray],
    y: np.ndarray,
    dt: float,
    samples: int,
    longest: float,
) -> np.ndarray:
    """``(samples, ...)`` states every ``dt`` s from ``y`` on.

    Steps are as long as ``longest`` (s) allows: several samples, between which Hermite's cubic
    interpolation gives the states, or a whole part of the sampling interval.
    """
    stride, steps = strides(dt, longest)
    h = dt * stride / steps
    slope, found = rate(0.0, y), [y]
    for step in range(math.ceil((samples - 1) / stride) * steps):
        t = step * h
        after = runge_kutta(rate, t, y, h, slope)
        then = rate(t + h, after)
        for part in range(1, stride):
            s = part / stride
            away = h * (s * (1 - s) ** 2 * slope - s**2 * (1 - s) * then)
            found.append((1 + 2 * s) * (1 - s) ** 2 * y + s**2 * (3 - 2 * s) * after + away)
        if (step + 1) % steps == 0:
            found.append(after)
        y, slope = after, then
    return np.stack(found[:samples])


def strides(dt: float, longest: float) -> tuple[int, int]:
    """Samples in a step, or steps in a sample."""
    return max(1, math.floor(longest / dt + 1e-9)), max(1, math.ceil(dt / longest - 1e-9))
