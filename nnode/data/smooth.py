"""Smoothing of measured positions: cubics fitted to a moving window (Savitzky & Golay 1964).

Off by default: a model is calibrated to what was measured. Positions from video carry errors that
differences amplify; ``data.smooth`` asks for the positions and speeds of local cubics instead.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import savgol_filter

from nnode.errors import ConfigError

#: Degree of the polynomials: the least that follows an acceleration that changes.
DEGREE = 3


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
