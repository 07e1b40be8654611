"""Smoothing of measured positions: cubics fitted to a moving window (Savitzky & Golay 1964).

Off by default: a model is calibrated to what was measured. Positions from video carry errors that
differences amplify; ``data.smooth`` asks for the positions and speeds of local cubics instead, and
``data.start_speeds=smoothed`` for first speeds by parabolas, positions as they are.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import savgol_filter

from nnode.data.sequence import Sequence
from nnode.errors import ConfigError

#: Degree of the polynomials: the least that follows an acceleration that changes.
DEGREE = 3
#: s of positions that tell a smoothed first speed: errors of 0.3 m that are new at every 0.1 s then
#: leave 0.4 m/s, and an acceleration that changes by 1 m/s³ as much.
START = 2.0


def smooth(time: np.ndarray, x: np.ndarray, window: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and speeds of local cubics.

    A record that is shorter than the window is one cubic; one with too few samples for that
    stays as it is.

    Args:
        time: ``(K,)`` s, ascending; where steps differ, x is interpolated to the usual one.
        x: ``(K,)`` m.
        window: s.

    Returns:
        ``(K,)`` m and ``(K,)`` m/s at ``time``.

    Raises:
        ConfigError: a window of fewer samples than a cubic needs to smooth at all.
    """
    if len(time) < DEGREE + 2:
        return x, np.gradient(x, time) if len(time) > 1 else np.zeros_like(x)
    step = float(np.median(np.diff(time)))
    samples = 2 * round(window / step / 2) + 1
    if samples < DEGREE + 2:
        raise ConfigError(
            f"data.smooth={window:g} s holds {samples} samples of {step:g} s; a cubic smooths "
            f"{DEGREE + 2} or more: set data.smooth={(DEGREE + 1) * step:g} at least, or null"
        )
    grid = time[0] + step * np.arange(round((time[-1] - time[0]) / step) + 1)
    if len(grid) < DEGREE + 2:
        return x, np.gradient(x, time)
    even = np.interp(grid, time, x)
    samples = min(samples, len(grid) - 1 + len(grid) % 2)
    found = savgol_filter(even, samples, DEGREE)
    speed = savgol_filter(even, samples, DEGREE, deriv=1, delta=step)
    return np.interp(time, grid, found), np.interp(time, grid, speed)


def start_smoothed(sequence: Sequence) -> Sequence:
    """A sequence whose first speeds are slopes of parabolas (constant acceleration), fitted to the
    first START s; vehicles' are at least 0. One with too few samples stays as it is."""
    number = min(sequence.n_samples, round(START / sequence.dt) + 1)
    if number < DEGREE + 1:
        return sequence
    x, v = sequence.x[:number], sequence.velocity().copy()
    time = sequence.time[:number] - sequence.time[0]
    slope = np.polynomial.polynomial.polyfit(time, x.reshape(number, -1), 2)[1]
    v[0] = slope.reshape(x.shape[1:])
    if x.shape[2] == 1:
        v[0] = np.maximum(v[0], 0.0)
    return replace(sequence, v=v)
