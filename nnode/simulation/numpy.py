"""Integration in NumPy, for models of a search that are too short-lived to compile."""

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
    """The states after a step of ``h`` s by the classic Runge-Kutta method.

    Args:
        y, k1: states and their rates before the step.
    """
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
    """``(samples, ...)`` states every ``dt`` s, starting from ``y``.

    Steps are as long as ``longest`` (s) allows. A step is several sampling intervals, with cubic
    Hermite interpolation between its ends, or a whole part of the sampling interval.
    """
    stride, steps = strides(dt, longest)
    h = dt * stride / steps
    slope, states = rate(0.0, y), [y]
    for step in range(math.ceil((samples - 1) / stride) * steps):
        t = step * h
        after = runge_kutta(rate, t, y, h, slope)
        slope_after = rate(t + h, after)
        for part in range(1, stride):
            s = part / stride
            bend = h * (s * (1 - s) ** 2 * slope - s**2 * (1 - s) * slope_after)
            states.append((1 + 2 * s) * (1 - s) ** 2 * y + s**2 * (3 - 2 * s) * after + bend)
        if (step + 1) % steps == 0:
            states.append(after)
        y, slope = after, slope_after
    return np.stack(states[:samples])


def strides(dt: float, longest: float) -> tuple[int, int]:
    """Sampling intervals in a step, and steps in a sampling interval; one of them is 1."""
    return max(1, math.floor(longest / dt + 1e-9)), max(1, math.ceil(dt / longest - 1e-9))
