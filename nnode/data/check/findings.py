"""What is wrong with rows of trajectories, in words, with the numbers that say so."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from nnode.data.check.scale import AGREE, INTERVAL, RATES, SWAYS, USUAL, Medians, Scale, moves_of
from nnode.data.policy import told_filled
from nnode.data.quality import KINDS, LIMITS, Fault, by_kind
from nnode.data.readers.columns import Table, floats, quoted
from nnode.data.sequence import UNEVEN, Domain, Sequence
from nnode.data.smooth import BEARABLE, Noise, suggested_window
from nnode.data.trajectories import HOLE, Trajectories

#: Greatest acceleration of a tyre on dry road, whose friction is about 1, and of a person's shoe,
#: over a second: that of gravity, m/s².
FRICTION = 9.81
#: Share of the covered length at either end where agents may come and go; elsewhere they do not.
EDGE = 0.1
#: Share of agents from which on something is told of all.
FEW = 0.02


#: Meanings of columns with a value for every sample.
_SAMPLED = ("x", "y", "x_follower", "x_leader")


@dataclass(frozen=True)
class Finding:
    """One thing that was found.

    Attributes:
        kind: a word for it.
        level: ``error``: results would be wrong; ``warning``: look at it; ``note``: to know.
        text: what, with numbers and what to do.
    """

    kind: str
    level: str
    text: str


def cells(table: Table, columns: dict[str, str]) -> Iterator[Finding]:
    """Cells without a number where one is needed, and agents without a name."""
    for meaning, column in columns.items():
        own = table.frame[column]
        empty = own.isna().to_numpy()
        bad = empty
        if meaning != "agent":
            bad = ~np.isfinite(floats(own))
        if meaning in _SAMPLED and not bad.all():  # empty ones are missing samples
            bad &= ~empty
        if bad.any():
            i = int(np.flatnonzero(bad)[0])
            shown = "nothing" if empty[i] else quoted(own.iloc[i])[:42]
            yield Finding(
                "cells",
                "error",
                f"column {column!r} ({meaning}) holds no number in {bad.sum()} of {len(own)} rows, "
                f"first {shown} in {table.row(i)}; correct or remove these rows",
            )


def order(rows: Trajectories, same: int) -> Iterator[Finding]:
    """One agent twice at one time, and rows that are not in order of time.

    Args:
        same: number of rows that stood in the file before.
    """
    code, time = pd.factorize(rows.agent)[0], rows.time
    pairs = pd.DataFrame({"agent": code, "time": time})
    again = pairs.duplicated().to_numpy() & np.isfinite(time)
    if again.any():
        i = int(np.flatnonzero(again)[0])
        yield Finding(
            "duplicates",
            "error",
            f"{again.sum()} rows have an agent and a time that stood there before ({same} of them "
            f"are the same throughout), first agent {rows.agent[i]} at {time[i]:g} in "
            f"{rows.where(i)}; keep one row per agent and time, or tell agents of one name apart",
        )
    by_agent = np.argsort(code, kind="stable")
    back = (np.diff(time[by_agent]) < 0) & (np.diff(code[by_agent]) == 0)
    if back.any():
        i = int(by_agent[np.flatnonzero(back)[0] + 1])
        yield Finding(
            "unsorted",
            "note",
            f"{back.sum()} rows stand before earlier ones of their agent, first in "
            f"{rows.where(i)}; the readers sort them",
        )


def sampling(rows: Trajectories) -> Iterator[Finding]:
    """Sampling interval, uneven steps, holes (s)."""
    steps, dt = rows.steps, rows.dt
    if not steps.size:
        yield Finding(
            "rate", "error", "no agent has two rows at different times; nothing moves here"
        )
        return
    uneven = np.abs(steps - dt) > UNEVEN * dt
    holes = steps > HOLE * dt
    text = f"sampled every {dt:.4g} s ({1 / dt:.4g} in a second)"
    level = "note"
    if (uneven & ~holes).mean() > FEW:
        level = "warning"
        text += f"; {(uneven & ~holes).mean():.0%} of the steps differ by more than {UNEVEN:.0%}"
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


def time_scale(known: Medians, scale: Scale, told: float | None) -> Iterator[Finding]:
    """Whether the clock is right, by speeds in the file and by what is possible.

    Args:
        told: frames per second as the file or the user tells.
    """
    speed = known.speed * scale.metres / scale.seconds
    ratio = known.ratio * scale.metres / (scale.per_second * scale.seconds)
    usual = USUAL[scale.domain]["speed"]
    who = "people walk" if scale.domain == "crowd" else "vehicles drive"
    if told is not None and scale.rate is not None and abs(scale.rate / told - 1) > 0.01:
        own = f"; its own velocities say {speed / ratio:.3g} m/s" if np.isfinite(ratio) else ""
        yield Finding(
            "time_scale",
            "error",
            f"at the {told:g} frames/s that are told, {who} "
            f"{known.speed * scale.metres * told:.3g} m/s (median of those who move){own}: "
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
    clock = known.sway / scale.seconds
    walk = USUAL["crowd"]["sway"]
    fine = known.dt * scale.seconds <= SWAYS
    if scale.domain == "crowd" and fine and np.isfinite(clock):
        text = f"people sway {clock:.3g} times in a second; expected {walk.low:g} to {walk.high:g}"
        if told is None and scale.rate is not None:
            yield Finding("gait", "note", f"{text}: the frame rate is taken from this")
        elif walk.score(clock) > -4:
            yield Finding("gait", "note", f"{text}: the time scale is right to about a tenth")
        else:
            right = 1 / np.sqrt(walk.low * walk.high) * clock
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


def measurement(noise: Noise, sequences: list[Sequence], domain: Domain) -> Iterator[Finding]:
    """Noise of the positions that a reader makes, and samples that it interpolated."""
    filled = [{"sequence": s.name, "samples": s.filled} for s in sequences if s.filled]
    if filled:
        yield Finding("filled", "note", told_filled(filled))
    if not sequences or not np.isfinite(noise.position):
        return
    if not noise.beyond:
        yield Finding("noise", "note", str(noise))
        return
    window = suggested_window(noise, sequences[0].dt)
    law = "a law of second order" if domain == "traffic" else "a social force"
    text = f"{noise}, more than the {BEARABLE:g} m/s that {law} bears: "
    cure = f"data.smooth={window:g} (s) smooths positions and speeds"
    if domain == "traffic":
        cure = f"training and fits smooth and fit first speeds by themselves; {cure}"
    yield Finding("noise", "warning", text + cure)


def accelerations(rows: Trajectories) -> Iterator[Finding]:
    """Accelerations over a second that nobody can have (m, s).

    Steps that are too long, and identifiers that are swapped, are faults of the sequences.
    """
    moves = moves_of(rows, max(1, round(1.0 / rows.dt)) if rows.dt > 0 else 1)
    if not moves.size.size:
        return
    v = (rows.x[moves.last] - rows.x[moves.first]) / moves.took[:, None]
    # the next second of the same agent begins where this one ends
    next_ = np.searchsorted(moves.first, moves.last).clip(max=moves.first.size - 1)
    good = moves.first[next_] == moves.last
    a = np.linalg.norm(v[next_] - v, axis=1)[good] / moves.took[good]
    if a.size and (a > FRICTION).mean() > 0.001:
        yield Finding(
            "acceleration",
            "warning",
            f"{(a > FRICTION).mean():.1%} of the changes of speed over a second exceed "
            f"{FRICTION:g} m/s², what friction can give; 99 % are below "
            f"{np.percentile(a, 99):.3g} m/s²: the time scale or the positions are off",
        )


def direction(rows: Trajectories, domain: Domain) -> Iterator[Finding]:
    """Which way agents go (m)."""
    start, end = rows.ends()
    net = rows.x[end] - rows.x[start]
    if domain == "traffic":
        net = _usual(rows)[:, None] * (end - start)[:, None]
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
    if not back.any():
        return
    if back.all():
        text = "all vehicles drive towards smaller positions; data.direction=-1 turns them"
        yield Finding("direction", "warning", text)
        return
    lanes = np.full(went.sum(), "") if rows.lane is None else rows.lane[start][went]
    both = [name for name in dict.fromkeys(lanes) if 0 < back[lanes == name].mean() < 1]
    where = f" in lane {_some(both)}" if both and rows.lane is not None else ""
    opposed = "both ways" + where if both else "one way in some lanes, the other way in others"
    yield Finding(
        "direction",
        "error" if min(back.mean(), 1 - back.mean()) > EDGE else "warning",
        f"vehicles drive {opposed}: {back.mean():.0%} of {back.size} towards smaller positions; "
        "choose one direction with data.lane, or tell the lanes apart",
    )


def _usual(rows: Trajectories) -> np.ndarray:
    """Median step of every agent along the lane: one that is wrong does not turn it."""
    same = rows.agent[1:] == rows.agent[:-1]
    step = pd.Series(np.diff(rows.x[:, 0])[same])
    found = step.groupby(rows.agent[1:][same]).median()
    return np.array(found.reindex(rows.agent[rows.ends()[0]]).fillna(0.0), dtype=float)


def coming_and_going(rows: Trajectories, domain: Domain, whole: bool) -> Iterator[Finding]:
    """Who is there, who enters and leaves, and whose record breaks off where nobody can (m, s).

    Args:
        whole: whether records begin and end where agents come and go, not where they were cut.
    """
    start, end = rows.ends()
    times, count = np.unique(rows.time, return_counts=True)
    span = times[-1] - times[0]
    yield Finding(
        "agents",
        "note",
        f"{len(start)} {'people' if domain == 'crowd' else 'vehicles'} in {span:.5g} s, "
        f"{np.median(count):.0f} at a time (at most {count.max()}), each for "
        f"{np.median(rows.time[end] - rows.time[start]):.3g} s",
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
        found: np.ndarray = (at > low + edge) & (at < high - edge)
        return found & (np.abs(rows.time[chosen] - moments.to_numpy()[chosen]) > rows.dt)

    born, gone = inside(start, clock.transform("min")), inside(end, clock.transform("max"))
    if not (born.any() or gone.any()):
        return
    again = _continued(rows, start[born], end[gone], domain)
    text = (
        f"{born.sum()} agents appear and {gone.sum()} vanish in the middle of what is covered, "
        "away from its ends and from the recording's or sequence's"
    )
    if again:
        text += (
            f"; {len(again)} of those who appear carry on where another broke off (such as "
            f"{again[0][0]} as {again[0][1]}): identifiers change along the way"
        )
    many = max(born.mean(), gone.mean()) > EDGE
    yield Finding("broken", "warning" if again or many else "note", text)


def _continued(
    rows: Trajectories, born: np.ndarray, gone: np.ndarray, domain: Domain
) -> list[tuple[str, str]]:
    """Agents that end and others that begin where these would be, within ten samples."""
    if not (len(born) and len(gone)):
        return []
    found = []
    # time as a third coordinate: ten samples count like the reach
    clock = LIMITS[domain].reach / (10 * rows.dt)
    before = np.maximum(gone - 1, 0)
    v = (rows.x[gone] - rows.x[before]) / rows.dt
    v[rows.agent[before] != rows.agent[gone]] = 0
    tree = cKDTree(np.column_stack([rows.x[born], clock * rows.time[born]]))
    for k in range(1, 11):
        then = rows.x[gone] + k * rows.dt * v
        at = np.column_stack([then, clock * (rows.time[gone] + k * rows.dt)])
        away, which = tree.query(at, distance_upper_bound=LIMITS[domain].reach / 2)
        for i in np.flatnonzero(np.isfinite(away)):
            row = born[which[i]]
            late = rows.time[row] - rows.time[gone[i]]
            if 0 < late < 10.5 * rows.dt and rows.agent[row] != rows.agent[gone[i]]:
                found.append((rows.agent[gone[i]], rows.agent[row]))
    return sorted(set(found))


def faults(found: dict[str, list[Fault]], sequences: int) -> Iterator[Finding]:
    """What no vehicle and no person can have done, as :mod:`nnode.data.quality` finds it."""
    for kind, number in by_kind([f.kind for f in own] for own in found.values()).items():
        if kind == "too_short":
            continue
        first = next(f for own in found.values() for f in own if f.kind == kind)
        level = "error" if number > 0.1 * sequences else "warning"
        yield Finding(
            kind,
            level,
            f"{KINDS[kind]}: in {number} of {sequences} sequences, first in {first.sequence}"
            + (f" at {first.time:g} s" if first.time is not None else "")
            + f": {first.detail}",
        )


def _some(names: list[str], most: int = 5) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
