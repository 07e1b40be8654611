"""Measured positions with holes and noise: interpolated, smoothed, and how noisy they are.

Local cubics (Savitzky & Golay 1964) do both. Holes of up to ``data.fill`` seconds are filled.
Smoothing is off by default: a model is calibrated to what was measured. Positions from video carry
errors that differences amplify; ``data.smooth`` asks for the positions and speeds of local cubics
instead, and ``data.start_speeds=smoothed`` for first speeds by parabolas, positions as they are.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace

import numpy as np

from nnode.data.limits import BEARABLE
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError

#: Degree of the polynomials: the least that follows an acceleration that changes.
DEGREE = 3
#: s of positions that tell a smoothed first speed: errors of 0.3 m that are new at every 0.1 s then
#: leave 0.4 m/s, and an acceleration that changes by 1 m/s³ as much.
START = 2.0
#: s of positions on either side of a hole that the cubic across it is fitted to. Within holes of
#: 0.1 to 0.5 s of cars that accelerate, its positions have a smaller error than a straight line's
#: at every noise from 0 to 0.3 m. A line would also bias speeds: it is late by 0.04 to 0.2 m/s
#: where a car accelerates, the cubic by less than 0.01 m/s (table in docs/data.md).
REACH = 0.5
#: Least number of samples by which noise is told: five fourth differences.
LEAST = 9
#: s, windows of ``data.smooth`` that are suggested.
WINDOWS = (1.0, 1.5, 2.0, 3.0, 4.0)

#: Median of the size of a standard normal variable, and the sum of squares of 1, 4, 6, 4, 1.
_MEDIAN, _FOURTH = 0.6745, 70.0


@dataclass(frozen=True)
class Noise:
    """Errors of measurement that are new at every sample, as standard deviations.

    Errors that last over several samples do not show in differences and are not counted.

    Attributes:
        position: m, of one coordinate; NaN where no sequence is long enough.
        start_speed: m/s, of the speeds that simulations start with: measured ones, or forward
            differences of positions.
    """

    position: float
    start_speed: float

    @property
    def beyond(self) -> bool:
        """Whether first speeds are wrong by more than BEARABLE."""
        return self.start_speed > BEARABLE

    def plain(self) -> dict[str, float | None]:
        """For a manifest: ``position`` (m) and ``start_speed`` (m/s), None where unknown."""
        return {name: value if np.isfinite(value) else None for name, value in asdict(self).items()}

    def __str__(self) -> str:
        if not np.isfinite(self.position):
            return "noise of measured positions: unknown, as sequences have fewer than 9 samples"
        return (
            f"noise of measured positions: {self.position:.2g} m (standard deviation, by fourth "
            f"differences); standard error of initial speeds: {self.start_speed:.2g} m/s"
        )


def measured_noise(sequences: Iterable[Sequence]) -> Noise:
    """The noise of measured sequences.

    Of every agent the median size of fourth differences, in which motion hardly shows, divided by
    that of unit noise; of all agents the median. Half of the samples, or of the agents, may be
    faulty. On simulated cars that accelerate, noise of 0.02, 0.1 and 0.3 m at 5, 10 and 25 Hz is
    found to 2 % (table in docs/data.md).
    """
    places: list[np.ndarray] = []
    speeds: list[np.ndarray] = []
    for s in sequences:
        if s.n_samples < LEAST or not s.n_agents:
            continue
        noise = _noise(s.x)
        places.append(noise)
        # a forward difference holds the errors of two positions
        speeds.append(np.sqrt(2) * noise / s.dt if s.v is None else _noise(s.v))
    position, start = (_usual(noise) for noise in (places, speeds))
    return Noise(position, start)


def _noise(x: np.ndarray) -> np.ndarray:
    """``(N,)`` standard deviations of the noise of ``(K, N, D)``, NaN where nothing is known."""
    size = np.abs(np.diff(x, 4, axis=0)).transpose(1, 0, 2).reshape(x.shape[1], -1)
    measured = np.isfinite(size).any(axis=1)
    deviations = np.full(x.shape[1], np.nan)
    deviations[measured] = np.nanmedian(size[measured], axis=1) / (_MEDIAN * np.sqrt(_FOURTH))
    return deviations


def _usual(parts: list[np.ndarray]) -> float:
    values = np.concatenate(parts) if parts else np.empty(0)
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else float("nan")


def suggested_window(noise: Noise, dt: float) -> float:
    """The shortest window (s) of ``data.smooth`` whose speeds are uncertain by BEARABLE at most.

    It is at most 4 s: longer ones flatten what a driver does.
    """
    from scipy.signal import savgol_coeffs  # loads scipy.stats, which takes a second

    for window in WINDOWS:
        samples = 2 * round(window / dt / 2) + 1
        if samples >= DEGREE + 2:
            slope = np.linalg.norm(savgol_coeffs(samples, DEGREE, deriv=1, delta=dt))
            if noise.position * slope <= BEARABLE:
                return window
    return WINDOWS[-1]


def smooth_speeds(sequence: Sequence, window: float) -> Sequence:
    """A sequence with the speeds of local cubics in place of the measured ones.

    First speeds are those of :func:`start_smoothed`. Positions stay as they are. It is what a
    simulation gets where the noise is :attr:`Noise.beyond`: the vehicle in front, whose measured
    speed acts on the others at every time, as well as those that start.

    Args:
        window: s, of the cubics, such as that of :func:`suggested_window`.
    """
    v = smooth_columns(sequence.time, sequence.x, window)[1]
    return start_smoothed(replace(sequence, v=v))


def across(time: np.ndarray, x: np.ndarray, i: int, at: np.ndarray) -> np.ndarray:
    """Positions in the hole between samples ``i`` and ``i + 1``.

    They are those of a cubic fitted by least squares to the samples up to REACH s before the hole
    and behind it; of a straight line, where these are fewer than four.

    Args:
        time: ``(K,)`` s, ascending, of the known samples.
        x: ``(K, D)`` m.
        at: ``(M,)`` s.

    Returns:
        ``(M, D)`` m.
    """
    low = int(np.searchsorted(time, time[i] - REACH - 1e-6))
    high = int(np.searchsorted(time, time[i + 1] + REACH + 1e-6))
    rows = slice(low, high) if high - low > DEGREE else slice(i, i + 2)
    middle = (time[i] + time[i + 1]) / 2
    degree = DEGREE if high - low > DEGREE else 1
    powers = np.vander(time[rows] - middle, degree + 1)
    coefficients = np.linalg.lstsq(powers, x[rows] - x[i], rcond=None)[0]
    return np.asarray(np.vander(at - middle, degree + 1) @ coefficients + x[i])


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
    from scipy.signal import savgol_filter

    smoothed = savgol_filter(even, samples, DEGREE)
    speed = savgol_filter(even, samples, DEGREE, deriv=1, delta=step)
    return np.interp(time, grid, smoothed), np.interp(time, grid, speed)


def smooth_columns(time: np.ndarray, x: np.ndarray, window: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and speeds by :func:`smooth` of every column of ``(K, ..., D)``; with D = 1, of
    vehicles, speeds are at least 0, as one that stands shall not roll back."""
    columns = [smooth(time, column, window) for column in x.reshape(len(x), -1).T]
    smoothed, v = (np.stack(part, -1).reshape(x.shape) for part in zip(*columns, strict=True))
    return smoothed, np.maximum(v, 0.0) if x.shape[-1] == 1 else v


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
