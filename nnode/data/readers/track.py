"""Platoons on a test track: along-track positions from speeds and gaps, cutting, and laps.

The foremost vehicle of a platoon is where its integrated speed brings it, those behind it the
measured gaps further back. What the laps of a closed track come to checks integrated speeds.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from nnode.data.options import OpenAccOptions
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError

log = logging.getLogger(__name__)

#: What may be told of a vehicle.
KNOWN = ("make", "setting", "acc", "order")

#: Share by which a lap may be longer than another, or than the coordinates tell.
CLOSED = 0.01

#: m within which a vehicle is back where it was: the breadth of a road.
BACK = 10.0
#: m that a vehicle must have been away by in between.
AWAY = 50.0


@dataclass(frozen=True)
class Run:
    """A platoon's record, K equally spaced times of N vehicles in their order, 0 in front.

    Attributes:
        name: of the run.
        path: the file.
        start: s, of the first time.
        dt: s.
        v: ``(K, N)`` m/s, NaN where unknown.
        gap: ``(K, N)`` m from bumper to bumper to the vehicle in front; NaN where unknown.
        place: ``(K, N, 2)`` m, east and north, NaN where unknown.
        make: of every vehicle.
        acc: whether followers have adaptive cruise control.
        setting: its distance setting.
    """

    name: str
    path: Path
    start: float
    dt: float
    v: np.ndarray
    gap: np.ndarray
    place: np.ndarray
    make: tuple[str, ...]
    acc: bool
    setting: str

    def told(self, what: str | None) -> tuple[str, ...] | None:
        """What is told of every vehicle; of the one in front nothing that followers do."""
        if what is None:
            return None
        if what == "make":
            return self.make
        if what == "order":
            return tuple(str(i + 1) for i in range(len(self.make)))
        own = ("ACC" if self.acc else "people") if what == "acc" else self.setting
        return ("", *[own] * (len(self.make) - 1))


def check_laps(run: Run) -> None:
    """Say what the laps of the foremost vehicle with coordinates tell of integrated speeds."""
    known = np.flatnonzero(np.isfinite(run.place).all(axis=2).any(axis=0))
    if not len(known):
        return
    i = int(known[0])
    with np.errstate(over="ignore", invalid="ignore"):  # of coordinates that are none
        laps = find_laps(_driven(run.v[:, i], run.dt), run.place[:, i])
    if not len(laps.driven):
        return
    text = (
        f"{run.name}: complete laps of {run.make[i]}: {len(laps.driven)}, "
        f"{laps.driven.min():.1f} to {laps.driven.max():.1f} m by its speed, "
        f"{laps.path.min():.1f} to {laps.path.max():.1f} m by its coordinates"
    )
    if max(laps.spread, abs(laps.excess)) > CLOSED:
        log.warning("%s: they differ by more than %g %%", text, 100 * CLOSED)
    else:
        log.info("%s", text)


def _driven(v: np.ndarray, dt: float) -> np.ndarray:
    """``(K,)`` m by a speed, trapezoidal, over holes by the line between their ends."""
    k = np.arange(len(v))
    known = np.isfinite(v)
    if not known.any():
        return np.zeros(len(v))
    whole = np.interp(k, k[known], v[known])
    return np.concatenate([[0.0], np.cumsum((whole[1:] + whole[:-1]) / 2 * dt)])


def _filled(values: np.ndarray, most: int) -> np.ndarray:
    """``(K, N)`` values with holes of at most ``most`` samples interpolated."""
    full = values.copy()
    for column in full.T:
        known = np.flatnonzero(np.isfinite(column))
        for a, b in pairwise(known):
            if 1 < b - a <= most + 1:
                column[a : b + 1] = np.interp(np.arange(a, b + 1), (a, b), (column[a], column[b]))
    return full


def _sound(run: Run, v: np.ndarray, most: float | None) -> np.ndarray:
    """``(K, N)`` gaps without those that are none: not above 0, or between samples of which one
    contradicts the speeds by more than ``most`` m."""
    gap = run.gap.copy()
    gap[gap <= 0] = np.nan
    if most is not None:
        relative = np.full_like(v, np.nan)
        relative[:, 1:] = v[:, :-1] - v[:, 1:]
        off = np.abs(np.diff(gap, axis=0) - (relative[1:] + relative[:-1]) / 2 * run.dt) > most
        gap[1:][off] = np.nan
        gap[:-1][off] = np.nan
    for i in np.flatnonzero((np.isfinite(run.gap) & np.isnan(gap)).any(axis=0)):
        bad = np.isfinite(run.gap[:, i]) & np.isnan(gap[:, i])
        log.info(
            "%s: %d of %d gaps of %s to %s are not above 0, or change otherwise than their speeds "
            "tell (data.max_error); they count as unknown",
            run.name,
            bad.sum(),
            np.isfinite(run.gap[:, i]).sum(),
            run.make[i],
            run.make[i - 1],
        )
    return gap


def cut_run(run: Run, options: OpenAccOptions) -> Iterator[Sequence]:
    """Cut a run into platoons, see :func:`nnode.data.readers.openacc.read_openacc`."""
    most = int(options.fill / run.dt + 1e-6)  # samples that may be missing
    v = _filled(run.v, most)
    sound = _sound(run, v, options.max_error)
    gap = _filled(sound, most)
    added = (np.isfinite(v) & np.isnan(run.v)) | (np.isfinite(gap) & np.isnan(sound))
    driven = np.stack([_driven(column, run.dt) for column in v.T], 1)
    every = round((options.dt or run.dt) / run.dt)
    if every < 1 or abs((options.dt or run.dt) / run.dt - every) > 1e-6 * every:
        raise ConfigError(
            f"data.dt={options.dt:g} s is no multiple of the {run.dt:g} s of {run.path.name}"
        )
    v, gap, driven, added = v[::every], gap[::every], driven[::every], added[::every]
    dt = run.dt * every
    # with the vehicle in front; the first has nobody there
    linked = np.isfinite(v) & np.isfinite(gap)
    linked[:, 1:] &= np.isfinite(v[:, :-1])
    linked[:, 0] = False
    number = 0
    for first, last in _intervals(linked, dt, options):
        rows = slice(first, last + 1)
        whole = linked[rows].all(axis=0)
        heads = [int(i) for i in np.flatnonzero(~whole) if np.isfinite(v[rows, i]).all()]
        for i in heads:
            after = np.flatnonzero(~whole[i + 1 :])
            end = i + 1 + int(after[0]) if len(after) else len(whole)
            if end - i < options.min_vehicles:
                continue
            made = _sequence(run, number, (i, end), rows, (v, gap, driven), dt, options)
            yield replace(made, filled=int(added[rows, i:end].sum()))
            number += 1


def _intervals(linked: np.ndarray, dt: float, options: OpenAccOptions) -> Iterator[tuple[int, int]]:
    """First and last sample of windows, or of maximal intervals with the same links."""
    if options.window is None:
        changes = np.flatnonzero((linked[1:] != linked[:-1]).any(axis=1)) + 1
        for first, after in pairwise([0, *changes.tolist(), len(linked)]):
            if (after - 1 - first) * dt >= options.min_duration - 1e-6:
                yield first, after - 1
        return
    steps = round(options.window / dt)
    if steps < 1 or abs(options.window / dt - steps) > 1e-6 * steps:
        raise ConfigError(
            f"data.window={options.window:g} s is no whole number of steps of {dt:g} s"
        )
    for first in range(0, len(linked) - steps, steps):
        yield first, first + steps


def _sequence(
    run: Run,
    number: int,
    cars: tuple[int, int],
    rows: slice,
    values: tuple[np.ndarray, np.ndarray, np.ndarray],
    dt: float,
    options: OpenAccOptions,
) -> Sequence:
    v, gap, driven = values
    i, end = cars
    behind = gap[rows, i + 1 : end] + (options.length or 0.0)
    x = np.concatenate([driven[rows, i : i + 1], np.zeros_like(behind)], 1)
    x[:, 1:] = x[:, :1] - np.cumsum(behind, axis=1)
    back = slice(end - 1, i - 1 if i else None, -1)  # the last vehicle first, the leader last

    def words(what: str | None) -> tuple[str, ...] | None:
        told = run.told(what)
        return None if told is None or not any(told) else told[back]

    names = [
        make if run.make.count(make) == 1 else f"{make}_{place + 1}"
        for place, make in enumerate(run.make)
    ]
    return Sequence(
        name=f"{run.name}/{number:03d}",
        recording=run.name,
        time=run.start + dt * np.arange(rows.start, rows.stop),
        x=x[:, ::-1, None],
        v=v[rows, back, None],
        agents=tuple(names[back]),
        length=None if options.length is None else np.full(end - i, options.length),
        kind=words(options.kind),
        group=words(options.group),
    )


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
    known = np.flatnonzero(np.isfinite(place).all(axis=1) & np.isfinite(driven))
    if not len(known):
        return Laps(np.empty(0), np.empty(0))
    driven, place = driven[known], place[known]
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
