"""Quality of measured data: faults of sequences, findings about files, and what is left out.

A fault is what no vehicle and no person can have done; :func:`find_faults` looks for faults in
every sequence, and ``data.faults`` says what becomes of it. A finding is what ``nnode check``
reports of a file: errors of its cells, rows and clock, and the faults of its sequences.
Preparation, calibration and diagnosis use the words of this module; all thresholds are those of
:mod:`nnode.data.limits`.

Accelerations of single samples are not judged: positions from video are uncertain by metres (second
differences of the ESIMAS positions reach 8 m within 0.2 s although nothing is wrong with the path),
so a limit would condemn noise.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from nnode.data.clusters import components
from nnode.data.limits import (
    AGREE,
    BEARABLE,
    EDGE,
    FEW,
    FRICTION,
    HOLE,
    INTERVAL,
    LIMITS,
    MANY,
    NOISY,
    SWAYS,
    UNEVEN,
    USUAL,
    Domain,
    Limits,
)
from nnode.data.options import Faults
from nnode.data.readers.columns import Table, floats, quoted
from nnode.data.sequence import Sequence
from nnode.data.smooth import Noise, suggested_window
from nnode.data.trajectories import Trajectories, grouped_rows
from nnode.data.units import RATES, Medians, Scale, displacements
from nnode.errors import DataError, FaultError

#: Every kind of fault, with what it means.
KINDS: dict[str, str] = {
    "zero_row": "positions that are exactly zero: the filling of a table where no agent is",
    "identity_swap": "an agent's path carries on under another agent's name or number",
    "jump": "a displacement between two samples that exceeds the greatest possible speed",
    "backward": "a vehicle that goes backwards by more than the position error",
    "overtaking": "vehicles of one lane that are not in the order of their positions",
    "overlap": "two agents at one place: two cars by their fronts, or a front and the length of "
    "the car ahead; centres of two people",
    "duplicate": "two agents with one identifier or with the same positions throughout",
    "gap_in_time": "unequal time steps, or an agent without a position at some times",
    "non_finite": "a position that is infinite or has only one coordinate",
    "too_short": "fewer samples or agents than a model can be compared with",
}

#: Kinds that no simulation can start from or be compared with.
UNUSABLE = frozenset({"gap_in_time", "non_finite", "duplicate"})

#: A step of more than this share of all positions, against the usual direction, begins a new round
#: of a circular road; the smallest number of such steps.
ROUND, SOME = 0.9, 3

#: Steps whose median displacement extrapolates a path; more than one, as steps are noisy.
RECENT = 3

#: Pairs of positions near each other that are looked at one by one; each takes 24 bytes.
PAIRS = 10**7

#: m, beyond which squares of distances may be no numbers.
_FAR = 1e150

#: Positions that may be joined by distances within a path's reach where swaps are looked for.
CROWDED = 2000


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        kind: a key of :data:`KINDS`.
        sequence: the sequence's name.
        agents: positions of the agents in the sequence (0 is the first).
        time: s, of the first sample that shows it, or None where it is not bound to a time.
        detail: what was found, in words.
    """

    kind: str
    sequence: str
    agents: tuple[int, ...]
    time: float | None
    detail: str


def find_faults(sequence: Sequence, domain: Domain, noise: float = 0.0) -> list[Fault]:
    """Every fault of a sequence, in order of time; those without a time come first.

    NaN means that an agent has no position at that time.

    Args:
        noise: m, standard deviation of the noise of positions where it is known: a step holds that
            of two positions, and is no fault up to NOISY times its deviation.
    """
    limits = LIMITS[domain]
    error = max(limits.noise, NOISY * np.sqrt(2) * np.nan_to_num(noise))
    limits = replace(limits, noise=float(error))
    view = _View(sequence, domain, limits)
    faults = [*_short(view), *_times(view), *_values(view), *_duplicates(view)]
    if sequence.n_samples and sequence.n_agents:
        faults += [*_zero_rows(view), *_displacements(view)]
        faults += [*_order(view, faults), *_bumpers(view)] if domain == "traffic" else []
        faults += _overlaps(view)
    return sorted(faults, key=lambda f: -np.inf if f.time is None else f.time)


def usable(sequence: Sequence, faults: list[Fault]) -> bool:
    """Whether a sequence can be simulated at all, whatever its faults."""
    return sequence.n_samples > 1 and not any(fault.kind in UNUSABLE for fault in faults)


def by_kind(faults: Iterable[Iterable[Fault]]) -> dict[str, int]:
    """Number of sequences with each kind of fault, the most frequent first.

    Args:
        faults: of every sequence.
    """
    counts = Counter(kind for of_sequence in faults for kind in {f.kind for f in of_sequence})
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def kinds_text(faults: Iterable[Iterable[Fault]]) -> str:
    """Number of sequences with each kind of fault, in words; empty without any."""
    return ", ".join(f"{kind} in {n}" for kind, n in by_kind(faults).items())


class _View:
    """A sequence with the helpers that the checks share."""

    def __init__(self, sequence: Sequence, domain: Domain, limits: Limits) -> None:
        self.sequence, self.domain, self.limits = sequence, domain, limits
        x = sequence.x
        self.time = sequence.time
        # A vehicle that merely starts at the origin has a single zero there.
        zero = (x == 0).all(axis=2)
        repeated = np.zeros_like(zero)
        repeated[1:] |= zero[1:] & zero[:-1]
        repeated[:-1] |= zero[1:] & zero[:-1]
        self.zero = repeated
        self.x = np.where((repeated | ~np.isfinite(x).all(axis=2))[:, :, None], np.nan, x)
        steps = np.diff(sequence.time)
        self.dt = float(np.median(steps)) if steps.size else float("nan")

    def fault(self, kind: str, agents: tuple[int, ...], sample: int | None, detail: str) -> Fault:
        time = None if sample is None else float(self.time[sample])
        if time is not None and not np.isfinite(time):
            time = None
        return Fault(kind, self.sequence.name, agents, time, detail)

    def each(
        self, kind: str, mask: np.ndarray, text: Callable[[int, np.ndarray], str], agents: int = 1
    ) -> Iterator[Fault]:
        """A fault of every column of ``(K, N)`` in which something holds at any sample.

        Args:
            text: by the number of the column and the numbers of these samples.
            agents: 2 where a column stands for an agent and its leader.
        """
        for i in map(int, np.flatnonzero(mask.any(axis=0))):
            k = np.flatnonzero(mask[:, i])
            yield self.fault(kind, tuple(range(i, i + agents)), int(k[0]), text(i, k))

    def who(self, i: int) -> str:
        """An agent in words."""
        word = "car" if self.domain == "traffic" else "person"
        if self.sequence.agents:
            return f"{word} {i} (id {self.sequence.agents[i]})"
        return f"{word} {i}"

    def where(self, k: int, i: int) -> str:
        """A position in words."""
        return ", ".join(f"{value:.1f}" for value in self.sequence.x[k, i])


def _short(view: _View) -> Iterator[Fault]:
    limits, s = view.limits, view.sequence
    for number, needed, what in (
        (s.n_samples, limits.min_samples, "samples"),
        (s.n_agents, limits.min_agents, "agents"),
    ):
        if number < needed:
            text = f"{number} {what}, at least {needed} are needed"
            yield view.fault("too_short", (), None, text)


def _times(view: _View) -> Iterator[Fault]:
    steps = np.diff(view.time)
    if not np.isfinite(view.time).all():
        yield view.fault("non_finite", (), None, "a sampling time is no number")
        return
    uneven = np.flatnonzero(~(np.abs(steps - view.dt) <= UNEVEN * abs(view.dt)))
    if uneven.size or (steps.size and view.dt <= 0):
        k = int(uneven[0]) if uneven.size else 0
        text = f"a step of {steps[k]:g} s among steps of {view.dt:g} s"
        yield view.fault("gap_in_time", (), k + 1, text)


def _values(view: _View) -> Iterator[Fault]:
    x = view.sequence.x
    absent = np.isnan(x).all(axis=2)
    broken = ~np.isfinite(x).all(axis=2) & ~absent

    def text(what: str, i: int, k: np.ndarray) -> str:
        span = f"{view.time[k[0]]:g}-{view.time[k[-1]]:g} s"
        return f"{view.who(i)} {what} at {len(k)} of {len(x)} samples ({span})"

    yield from view.each("gap_in_time", absent, partial(text, "has no position"))
    yield from view.each("non_finite", broken, partial(text, "has a position that is no number"))


def _duplicates(view: _View) -> Iterator[Fault]:
    s = view.sequence
    same: dict[str | bytes, list[int]] = {}
    for i, name in enumerate(s.agents):
        same.setdefault(name, []).append(i)
    for i in range(s.n_agents):
        if not np.isnan(s.x[:, i]).any():
            same.setdefault(s.x[:, i].tobytes(), []).append(i)
    for key, agents in same.items():
        if len(agents) > 1:
            text = f"{len(agents)} agents have the same positions at all {s.n_samples} samples"
            if isinstance(key, str):
                text = f"identifier {key} is given to {len(agents)} agents"
            yield view.fault("duplicate", tuple(agents), None, text)


def _zero_rows(view: _View) -> Iterator[Fault]:
    return view.each(
        "zero_row",
        view.zero,
        lambda i, k: f"{view.who(i)} is at exactly zero at {len(k)} of {len(view.x)} samples",
    )


def _displacements(view: _View) -> Iterator[Fault]:
    """Jumps, vehicles that go backwards, and swaps of identity that look like either."""
    limits, x = view.limits, view.x
    step = np.diff(x, axis=0)
    size = np.linalg.norm(step, axis=2)
    far = size > limits.max_speed * view.dt + limits.noise
    back = np.zeros_like(far)
    if view.domain == "traffic":
        far |= step[:, :, 0] < -(limits.max_reverse * view.dt + limits.noise)
        back = (step[:, :, 0] < -limits.noise) & ~far
    broken = far | back
    sound = np.where(broken[:, :, None], np.nan, step)
    for k in map(int, np.flatnonzero(broken.any(axis=1))):
        swaps = _continuations(x[k] + _expected(sound, k), x[k + 1], limits.reach)
        swaps = {i: j for i, j in swaps.items() if broken[k, i] or broken[k, j]}
        involved = set(swaps) | set(swaps.values())
        if swaps:
            text = "; ".join(
                f"the path of {view.who(i)} carries on as {view.who(j)}" for i, j in swaps.items()
            )
            yield view.fault("identity_swap", tuple(sorted(involved)), k + 1, text)
        for i in map(int, np.flatnonzero(broken[k])):
            if i not in involved:
                text = (
                    f"{view.who(i)} goes from {view.where(k, i)} to {view.where(k + 1, i)} m "
                    f"within {view.dt:g} s"
                )
                kind = "jump" if far[k, i] else "backward"
                yield view.fault(kind, (i,), k + 1, text)


def _expected(sound: np.ndarray, k: int) -> np.ndarray:
    """Displacements (N, D) to expect in step k: usual for the agent just before, else for all."""
    everyone = sound.reshape(-1, sound.shape[2])
    everyone = everyone[np.isfinite(everyone).all(axis=1)]
    usual = np.median(everyone, axis=0) if len(everyone) else np.zeros(sound.shape[2])
    before = sound[max(k - RECENT, 0) : k]
    measured = np.isfinite(before).any(axis=0)
    of_agent = np.nanmedian(np.where(measured, before, 0.0), axis=0) if len(before) else usual
    return np.where(measured, of_agent, usual)


def _continuations(expected: np.ndarray, then: np.ndarray, reach: float) -> dict[int, int]:
    """Which agent's next position continues which agent's path, where it is not its own."""
    continues: dict[int, int] = {}
    for rows, columns in _groups(expected, then, reach):
        cost = np.minimum(cdist(expected[rows], then[columns]), reach)
        for a, b in zip(*linear_sum_assignment(cost), strict=True):
            i, j = int(rows[a]), int(columns[b])
            if i != j and cost[a, b] < reach:
                continues[i] = j
    return dict(sorted(continues.items()))


def _groups(a: np.ndarray, b: np.ndarray, reach: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Numbers of points of ``a`` and ``b`` (N, D) that are joined by distances up to ``reach``.

    Points of different groups are farther apart, so that each group is a problem of its own. Groups
    of more than :data:`CROWDED` points are left out: paths cannot be told apart there.
    """
    before, after = np.flatnonzero(_placed(a)), np.flatnonzero(_placed(b))
    i, j = _near(a[before], b[after], reach)
    n = len(a)
    for group in grouped_rows(components(2 * n, np.stack([before[i], n + after[j]], axis=1))):
        if 1 < len(group) <= CROWDED:
            yield group[group < n], group[group >= n] - n


def _placed(x: np.ndarray) -> np.ndarray:
    """Which positions (..., D) are known, and have squares."""
    return np.asarray((np.abs(x) < _FAR).all(axis=-1))


def _near(a: np.ndarray, b: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the points of ``a`` (N, D) and ``b`` (M, D) that are not farther than ``reach``.

    Of more than :data:`PAIRS` pairs each point's two nearest stand for all, so that memory grows
    with the number of points and not with its square.
    """
    if not len(a) or not len(b):
        return np.empty(0, int), np.empty(0, int)
    tree, other = cKDTree(a), cKDTree(b)
    # a little farther, because trees compare squares; the caller decides at the limit
    reach *= 1 + 1e-9
    if tree.count_neighbors(other, reach) <= PAIRS:
        pairs = tree.sparse_distance_matrix(other, reach, output_type="ndarray")
        return pairs["i"], pairs["j"]
    _, j = other.query(a, k=2, distance_upper_bound=reach)
    i = np.repeat(np.arange(len(a)), 2)
    within = j.ravel() < len(b)
    return i[within], j.ravel()[within]


def _order(view: _View, faults: list[Fault]) -> Iterator[Fault]:
    """Neighbours in the lane that are not in the order of their positions."""
    gap = np.diff(view.x[:, :, 0], axis=1)
    swapped = [set(f.agents) for f in faults if f.kind == "identity_swap"]
    # After a swap the wrong order is its consequence, not another fault.
    sound = [not any({i, i + 1} <= agents for agents in swapped) for i in range(gap.shape[1])]
    return view.each(
        "overtaking",
        (gap < 0) & np.array(sound, dtype=bool),
        lambda i, k: (
            f"{view.who(i)} is up to {-np.nanmin(gap[:, i]):.1f} m ahead of "
            f"{view.who(i + 1)}, its leader, at {len(k)} of {len(view.x)} samples"
        ),
        agents=2,
    )


def _bumpers(view: _View) -> Iterator[Fault]:
    """Vehicles whose front is in the vehicle ahead, by more than the error of one position."""
    if view.sequence.length is None:
        return iter(())
    gap, length = np.diff(view.x[:, :, 0], axis=1), view.sequence.length[1:]
    # fronts that are nearer, or in the wrong order, are another fault
    return view.each(
        "overlap",
        (gap >= view.limits.spacing) & (length - gap > view.limits.noise),
        lambda i, k: (
            f"the front of {view.who(i)} is {gap[k, i].min():.2f} m behind that of "
            f"{view.who(i + 1)}, which is {length[i]:.2f} m long, at {len(k)} of {len(view.x)} "
            "samples"
        ),
        agents=2,
    )


def _overlaps(view: _View) -> Iterator[Fault]:
    x, limit = view.x, view.limits.spacing
    time, agent = np.nonzero(_placed(x))
    # times lie apart by more than the limit in a dimension of their own
    points = np.column_stack([x[time, agent], 2 * limit * time])
    i, j = _near(points, points, limit)
    distance = np.sqrt(((x[time[i], agent[i]] - x[time[j], agent[j]]) ** 2).sum(axis=1))
    near = pd.DataFrame(
        {
            "first": np.minimum(agent[i], agent[j]),
            "second": np.maximum(agent[i], agent[j]),
            "sample": time[i],
            "distance": distance,
        }
    )
    near = near[(near["first"] < near["second"]) & (near["distance"] < limit)]
    # each pair is listed in both orders
    pairs = near.drop_duplicates(["first", "second", "sample"]).groupby(["first", "second"])
    spans = pairs.agg({"sample": ["min", "size"], "distance": "min"})
    for pair, sample, number, smallest in spans.sort_values(
        ("sample", "min"), kind="stable"
    ).itertuples(name=None):
        a, b = map(int, pair)
        text = (
            f"{view.who(a)} and {view.who(b)} are down to {smallest:.2f} m apart at {number} of "
            f"{len(x)} samples, less than {limit:g} m"
        )
        yield view.fault("overlap", (a, b), int(sample), text)


@dataclass(frozen=True)
class Finding:
    """What the check of a file reports.

    Attributes:
        kind: a word for it; of faults, the kind of :data:`KINDS`.
        level: ``error``: results would be wrong; ``warning``: look at it; ``note``: to know.
        text: the description, with numbers and with what to do.
    """

    kind: str
    level: str
    text: str


#: Meanings of columns with a value for every sample.
_SAMPLED = ("x", "y", "x_follower", "x_leader")


def cell_findings(table: Table, columns: Mapping[str, str]) -> Iterator[Finding]:
    """Cells without a number where one is needed, and agents without a name.

    Args:
        columns: of the table, by meaning.
    """
    for meaning, column in columns.items():
        cells = table.frame[column]
        empty = cells.isna().to_numpy()
        bad = empty if meaning == "agent" else ~np.isfinite(floats(cells))
        if meaning in _SAMPLED and not bad.all():  # an empty cell is a missing sample
            bad &= ~empty
        if bad.any():
            i = int(np.flatnonzero(bad)[0])
            shown = "nothing" if empty[i] else quoted(cells.iloc[i])[:42]
            yield Finding(
                "cells",
                "error",
                f"column {column!r} ({meaning}) holds no number in {bad.sum()} of {len(cells)} "
                f"rows, first {shown} in {table.row(i)}; correct or remove these rows",
            )


def order_findings(rows: Trajectories, identical: int) -> Iterator[Finding]:
    """One agent twice at one time, and rows that are not in order of time.

    Args:
        identical: number of rows that repeat an earlier row of the file in all columns.
    """
    code, time = pd.factorize(rows.agent)[0], rows.time
    pairs = pd.DataFrame({"agent": code, "time": time})
    repeated = pairs.duplicated().to_numpy() & np.isfinite(time)
    if repeated.any():
        i = int(np.flatnonzero(repeated)[0])
        yield Finding(
            "duplicates",
            "error",
            f"{repeated.sum()} rows repeat the agent and the time of an earlier row ({identical} "
            f"of them in all columns), first agent {rows.agent[i]} at {time[i]:g} in "
            f"{rows.where(i)}; keep one row per agent and time, or tell agents of one name apart",
        )
    by_agent = np.argsort(code, kind="stable")
    back = (np.diff(time[by_agent]) < 0) & (np.diff(code[by_agent]) == 0)
    if back.any():
        i = int(by_agent[np.flatnonzero(back)[0] + 1])
        yield Finding(
            "unsorted",
            "note",
            f"{back.sum()} rows follow later ones of their agent, first in {rows.where(i)}; the "
            "readers sort them",
        )


def row_findings(
    rows: Trajectories, medians: Medians, scale: Scale, stated: float | None, whole: bool
) -> Iterator[Finding]:
    """What rows in order and in SI units show before they are cut into sequences.

    Args:
        medians: in the file's own units.
        scale: those units.
        stated: frames per second that the file or the user states.
        whole: whether records begin and end where agents enter and leave, not where they were cut.
    """
    yield from _sampling(rows)
    yield from _clock(medians, scale, stated)
    yield from _accelerations(rows)
    yield from _circular_road(rows, scale.domain)
    yield from _directions(rows, scale.domain)
    yield from _entering_and_leaving(rows, scale.domain, whole)


def _sampling(rows: Trajectories) -> Iterator[Finding]:
    """Sampling interval, uneven steps, holes (s)."""
    steps, dt = rows.steps, rows.dt
    if not steps.size:
        yield Finding(
            "rate", "error", "no agent has two rows at different times; nothing moves here"
        )
        return
    holes = steps > HOLE * dt
    uneven = ((np.abs(steps - dt) > UNEVEN * dt) & ~holes).mean()
    text = f"sampled every {dt:.4g} s ({1 / dt:.4g} in a second)"
    level = "note"
    if uneven > FEW:
        level = "warning"
        text += f"; {uneven:.0%} of the steps differ by more than {UNEVEN:.0%}"
    if INTERVAL.score(dt) < -2:
        level = "warning"
        text += f"; unusual: {INTERVAL.source}"
    yield Finding("rate", level, text)
    if holes.any():
        yield Finding(
            "holes",
            "warning" if holes.mean() > FEW else "note",
            f"{holes.sum()} holes in agents' records, the longest of {steps.max():.3g} s",
        )


def _clock(medians: Medians, scale: Scale, stated: float | None) -> Iterator[Finding]:
    """Whether the clock is right, by speeds in the file and by what is possible."""
    speed = medians.speed * scale.metres / scale.seconds
    ratio = medians.ratio * scale.metres / (scale.per_second * scale.seconds)
    usual = USUAL[scale.domain]["speed"]
    who = "people walk" if scale.domain == "crowd" else "vehicles drive"
    if stated is not None and scale.rate is not None and abs(scale.rate / stated - 1) > 0.01:
        speeds = f"; its own velocities say {speed / ratio:.3g} m/s" if np.isfinite(ratio) else ""
        yield Finding(
            "time_scale",
            "error",
            f"at the stated {stated:g} frames/s, {who} "
            f"{medians.speed * scale.metres * stated:.3g} m/s (median of those who move){speeds}: "
            f"{scale.rate:g} frames/s fit",
        )
    elif np.isfinite(ratio) and AGREE.score(ratio) < -4:
        if scale.rate is not None:
            right = scale.rate / ratio
            near = min(RATES, key=lambda r: abs(np.log(r / right)))
            cure = f"a rate of {right:.3g} frames/s would agree"
            cure += f", such as {near:g}" if abs(near / right - 1) < 0.05 else ""
        else:
            cure = (
                f"times multiplied by {ratio:.3g} would agree, or positions divided by it: ask how "
                "both were made"
            )
        yield Finding(
            "time_scale",
            "error",
            f"by their positions {who} {speed:.3g} m/s (median of those who move), by the file's "
            f"own velocities {speed / ratio:.3g} m/s; {cure}",
        )
    sway = medians.sway / scale.seconds
    walk = USUAL["crowd"]["sway"]
    if scale.domain == "crowd" and medians.dt * scale.seconds <= SWAYS and np.isfinite(sway):
        text = f"people sway {sway:.3g} times in a second; expected {walk.low:g} to {walk.high:g}"
        if stated is None and scale.rate is not None:
            yield Finding("gait", "note", f"{text}: the frame rate is taken from this")
        elif walk.score(sway) > -4:
            yield Finding("gait", "note", f"{text}: the time scale is right to about a tenth")
        else:
            right = 1 / np.sqrt(walk.low * walk.high) * sway
            cure = f"times multiplied by {right:.2g} would be usual"
            if scale.rate is not None:
                cure = f"{scale.rate / right:.3g} frames/s would be usual"
            yield Finding("time_scale", "error", f"{text} ({walk.source}); {cure}")
    if np.isfinite(speed) and usual.score(speed) < -2:
        yield Finding(
            "speed",
            "error" if usual.score(speed) < -8 else "warning",
            f"{who} {speed:.3g} m/s (median of those who move); expected {usual.low:g} to "
            f"{usual.high:g} m/s: {usual.source}; check rate and units",
        )


def _accelerations(rows: Trajectories) -> Iterator[Finding]:
    """Impossible accelerations over a second (m/s²).

    Steps that are too long, and identifiers that are swapped, are faults of the sequences.
    """
    moves = displacements(rows, max(1, round(1.0 / rows.dt)) if rows.dt > 0 else 1)
    if not moves.size.size:
        return
    v = (rows.x[moves.last] - rows.x[moves.first]) / moves.took[:, None]
    # the next second of the same agent begins where this one ends
    following = np.searchsorted(moves.first, moves.last).clip(max=moves.first.size - 1)
    joined = moves.first[following] == moves.last
    a = np.linalg.norm(v[following] - v, axis=1)[joined] / moves.took[joined]
    if a.size and (a > FRICTION).mean() > 0.001:
        yield Finding(
            "acceleration",
            "warning",
            f"{(a > FRICTION).mean():.1%} of the changes of speed over a second exceed "
            f"{FRICTION:g} m/s², what friction can give; 99 % are below "
            f"{np.percentile(a, 99):.3g} m/s²: the time scale or the positions are off",
        )


def _circular_road(rows: Trajectories, domain: Domain) -> Iterator[Finding]:
    """Positions that begin again where a vehicle has gone round a circular road (m)."""
    if domain != "traffic":
        return
    moves = displacements(rows, 1)
    step = (rows.x[moves.last] - rows.x[moves.first])[:, 0]
    again = np.abs(step) > ROUND * np.ptp(rows.x[:, 0])
    usual = np.median(step[~again]) if not again.all() else 0.0
    # a faulty position makes two steps, there and back
    if again.sum() < SOME or (step[again] * usual >= 0).any():
        return
    length = float(np.median(np.abs(step[again]) + abs(usual)))
    yield Finding(
        "circular_road",
        "error",
        f"positions begin again {again.sum()} times, after about {length:.4g} m, as on a circular "
        "road; let them go on, for each vehicle of each recording by numpy.unwrap(x, "
        f"period={length:.4g}) with the length of the road",
    )


def _directions(rows: Trajectories, domain: Domain) -> Iterator[Finding]:
    """Directions in which agents go (m)."""
    start, end = rows.ends()
    net = rows.x[end] - rows.x[start]
    if domain == "traffic":  # by median steps: a single wrong one does not turn a vehicle
        same = rows.agent[1:] == rows.agent[:-1]
        step = pd.Series(np.diff(rows.x[:, 0])[same]).groupby(rows.agent[1:][same]).median()
        usual = np.array(step.reindex(rows.agent[start]).fillna(0.0), dtype=float)
        net = (usual * (end - start))[:, None]
    went = np.abs(net).max(axis=1) > 3 * LIMITS[domain].noise
    if not went.any():
        return
    if domain == "crowd":
        axis = int(np.argmax(np.abs(net[went]).sum(axis=0)))
        forth = float((net[went, axis] > 0).mean())
        yield Finding(
            "direction",
            "note",
            f"people walk along {'xy'[axis]}, {forth:.0%} of them towards larger values",
        )
        return
    back = net[went, 0] < 0
    if back.all():
        text = "all vehicles drive towards smaller positions; data.direction=-1 turns them"
        yield Finding("direction", "warning", text)
    elif back.any():
        lanes = np.full(went.sum(), "") if rows.lane is None else rows.lane[start][went]
        mixed = [name for name in dict.fromkeys(lanes) if 0 < back[lanes == name].mean() < 1]
        where = f" in lane {_listed(mixed)}" if mixed and rows.lane is not None else ""
        ways = "both ways" + where if mixed else "one way in some lanes, the other way in others"
        yield Finding(
            "direction",
            "error" if min(back.mean(), 1 - back.mean()) > EDGE else "warning",
            f"vehicles drive {ways}: {back.mean():.0%} of {back.size} towards smaller positions; "
            "choose one direction with data.lane, or tell the lanes apart",
        )


def _entering_and_leaving(rows: Trajectories, domain: Domain, whole: bool) -> Iterator[Finding]:
    """How many agents are present, and whose record breaks off where nobody can leave (m, s)."""
    start, end = rows.ends()
    times, count = np.unique(rows.time, return_counts=True)
    yield Finding(
        "agents",
        "note",
        f"{len(start)} {'people' if domain == 'crowd' else 'vehicles'} in "
        f"{times[-1] - times[0]:.5g} s, {np.median(count):.0f} at a time (at most {count.max()}), "
        f"each for {np.median(rows.time[end] - rows.time[start]):.3g} s",
    )
    if not whole:
        return
    axis = int(np.argmax(np.abs(rows.x[end] - rows.x[start]).sum(axis=0)))
    low, high = np.percentile(rows.x[:, axis], [1, 99])
    edge = EDGE * (high - low)
    part = np.zeros(len(rows), int) if rows.recording is None else rows.recording
    clock = pd.Series(rows.time).groupby(part)

    def inside(chosen: np.ndarray, moments: pd.Series) -> np.ndarray:
        at = rows.x[chosen, axis]
        away = np.abs(rows.time[chosen] - moments.to_numpy()[chosen]) > rows.dt
        return np.asarray((at > low + edge) & (at < high - edge) & away)

    born, gone = inside(start, clock.transform("min")), inside(end, clock.transform("max"))
    if not (born.any() or gone.any()):
        return
    continued = _continued(rows, start[born], end[gone], LIMITS[domain].reach)
    text = (
        f"{born.sum()} agents appear and {gone.sum()} vanish in the middle of what is covered, "
        "away from its ends and from the recording's or sequence's"
    )
    if continued:
        before, after = continued[0]
        text += (
            f"; {len(continued)} of those who appear carry on where another broke off (such as "
            f"{before} as {after}): identifiers change along the way"
        )
    many = max(born.mean(), gone.mean()) > EDGE
    yield Finding("broken", "warning" if continued or many else "note", text)


def _continued(
    rows: Trajectories, born: np.ndarray, gone: np.ndarray, reach: float
) -> list[tuple[str, str]]:
    """Agents that end and others that begin where these would be, within ten samples."""
    if not (len(born) and len(gone)):
        return []
    names = set()
    # time as a third coordinate: ten samples count like the reach
    clock = reach / (10 * rows.dt)
    before = np.maximum(gone - 1, 0)
    v = (rows.x[gone] - rows.x[before]) / rows.dt
    v[rows.agent[before] != rows.agent[gone]] = 0
    tree = cKDTree(np.column_stack([rows.x[born], clock * rows.time[born]]))
    for k in range(1, 11):
        then = rows.x[gone] + k * rows.dt * v
        at = np.column_stack([then, clock * (rows.time[gone] + k * rows.dt)])
        away, which = tree.query(at, distance_upper_bound=reach / 2)
        for i in np.flatnonzero(np.isfinite(away)):
            row = born[which[i]]
            late = rows.time[row] - rows.time[gone[i]]
            if 0 < late < 10.5 * rows.dt and rows.agent[row] != rows.agent[gone[i]]:
                names.add((rows.agent[gone[i]], rows.agent[row]))
    return sorted(names)


def sequence_findings(
    sequences: list[Sequence], faults: Mapping[str, list[Fault]], noise: Noise, domain: Domain
) -> Iterator[Finding]:
    """Interpolated samples, noise and faults of the sequences that a reader makes.

    Args:
        faults: by the sequence's name.
    """
    if filled := interpolated(sequences):
        yield Finding("filled", "note", interpolated_text(filled))
    if sequences and np.isfinite(noise.position):
        text, level = str(noise), "note"
        if noise.beyond:
            law = "a law of second order" if domain == "traffic" else "a social force"
            window = suggested_window(noise, sequences[0].dt)
            text += f", above the limit of {BEARABLE:g} m/s for {law}; "
            if domain == "traffic":
                text += "training and fits estimate initial speeds from smoothed paths; "
            text += f"data.smooth={window:g} (s) smooths positions and speeds"
            level = "warning"
        yield Finding("noise", level, text)
    for kind, number in by_kind(faults.values()).items():
        if kind == "too_short":
            continue
        first = next(f for of_sequence in faults.values() for f in of_sequence if f.kind == kind)
        yield Finding(
            kind,
            "error" if number > MANY * len(sequences) else "warning",
            f"{KINDS[kind]}: in {number} of {len(sequences)} sequences, first in {first.sequence}"
            + (f" at {first.time:g} s" if first.time is not None else "")
            + f": {first.detail}",
        )


#: Faults, sequences and names that a message lists.
LISTED = 5


def _listed(names: list[str]) -> str:
    others = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(names[:LISTED]) + others


def drop_absent(sequences: list[Sequence]) -> tuple[list[Sequence], list[dict[str, Any]]]:
    """Leave out people who are not present throughout their sequence, as the paper does.

    Returns:
        The sequences with the people who stay, and per person left out a dict with
        ``sequence``, ``agent`` and ``why``.
    """
    kept, absent = [], []
    for s in sequences:
        missing = np.isnan(s.x).all(axis=2).sum(axis=0)
        for i in np.flatnonzero(missing):
            why = f"absent at {missing[i]} of {s.n_samples} samples"
            name = s.agents[i] if s.agents else str(i)
            absent.append({"sequence": s.name, "agent": name, "why": why})
        kept.append(s.select(missing == 0) if missing.any() else s)
    return kept, absent


def apply_policy(
    policy: Faults, sequences: list[Sequence], faults: Mapping[str, list[Fault]]
) -> tuple[list[Sequence], list[dict[str, Any]]]:
    """Choose the sequences that stay.

    Args:
        policy: ``drop`` leaves faulty sequences out, ``keep`` only those that cannot be
            simulated at all, ``error`` refuses any.
        sequences: all of them.
        faults: each sequence's faults by its name.

    Returns:
        Sequences to keep, and per dropped one a dict with ``sequence`` and ``reasons``.

    Raises:
        FaultError: faults, with ``error``; lists the first few.
        DataError: nothing is left.
    """
    faulty = [s for s in sequences if faults[s.name]]
    if policy is Faults.error and faulty:
        every = [fault for s in faulty for fault in faults[s.name]]
        lines = [f"  {f.sequence}: {f.kind}: {f.detail}" for f in every[:LISTED]]
        others = [f"  ... and {len(every) - LISTED} more"] if len(every) > LISTED else []
        raise FaultError(
            f"{len(faulty)} of {len(sequences)} sequences hold faults "
            f"({kinds_text(faults.values())}); "
            "data.faults=error refuses them, data.faults=drop leaves them out, data.faults=keep "
            "keeps them:\n" + "\n".join(lines + others)
        )
    simulable = [s for s in sequences if s.n_agents > 0 and usable(s, faults[s.name])]
    names = {s.name for s in sequences if not faults[s.name]}
    if policy is Faults.keep:
        names |= {s.name for s in simulable}
    kept = [s for s in sequences if s.name in names]
    if kept:
        return kept, [
            {
                "sequence": s.name,
                "reasons": [{"kind": f.kind, "detail": f.detail} for f in faults[s.name]],
            }
            for s in sequences
            if s.name not in names
        ]
    if simulable:
        advice = "data.faults=keep keeps faulty ones"
    elif "gap_in_time" in by_kind(faults.values()):
        advice = (
            "what is missing cannot be simulated; data.fill=SECONDS interpolates longer "
            "holes, or cut the sequences where vehicles come and go"
        )
    else:
        advice = "these cannot be simulated; correct the rows that the faults name"
    raise DataError(
        f"nothing is left of {len(sequences)} sequences: "
        f"{kinds_text(faults.values()) or 'no sequence at all'}; {advice}"
    )


def left_out_texts(
    sequences: int, dropped: list[list[Fault]], left_out: list[dict[str, str]]
) -> list[str]:
    """Sentences that say how much is not used, and why.

    Args:
        sequences: number of all sequences.
        dropped: faults of the sequences that are left out for them.
        left_out: see :class:`nnode.data.cut.Reading`.
    """
    texts = []
    if left_out:
        why = Counter(entry["why"] for entry in left_out)
        listed = "; ".join(f"{text} in {n}" for text, n in why.most_common(LISTED))
        texts.append(
            f"records that are left out, as there is no sequence of them: {len(left_out)} "
            f"({listed}; first {left_out[0]['name']})"
        )
    if dropped:
        texts.append(
            f"{len(dropped)} of {sequences} sequences are left out for their faults: "
            f"{kinds_text(dropped)}"
        )
    return texts


def interpolated(sequences: Iterable[Sequence]) -> list[dict[str, Any]]:
    """Number of interpolated samples of each sequence that has some, for a manifest."""
    return [{"sequence": s.name, "samples": s.filled} for s in sequences if s.filled]


def interpolated_text(filled: list[dict[str, Any]]) -> str:
    """How many samples were interpolated, in a sentence.

    Args:
        filled: see :func:`interpolated`.
    """
    return (
        f"{sum(entry['samples'] for entry in filled)} missing samples in {len(filled)} sequences "
        f"({_listed([entry['sequence'] for entry in filled])}) are interpolated; data.fill sets up "
        "to how many seconds"
    )


def by_recording(
    read: list[Sequence], kept: list[Sequence], faults: Mapping[str, list[Fault]]
) -> dict[str, Any]:
    """Per recording, how many sequences were read, kept and dropped, and how many are faulty."""
    names = {s.name for s in kept}
    table = {}
    for recording in dict.fromkeys(s.recording for s in read):
        of_recording = [s.name for s in read if s.recording == recording]
        n_kept = sum(name in names for name in of_recording)
        table[recording] = {
            "read": len(of_recording),
            "kept": n_kept,
            "dropped": len(of_recording) - n_kept,
            "faulty": by_kind(faults[name] for name in of_recording),
        }
    return table


def described(fault: Fault, sequence: Sequence) -> dict[str, Any]:
    """A fault for a manifest, with the agents' identifiers where the source has them."""
    names = [sequence.agents[i] for i in fault.agents] if sequence.agents else []
    return {**asdict(fault), "names": names}


def recorded(manifest: Mapping[str, Any]) -> dict[str, list[Fault]]:
    """The faults of a manifest by the sequence's name, see :func:`described`."""
    faults: dict[str, list[Fault]] = {}
    for entry in manifest.get("faults", []):
        values = {field.name: entry[field.name] for field in fields(Fault)}
        fault = Fault(**{**values, "agents": tuple(entry["agents"])})
        faults.setdefault(fault.sequence, []).append(fault)
    return faults
