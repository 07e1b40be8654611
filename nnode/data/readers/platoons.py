"""From vehicles' rows to platoons: lane by lane, on one time grid, with the same vehicles in view.

The way of the data follows Section 4.2 of the calibration paper: every lane by itself, the
lateral coordinate dropped, positions interpolated to a reference time grid, and sequences cut
in which the same vehicles are in view.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from nnode.data.identity import given_anew, numbered
from nnode.data.options import Agents, LaneOptions
from nnode.data.readers.recordings import check_known, positive, wanted
from nnode.data.sequence import Sequence
from nnode.data.smooth import bridge, smooth
from nnode.errors import ConfigError, DataError

log = logging.getLogger(__name__)

#: A step longer than so many usual ones is a hole.
HOLE = 1.5


#: Times are counted in steps up to this number: it is exact, and adding to it as well.
_LATEST = 2.0**52


@dataclass(frozen=True, kw_only=True)
class Vehicles:
    """Rows of one recording, one per vehicle and time, in any order and in SI units.

    Attributes:
        path: the file they come from.
        row: where the i-th row stands in the file, in words.
        vehicle: identifiers, ``(rows,)`` text.
        time: ``(rows,)`` s.
        x: ``(rows,)`` m, growing as vehicles drive on.
        lane: ``(rows,)`` names, or None where there is one lane.
        speed: ``(rows,)`` m/s, at least 0, or None.
        length: ``(rows,)`` m, NaN where unknown, or None.
        kind: ``(rows,)`` class codes, or None.
    """

    path: Path
    row: Callable[[int], str]
    vehicle: np.ndarray
    time: np.ndarray
    x: np.ndarray
    lane: np.ndarray | None = None
    speed: np.ndarray | None = None
    length: np.ndarray | None = None
    kind: np.ndarray | None = None


@dataclass(frozen=True)
class _Stint:
    """A vehicle's uninterrupted stay in one lane, on the reference time grid.

    Sample k of ``x`` (m) and ``speed`` (m/s) belongs to the grid's time ``first + k``; ``filled``
    says whether it lies in a hole of the record.
    """

    vehicle: str
    first: int
    x: np.ndarray
    filled: np.ndarray
    speed: np.ndarray | None
    length: float
    kind: str | None

    @property
    def last(self) -> int:
        return self.first + len(self.x) - 1


def cut_vehicles(
    recordings: Mapping[str, Vehicles], options: LaneOptions, lane_word: str = "lane"
) -> list[Sequence]:
    """Cut a file's recordings into sequences.

    Without ``window`` a sequence is a maximal interval during which the same vehicles are in
    view. With it, time is cut into consecutive windows that share their boundary sample, and a
    sequence is a platoon of vehicles in view throughout; where a vehicle is in view for part of
    the window, the platoon is cut at its place, so that nobody follows a vehicle that is not
    its leader. With ``pairs`` a sequence is a vehicle and the one in front of it, as long as that
    is the same one, in whole windows where there are such.

    Args:
        recordings: by name, to which ``_`` and the lane are added.
        options: lanes, time grid and the way of cutting, checked by :func:`check_cutting`.
        lane_word: stands before the lane's name.

    Returns:
        Sequences named ``recording/number``. Vehicles are ordered by position, the leader last.

    Raises:
        ConfigError: an unknown lane or recording.
        DataError: one vehicle twice at one time, or no sequence at all.
    """
    chosen = _lanes(options, recordings.values())
    lanes_of = {
        stem: {
            f"{stem}_{lane_word}{lane}" if lane else stem: stints
            for lane, stints in _stints(rows, options, chosen, stem).items()
        }
        for stem, rows in recordings.items()
    }
    lanes = {name: stints for rows in lanes_of.values() for name, stints in rows.items()}
    asked = wanted(options.recording)
    if asked is not None:
        check_known(asked, lanes)
        lanes = {name: lanes[name] for name in asked}
    site = {name: stem for stem, rows in lanes_of.items() for name in rows}
    found = [
        _sequence(f"{name}/{number:03d}", name, site[name], platoon, first, last, options.dt)
        for name, stints in lanes.items()
        for number, (platoon, first, last) in enumerate(_cut(stints, options))
    ]
    if not found:
        vehicles = {stint.vehicle for stints in lanes.values() for stint in stints}
        path = next(iter(recordings.values())).path
        raise DataError(
            f"{path}: no sequence; at no time are {options.min_vehicles} vehicles in one "
            f"lane for {options.min_samples} samples of {options.dt:g} s"
            + (f" throughout a window of {options.window:g} s" if options.window else "")
            + f" ({len(vehicles)} vehicles, {len(lanes)} lanes); lower data.min_vehicles, "
            "data.min_samples or data.window"
        )
    return found


def check_cutting(options: LaneOptions) -> None:
    """Refuse options of the cutting that are out of their range.

    Raises:
        ConfigError: names the option.
    """
    positive("dt", options.dt)
    positive("max_hole", options.max_hole)
    if options.smooth is not None:
        positive("smooth", options.smooth)
    if options.min_vehicles < 1 or options.min_samples < 1:
        raise ConfigError("data.min_vehicles and data.min_samples must be at least 1")
    if options.window is not None:
        samples = positive("window", options.window) / options.dt
        if abs(samples - round(samples)) > 1e-6:
            raise ConfigError(
                f"data.window={options.window:g} s is no whole number of steps of "
                f"data.dt={options.dt:g} s"
            )
        if round(samples) + 1 < options.min_samples:
            raise ConfigError(
                f"data.window={options.window:g} s has {round(samples) + 1} samples, fewer than "
                f"data.min_samples={options.min_samples}"
            )


def _lanes(options: LaneOptions, recordings: Iterable[Vehicles]) -> list[str]:
    present: set[str] = set()
    for rows in recordings:
        if rows.lane is None and options.lane is not None:
            raise ConfigError(
                f"data.lane={options.lane}, but {rows.path} has no lane column; set "
                "data.columns.lane or data.lane=null"
            )
        present |= {""} if rows.lane is None else set(rows.lane)
    known = sorted(present, key=lambda name: (len(name), name))
    if options.lane is None:
        return known
    chosen = [options.lane] if isinstance(options.lane, str | int | float) else options.lane
    names = [f"{x:g}" if isinstance(x, int | float) else str(x) for x in chosen]
    for name in names:
        if name not in present:
            raise ConfigError(
                f"data.lane={name}: {rows.path} has the lanes {', '.join(known[:20])}"
            )
    return names


def _stints(
    recording: Vehicles, options: LaneOptions, lanes: list[str], stem: str
) -> dict[str, list[_Stint]]:
    """Every vehicle's stays by lane, on the reference time grid."""
    vehicle, lane = recording.vehicle, recording.lane
    length, kind = recording.length, recording.kind
    far = np.flatnonzero(~(np.abs(recording.time) < _LATEST * options.dt))
    if far.size:
        raise DataError(
            f"{recording.path}, {recording.row(int(far[0]))}: the time is "
            f"{recording.time[far[0]]:g} s, which steps of {options.dt:g} s cannot count; "
            "correct it"
        )
    ids, code = np.unique(vehicle.astype(str), return_inverse=True)
    order = np.lexsort((recording.time, code))
    time, x, code = recording.time[order], recording.x[order], code[order]
    speed = None if recording.speed is None else recording.speed[order]
    step, other = np.diff(time), np.diff(code) != 0
    twice = np.flatnonzero(~other & (step <= 0))
    if twice.size:
        i, j = sorted(order[twice[0] : twice[0] + 2])
        raise DataError(
            f"{recording.path}, {recording.row(j)}: vehicle {vehicle[j]} at time "
            f"{recording.time[j]:g} s stands there a second time (first in {recording.row(i)}); "
            "expected one row per vehicle and time"
        )
    hole = ~other & (step > options.max_hole + 1e-9)
    usual = float(np.median(step[~other])) if (~other).any() else 0.0
    number = np.ones(len(order), dtype=int)
    if options.agents is Agents.auto:
        number = _numbers(ids[code], time, x, other, hole, stem)
    taken = set(ids)
    if options.smooth is not None:
        x, speed = _smoothed(time, x, other | hole, options.smooth)
    cut = other | hole
    if lane is not None:
        cut |= lane[order][1:] != lane[order][:-1]
    names_of_kinds = {str(code): str(name) for code, name in dict(options.kinds).items()}
    present = {""} if lane is None else set(lane)
    found: dict[str, list[_Stint]] = {name: [] for name in lanes if name in present}
    for rows in np.split(np.arange(len(order)), np.flatnonzero(cut) + 1):
        i = order[rows[0]]
        place = "" if lane is None else lane[i]
        if place not in found:
            continue
        first = int(np.ceil(time[rows[0]] / options.dt - 1e-6))
        last = int(np.floor(time[rows[-1]] / options.dt + 1e-6))
        if last < first:
            continue
        grid = np.arange(first, last + 1) * options.dt
        own_time, own_x, _ = bridge(time[rows], x[rows, None], options.max_hole)
        code_of_kind = "" if kind is None else kind[i]
        found[place].append(
            _Stint(
                vehicle=numbered(str(ids[code[rows[0]]]), int(number[rows[0]]), taken),
                first=first,
                x=np.interp(grid, own_time, own_x[:, 0]),
                filled=_within_holes(grid, time[rows], usual),
                speed=None if speed is None else np.interp(grid, time[rows], speed[rows]),
                length=np.nan if length is None else float(length[i]),
                kind=None if kind is None else names_of_kinds.get(code_of_kind, code_of_kind),
            )
        )
    return found


def _within_holes(grid: np.ndarray, time: np.ndarray, usual: float) -> np.ndarray:
    """``(K,)`` whether a grid time lies in a hole between rows, away from these."""
    after = np.searchsorted(time, grid - 1e-6).clip(0, len(time) - 1)
    before = np.maximum(after - 1, 0)
    hole = time[after] - time[before] > HOLE * usual
    return np.asarray(hole & (time[after] > grid + 1e-6) & (time[before] < grid - 1e-6))


def _numbers(
    ids: np.ndarray, time: np.ndarray, x: np.ndarray, other: np.ndarray, hole: np.ndarray, stem: str
) -> np.ndarray:
    """Each row's vehicle among those of its identifier, counted from 1."""
    new = given_anew(time, x, other, hole)
    if new.any():
        row = int(np.flatnonzero(new)[0]) + 1
        log.info(
            "%s: %d identifiers are used again for another vehicle, after a time or over a "
            "distance that are none of one vehicle (such as %s, another one from %g s on); "
            "data.agents=global takes them as they stand",
            stem, len(set(ids[1:][new])), ids[row], time[row],
        )  # fmt: skip
    so_far = np.concatenate([[0], np.cumsum(new)])
    start = np.concatenate([[0], np.where(other, np.arange(1, len(ids)), 0)])
    return np.asarray(1 + so_far - so_far[np.maximum.accumulate(start)])


def _smoothed(
    time: np.ndarray, x: np.ndarray, cut: np.ndarray, window: float
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and speeds, every record without a hole by itself."""
    parts = [
        smooth(time[rows], x[rows], window)
        for rows in np.split(np.arange(len(time)), np.flatnonzero(cut) + 1)
    ]
    speed = np.concatenate([v for _, v in parts])
    # a vehicle that stands shall not roll back
    return np.concatenate([own for own, _ in parts]), np.maximum(speed, 0.0)


_Platoon = tuple[list[_Stint], int, int]


def _cut(stints: list[_Stint], options: LaneOptions) -> Iterator[_Platoon]:
    """Vehicles, first and last grid time of every sequence of one lane, in order of time."""
    if not stints:
        return
    if options.pairs:
        pieces, least = _pairs(stints, options), 2
    else:
        pieces = _intervals(stints) if options.window is None else _windows(stints, options)
        least = options.min_vehicles
    for platoon, first, last in pieces:
        if len(platoon) >= least and last - first + 1 >= options.min_samples:
            yield sorted(platoon, key=lambda s: s.x[first - s.first]), first, last


def _intervals(stints: list[_Stint]) -> Iterator[_Platoon]:
    changes = sorted({s.first for s in stints} | {s.last + 1 for s in stints})
    for first, after in pairwise(changes):
        yield [s for s in stints if s.first <= first and s.last >= after - 1], first, after - 1


def _pairs(stints: list[_Stint], options: LaneOptions) -> Iterator[_Platoon]:
    """Followers with their leaders, as long as nobody comes between them, in order of time."""
    spans: dict[tuple[int, int], list[tuple[_Stint, _Stint, int, int]]] = {}
    for platoon, first, last in _intervals(stints):
        row = sorted(platoon, key=lambda s: s.x[first - s.first])
        for follower, leader in pairwise(row):
            known = spans.setdefault((id(follower), id(leader)), [])
            if known and known[-1][3] + 1 == first:
                first_of_all = known.pop()[2]
                known.append((follower, leader, first_of_all, last))
            else:
                known.append((follower, leader, first, last))
    found = sorted((span for own in spans.values() for span in own), key=lambda span: span[2])
    for follower, leader, first, last in found:
        steps = last - first if options.window is None else round(options.window / options.dt)
        for start in range(first, last - steps + 1, max(steps, 1)):
            yield [follower, leader], start, start + steps


def _windows(stints: list[_Stint], options: LaneOptions) -> Iterator[_Platoon]:
    assert options.window is not None
    steps = round(options.window / options.dt)
    start, end = min(s.first for s in stints), max(s.last for s in stints)
    # only windows in which somebody is in view: two stays may lie years apart
    busy = {
        k
        for s in stints
        for k in range((s.first - start) // steps - 1, (s.last - start) // steps + 1)
    }
    for first in sorted(start + k * steps for k in busy if 0 <= k <= (end - start) // steps - 1):
        last = first + steps
        seen = [s for s in stints if s.first <= last and s.last >= first]
        whole = [s for s in seen if s.first <= first and s.last >= last]
        if not whole:
            continue
        whole.sort(key=lambda s: s.x[first - s.first])
        x = np.stack([s.x[first - s.first : last - s.first + 1] for s in whole], axis=1)
        broken: set[int] = set()
        for s in seen:
            if s.first > first or s.last < last:
                a, b = max(first, s.first), min(last, s.last)
                own = s.x[a - s.first : b - s.first + 1]
                behind = (x[a - first : b - first + 1] < own[:, None]).sum(axis=1)
                broken.update(int(n) for n in behind)
        borders = sorted({0, len(whole)} | broken)
        for low, high in pairwise(borders):
            yield whole[low:high], first, last


def _sequence(
    name: str, recording: str, site: str, platoon: list[_Stint], first: int, last: int, dt: float
) -> Sequence:
    def cut(values: list[np.ndarray]) -> np.ndarray:
        parts = zip(platoon, values, strict=True)
        return np.stack([v[first - s.first : last - s.first + 1] for s, v in parts], axis=1)

    speeds = [s.speed for s in platoon if s.speed is not None]
    kinds = tuple(s.kind for s in platoon if s.kind is not None)
    length = np.array([s.length for s in platoon])
    return Sequence(
        name=name,
        recording=recording,
        site=site,
        time=np.arange(first, last + 1) * dt,
        x=cut([s.x for s in platoon])[:, :, None],
        v=cut(speeds)[:, :, None] if speeds else None,
        agents=tuple(s.vehicle for s in platoon),
        length=None if np.isnan(length).all() else length,
        kind=kinds or None,
        filled=int(cut([s.filled for s in platoon]).sum()),
    )
