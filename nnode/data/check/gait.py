"""The clock that walking people carry: they sway from side to side once in two steps."""

from __future__ import annotations

import numpy as np

from nnode.data.trajectories import Trajectories

#: Records of fewer samples say too little, and no more of them are looked at.
LEAST, MOST = 48, 150
#: Frequencies that are looked at, in cycles a sample.
BAND = np.linspace(0.01, 0.45, 441)
#: Of a straight way, the share of its length that is left between its ends. People who walk in
#: curves sway across another direction at every moment.
STRAIGHT = 0.95
#: A peak must stand so many times above the median of the spectrum.
CLEAR = 6.0


def sway(rows: Trajectories) -> float:
    """Frequency of people's lateral sway, in cycles per unit of the time of rows in order.

    The spectrum of velocities across everyone's way, a mean over people, times the frequency, as
    slow turns would hide a sway of some centimetres. NaN where no peak stands out: in records
    that are short, coarse or smoothed.

    Sources: 2.0 ± 0.13 steps a second throughout a day (MacDougall & Moore 2005, Journal of
    Applied Physiology 99), 1.8 to 2.0 in shops and on bridges (Pachi & Ji 2005, The Structural
    Engineer 83); a sway takes two steps.
    """
    start, last = rows.ends()
    even = np.abs(np.diff(rows.time) - rows.dt) < 0.01 * rows.dt
    total, number = np.zeros(len(BAND)), 0
    for a, b in zip(start.tolist(), (last + 1).tolist(), strict=True):
        way = rows.x[b - 1] - rows.x[a]
        far = np.hypot(*way)
        if b - a < LEAST or not even[a : b - 1].all() or far <= STRAIGHT * _length(rows.x[a:b]):
            continue
        across = rows.x[a:b] @ np.array([-way[1], way[0]]) / far
        v = np.diff(across)
        v = (v - v.mean()) * np.hanning(len(v))
        power = np.abs(np.exp(-2j * np.pi * np.outer(BAND, np.arange(len(v)))) @ v) ** 2
        if power.sum() > 0:
            total += power / power.sum()
            number += 1
        if number >= MOST:
            break
    power = total * BAND
    inner = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    if number < 3 or not inner.size:
        return float("nan")
    top = inner[np.argmax(power[inner])]
    if power[top] < CLEAR * np.median(power):
        return float("nan")
    return float(BAND[top] / rows.dt)


def _length(x: np.ndarray) -> float:
    """m along a path, by every sixteenth sample: noise and sway shall not count."""
    parts = np.concatenate([x[:-1:16], x[-1:]])
    return float(np.hypot(*np.diff(parts, axis=0).T).sum())
