"""Units and time scale: which of those that come into question make what was measured possible.

Every combination of units is weighed by how likely it makes a few medians: the speed, the distance
to the nearest agent, the length of vehicles, the sampling interval, and whether speeds in the file
are those of its positions. Between the ends of a range that people or vehicles are seen in, a
median counts fully; outside, it falls off like a normal density of its logarithm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from nnode.data.limits import AGREE, INTERVAL, SWAYS, USUAL, Domain
from nnode.data.sequence import LENGTH_UNITS, SPEED_UNITS, TIME_UNITS
from nnode.data.trajectories import Trajectories

#: Frame rates of cameras and of published files, 1/s, the usual ones first: they win ties.
RATES = (25.0, 30.0, 10.0, 16.0, 15.0, 50.0, 60.0, 20.0, 24.0, 29.97, 12.5, 5.0, 2.5)


#: How sure something is, by its probability.
SURE, LIKELY = 0.95, 0.7
#: A rate that is no less probable than this fits.
FAIR = 0.05

#: Prior weights of units where no column's name has one: most data are in SI units.
_BEFORE = {
    "m": 1.0,
    "cm": 0.1,
    "ft": 0.03,
    "km": 0.01,
    "s": 1.0,
    "ms": 0.1,
    "us": 0.01,
    "ns": 0.1,
    "frame": 0.3,
    "m/s": 1.0,
    "km/h": 0.2,
    "ft/s": 0.03,
    "mph": 0.03,
}
#: The same for two coordinates that are of vehicles, though nothing names a vehicle or a lane.
_UNNAMED = 0.02
#: The same for another rate than the one that is told, which is copied from set to set.
_OTHER = 0.1
#: The same for a unit that the file says it is not.
_AGAINST = 0.002


#: Records of fewer samples say too little, and no more of them are looked at.
GAIT_LEAST, GAIT_MOST = 48, 150
#: Frequencies that are looked at, in cycles a sample.
GAIT_BAND = np.linspace(0.01, 0.45, 441)
#: Of a straight way, the share of its length that is left between its ends. People who walk in
#: curves sway across another direction at every moment.
GAIT_STRAIGHT = 0.95
#: A peak must stand so many times above the median of the spectrum.
GAIT_CLEAR = 6.0
#: Samples over which displacements are taken: the noise of single positions is small in them.
LAG = 10
#: Times at which distances between agents are taken.
MOMENTS = 100


@dataclass(frozen=True)
class Displacements:
    """Displacements.

    Attributes:
        first, last: ``(M,)`` rows between which they are.
        size, took: ``(M,)`` their lengths and times.
    """

    first: np.ndarray
    last: np.ndarray
    size: np.ndarray
    took: np.ndarray


def displacements(rows: Trajectories, lag: int = LAG) -> Displacements:
    """Displacements over ``lag`` unbroken samples of rows in order; over fewer where no agent has
    so many."""

    def unbroken(lag: int) -> np.ndarray:
        took = rows.time[lag:] - rows.time[: len(rows) - lag]
        same = rows.agent[lag:] == rows.agent[: len(rows) - lag]
        return np.flatnonzero(same & (took < 1.5 * lag * rows.dt))

    first = unbroken(min(lag, len(rows)))
    while lag > 1 and not first.size:
        lag //= 2
        first = unbroken(min(lag, len(rows)))
    last = first + lag
    size = np.linalg.norm(rows.x[last] - rows.x[first], axis=1)
    return Displacements(first, last, size, rows.time[last] - rows.time[first])


@dataclass(frozen=True)
class Medians:
    """What is known in the file's own units; NaN where it is not.

    Attributes:
        speed: of those that move, length by time.
        nearest: distance to the nearest agent at the same time, or to the next one in the lane.
        length: of vehicles.
        dt: sampling interval.
        ratio: distance covered by what the file's speeds say was covered.
        sway: of people, cycles per unit of time.
    """

    speed: float
    nearest: float
    length: float
    dt: float
    ratio: float
    sway: float


@dataclass(frozen=True)
class Scale:
    """Units of a file, and how sure they are.

    Attributes:
        domain: that they make possible.
        position, time, speed: units.
        rate: frames per second, where times are frames.
        probability: beside all other combinations.
    """

    domain: Domain
    position: str
    time: str
    speed: str
    rate: float | None
    probability: float = 1.0

    def __str__(self) -> str:
        clock = f"frames of 1/{self.rate:g} s" if self.rate else self.time
        who = "people" if self.domain == "crowd" else "vehicles"
        return f"{who}, positions in {self.position}, times in {clock}, speeds in {self.speed}"

    @property
    def units(self) -> tuple[str, ...]:
        """Domain and units, whatever the rate of frames."""
        return self.domain, self.position, self.time, self.speed

    @property
    def options(self) -> str:
        """Options that say units."""
        said = [f"data.position_unit={self.position}", f"data.time_unit={self.time}"]
        said += [f"data.frame_rate={self.rate:g}"] if self.rate else []
        return " ".join(said)

    @property
    def metres(self) -> float:
        """Of a unit of length."""
        return LENGTH_UNITS[self.position]

    @property
    def seconds(self) -> float:
        """Of a unit of time."""
        return TIME_UNITS[self.time] if self.rate is None else 1 / self.rate

    @property
    def per_second(self) -> float:
        """m/s of a unit of speed."""
        return SPEED_UNITS[self.speed]


def medians(rows: Trajectories, domain: Domain) -> Medians:
    """The medians of rows in order by which the scale is recognised."""
    moves = displacements(rows)
    speed = ratio = float("nan")
    if moves.size.size:
        each = moves.size / moves.took
        moving = each > 0.1 * np.percentile(each, 90)
        if moving.any():
            speed = float(np.median(each[moving]))
            ratio = _ratio(rows, moves, moving)
    length = float("nan")
    if rows.length is not None:
        # each agent once: standing ones have most rows
        lengths = rows.length[rows.ends()[0]]
        length = float(np.nanmedian(lengths)) if np.isfinite(lengths).any() else length
    clock = _sway(rows) if domain == "crowd" else float("nan")
    return Medians(speed, _nearest(rows, domain), length, rows.dt, ratio, clock)


def _sway(rows: Trajectories) -> float:
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
    total, number = np.zeros(len(GAIT_BAND)), 0
    for a, b in zip(start.tolist(), (last + 1).tolist(), strict=True):
        way = rows.x[b - 1] - rows.x[a]
        far = np.hypot(*way)
        if (
            b - a < GAIT_LEAST
            or not even[a : b - 1].all()
            or far <= GAIT_STRAIGHT * _length(rows.x[a:b])
        ):
            continue
        across = rows.x[a:b] @ np.array([-way[1], way[0]]) / far
        v = np.diff(across)
        v = (v - v.mean()) * np.hanning(len(v))
        power = np.abs(np.exp(-2j * np.pi * np.outer(GAIT_BAND, np.arange(len(v)))) @ v) ** 2
        if power.sum() > 0:
            total += power / power.sum()
            number += 1
        if number >= GAIT_MOST:
            break
    power = total * GAIT_BAND
    inner = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    if number < 3 or not inner.size:
        return float("nan")
    top = inner[np.argmax(power[inner])]
    if power[top] < GAIT_CLEAR * np.median(power):
        return float("nan")
    return float(GAIT_BAND[top] / rows.dt)


def _length(x: np.ndarray) -> float:
    """m along a path, by every sixteenth sample: noise and sway shall not count."""
    parts = np.concatenate([x[:-1:16], x[-1:]])
    return float(np.hypot(*np.diff(parts, axis=0).T).sum())


def _ratio(rows: Trajectories, moves: Displacements, moving: np.ndarray) -> float:
    """Median over displacements of how far it was, by how far speed times time says."""
    if rows.v is None:
        return float("nan")
    speed = np.linalg.norm(rows.v, axis=1)
    mean = (speed[1:] + speed[:-1]) / 2
    gone = np.concatenate([[0.0], np.nancumsum(mean * np.diff(rows.time))])
    said = (gone[moves.last] - gone[moves.first])[moving]
    moved = said > 0
    return float(np.median(moves.size[moving][moved] / said[moved])) if moved.any() else np.nan


def _nearest(rows: Trajectories, domain: Domain) -> float:
    """Median distance to the nearest agent at the same time, or to the next one in its lane; at
    :data:`MOMENTS` times."""
    every, at = np.unique(rows.time, return_inverse=True)
    lanes = np.zeros(len(rows)) if rows.lane is None else pd.factorize(rows.lane)[0]
    distances = []
    for k in np.unique(np.linspace(0, len(every) - 1, MOMENTS).astype(int)):
        present = np.flatnonzero(at == k)
        if domain == "traffic":
            lane = lanes[present]
            order = np.lexsort((rows.x[present, 0], lane))
            gaps = np.diff(rows.x[present, 0][order])[np.diff(lane[order]) == 0]
            distances.append(gaps[gaps > 0])
        elif len(present) > 1:
            distances.append(cKDTree(rows.x[present]).query(rows.x[present], k=2)[0][:, 1])
    each = np.concatenate(distances) if distances else np.empty(0)
    return float(np.median(each)) if each.size else float("nan")


def scales(
    measured: Mapping[Domain, Medians],
    stated: Mapping[str, str],
    *,
    frames: bool,
    rate: float | None = None,
    speeds: bool = False,
) -> list[Scale]:
    """All combinations of units, the most probable first.

    Args:
        measured: medians by the domains that come into question.
        stated: units by ``position``, ``time``, ``speed`` as the file states them.
        frames: whether times may be frames; then they are where ``stated`` says so.
        rate: frames per second that the file or the user states.
        speeds: whether the file has speeds.
    """
    clocks: list[tuple[str, float | None]] = [(unit, None) for unit in TIME_UNITS]
    if frames:
        clocks += [("frame", each) for each in dict.fromkeys([*([rate] if rate else []), *RATES])]
    scored = []
    for domain, values in measured.items():
        for position, (time, frame_rate), speed in product(
            LENGTH_UNITS, clocks, SPEED_UNITS if speeds else ("m/s",)
        ):
            candidate = Scale(domain, position, time, speed, frame_rate)
            score = _expected(position, stated.get("position")) + _expected(
                time, stated.get("time")
            )
            score += _expected(speed, stated.get("speed")) if speeds else 0.0
            score += math.log(_UNNAMED) if len(measured) > 1 and domain == "traffic" else 0.0
            if frame_rate is not None and frame_rate != rate:
                score += math.log((_OTHER if rate else 1.0) / len(RATES))
            scored.append((score + _likely(candidate, values), candidate))
    top = max(score for score, _ in scored)
    weights = np.array([math.exp(score - top) for score, _ in scored])
    weights /= weights.sum()
    order = np.argsort(-weights, kind="stable").tolist()
    return [replace(scored[i][1], probability=float(weights[i])) for i in order]


def certainty(probability: float) -> str:
    """A probability in words."""
    if probability >= SURE:
        return "sure"
    return "likely" if probability >= LIKELY else "a guess"


def _expected(unit: str, stated: str | None) -> float:
    if stated is None:
        return math.log(_BEFORE[unit])
    return 0.0 if unit == stated else math.log(_AGAINST * _BEFORE[unit])


def _likely(scale: Scale, measured: Medians) -> float:
    usual = USUAL[scale.domain]
    metres, seconds = scale.metres, scale.seconds
    score = usual["speed"].score(measured.speed * metres / seconds)
    score += usual["nearest"].score(measured.nearest * metres)
    score += INTERVAL.score(measured.dt * seconds)
    if "length" in usual:
        score += usual["length"].score(measured.length * metres)
    if "sway" in usual and measured.dt * seconds <= SWAYS:
        score += usual["sway"].score(measured.sway / seconds)
    return score + AGREE.score(measured.ratio * metres / (scale.per_second * seconds))
