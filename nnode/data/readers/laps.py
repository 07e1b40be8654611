"""What the laps of a closed track tell of integrated speeds."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from nnode.data.trajectories import Trajectories, driven

log = logging.getLogger(__name__)

#: Share by which a lap may be longer than another, or than the coordinates tell.
CLOSED = 0.01

#: m within which a vehicle is back where it was: the breadth of a road.
BACK = 10.0
#: m that a vehicle must have been away by in between.
AWAY = 50.0


def check_laps(run: Trajectories) -> None:
    """Say what the laps of the foremost vehicle with coordinates tell of integrated speeds.

    Args:
        run: rows with coordinates (east and north, m) as positions.
    """
    located = np.flatnonzero(np.isfinite(run.x).all(axis=1))
    if not len(located) or run.v is None:
        return
    rows = np.flatnonzero(run.agent == run.agent[located[0]])
    rows = rows[np.argsort(run.time[rows], kind="stable")]
    with np.errstate(over="ignore", invalid="ignore"):  # of coordinates that are none
        laps = find_laps(driven(run.time[rows], run.v[rows, 0]), run.x[rows])
    if not len(laps.driven):
        return
    text = (
        f"{run.name}: complete laps of {run.agent[located[0]]}: {len(laps.driven)}, "
        f"{laps.driven.min():.1f} to {laps.driven.max():.1f} m by its speed, "
        f"{laps.path.min():.1f} to {laps.path.max():.1f} m by its coordinates"
    )
    if max(laps.spread, abs(laps.excess)) > CLOSED:
        log.warning("%s: they differ by more than %g %%", text, 100 * CLOSED)
    else:
        log.info("%s", text)


@dataclass(frozen=True)
class Laps:
    """A vehicle's complete laps.

    Attributes:
        driven: m per lap, by integrated speed.
        path: m per lap, along the measured coordinates.
    """

    driven: np.ndarray
    path: np.ndarray

    @property
    def spread(self) -> float:
        """Greatest deviation of a lap from their median, as a share of it; 0 without two laps."""
        usual = np.median(self.driven) if len(self.driven) else 1.0
        return float(np.abs(self.driven / usual - 1).max()) if len(self.driven) > 1 else 0.0

    @property
    def excess(self) -> float:
        """By which share more is driven than the coordinates tell; 0 without a lap."""
        return float(self.driven.sum() / self.path.sum() - 1) if len(self.driven) else 0.0


def find_laps(driven: np.ndarray, place: np.ndarray) -> Laps:
    """Laps between passes of the point where a vehicle is first known to be.

    Args:
        driven: ``(K,)`` m, integrated speed.
        place: ``(K, 2)`` m, coordinates; NaN where they are unknown.
    """
    located = np.flatnonzero(np.isfinite(place).all(axis=1) & np.isfinite(driven))
    if not len(located):
        return Laps(np.empty(0), np.empty(0))
    driven, place = driven[located], place[located]
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    start = int(np.argmax(driven - driven[0] > BACK))  # not while it stands before it starts
    apart = np.linalg.norm(place - place[start], axis=1)
    passes, k = [start], start
    while True:
        away = np.flatnonzero(apart[k:] > AWAY)
        near = np.flatnonzero(apart[k + away[0] :] < BACK) if len(away) else away
        if not len(near):
            break
        first = k + int(away[0]) + int(near[0])
        leaves = np.flatnonzero(apart[first:] >= BACK)
        if not len(leaves):
            break
        k = first + int(np.argmin(apart[first : first + int(leaves[0])]))
        passes.append(k)
    # within a step the pass is where the way there and the way on are closest to the point
    at = [_along(place, i, place[start]) for i in passes]
    samples = np.arange(len(driven))
    return Laps(np.diff(np.interp(at, samples, driven)), np.diff(np.interp(at, samples, path)))


def _along(place: np.ndarray, i: int, point: np.ndarray) -> float:
    """Where the track passes a point, in samples, near sample ``i``."""
    ahead = place[min(i + 1, len(place) - 1)] - place[max(i - 1, 0)]
    length = float(ahead @ ahead)
    steps = min(i + 1, len(place) - 1) - max(i - 1, 0)
    shift = float((point - place[i]) @ ahead) / length * steps if length else 0.0
    return i + float(np.clip(shift, -1.0, 1.0))
