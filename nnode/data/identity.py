"""Who is who: identifiers that name one agent each, in all sequences of a recording.

A source's identifiers may start again in every sequence, together with the clock; windows cut
from one recording keep both; and an identifier may be given to another agent later on. These are
told apart by where the agents are:

- Two sequences that share identifiers at the same times are of one world if most of these are
  where an agent is in the other one too, and so are sequences of which the second carries on where
  the first ends. If any two are not of one world, an identifier would be at two places at one time:
  it then belongs to the sequences of one world, which may be a single one.
- Otherwise there is one clock, and an identifier that turns up again where its agent cannot have
  got to since is another agent's.

Places are the same within the error that :mod:`nnode.data.limits` grants a single position;
windows of one recording repeat the same rows and do not need it. Most agents, not all, because a
single one at another place is what a fault of the measurement looks like.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from nnode.data.clusters import components
from nnode.data.limits import LIMITS
from nnode.data.options import Agents
from nnode.data.sequence import Domain, Sequence

#: Sampling times are counted up to this number: it is exact, and adding to it as well.
LATEST = 2.0**52


def numbered(name: str, number: int, taken: frozenset[str] | set[str] = frozenset()) -> str:
    """What the ``number``-th agent of one identifier is called: ``5``, ``5#2``, ``5#3``, ..."""
    called = name if number == 1 else f"{name}#{number}"
    while number > 1 and called in taken:
        called += "#"
    return called


def identify(
    sequences: list[Sequence], domain: Domain, mode: Agents
) -> tuple[list[tuple[str, ...]], list[str]]:
    """Identifiers that are the same in two sequences of a recording only for the same agent.

    Args:
        sequences: of any recordings; NaN where an agent has no position.
        domain: of the data.
        mode: how, see :data:`~nnode.data.options.Agents`.

    Returns:
        Each sequence's identifiers, the source's own for the first agent that bears them and
        with a number behind for the others; and for each recording in which they are not the
        source's a sentence that says why.
    """
    named = [s.agents for s in sequences]
    notes: list[str] = []
    recordings: dict[str, list[int]] = defaultdict(list)
    for i, s in enumerate(sequences):
        if s.agents and mode is not Agents["global"]:
            recordings[s.recording].append(i)
    for recording, places in recordings.items():
        members = [sequences[i] for i in places]
        if mode is Agents.sequence:
            every = _counted(members, range(len(members)))
            numbering: _Numbers | None = every, "identifiers belong to their sequence"
        else:
            numbering = _judged(members, domain)
        if numbering is None:
            continue
        notes.append(f"{recording}: {numbering[1]}")
        taken = {name for s in members for name in s.agents}
        for i, numbers in zip(places, numbering[0], strict=True):
            names = zip(named[i], numbers, strict=True)
            named[i] = tuple(numbered(name, n, taken) for name, n in names)
    return named, notes


#: Per sequence and agent the number of the agent among those of its name, and the reason.
_Numbers = tuple[list[list[int]], str]


def _counted(sequences: list[Sequence], worlds: Iterable[int]) -> list[list[int]]:
    """Number the agents of one name by the worlds that they are in, as these appear."""
    worlds_of: dict[str, dict[int, int]] = defaultdict(dict)
    return [
        [worlds_of[name].setdefault(int(world), len(worlds_of[name]) + 1) for name in s.agents]
        for s, world in zip(sequences, worlds, strict=True)
    ]


def _judged(sequences: list[Sequence], domain: Domain) -> _Numbers | None:
    error = LIMITS[domain].noise
    usual = float(np.median([s.dt for s in sequences if s.n_samples > 1] or [np.nan]))
    tracks = [_track(s, usual) for s in sequences]
    near, far = _neighbours(tracks, error)

    def one_world(pair: tuple[int, int]) -> bool:
        votes = list(_met(tracks, pair, error).values())
        return 2 * sum(votes) > len(votes)

    apart = next((pair for pair in far if not one_world(pair)), None)
    if apart is None:
        return _used_again(sequences, domain)
    worlds = components(len(sequences), [pair for pair in near if one_world(pair)])
    i, j = apart
    name = min(name for name, met in _met(tracks, apart, error).items() if not met)
    whose, count = "their sequence", worlds.max() + 1
    if count < len(sequences):
        whose = f"one of {count} runs of sequences that carry on"
    return (
        _counted(sequences, worlds),
        f"identifiers belong to {whose}, because {sequences[i].name} and {sequences[j].name} "
        f"have the same times and identifiers (such as {name}) at different places",
    )


@dataclass
class _Track:
    """A sequence at the times k·dt that all sequences share.

    Attributes:
        first: k of the first row.
        x: ``(K + 1, N, D)`` m; the last row is one interval ahead of the sequence's end, where
            the agents would be at constant velocity.
        place: column of each identifier.
    """

    first: int
    x: np.ndarray
    place: dict[str, int]


def _track(s: Sequence, step: float) -> _Track | None:
    """None for a sequence whose times cannot be compared with the others'."""
    if s.n_samples < 2 or not (step > 0 and np.isclose(s.dt, step, rtol=1e-2)):
        return None
    if not abs(s.time).max() < LATEST * step:
        return None
    first = int(np.ceil(s.time[0] / step - 1e-6))
    last = max(int(np.floor(s.time[-1] / step + 1e-6)), first)
    grid = np.arange(first, last + 1) * step
    flat = s.x.reshape(s.n_samples, -1)
    x = np.stack([np.interp(grid, s.time, column) for column in flat.T], axis=1)
    x = x.reshape(-1, *s.x.shape[1:])
    ahead = x[-1] + (s.x[-1] - s.x[-2]) * step / s.dt
    return _Track(first, np.concatenate([x, ahead[None]]), {a: i for i, a in enumerate(s.agents)})


_Pairs = list[tuple[int, int]]


def _neighbours(tracks: list[_Track | None], error: float) -> tuple[_Pairs, _Pairs]:
    """Pairs of sequences in which an identifier is at one place at one time, and at two.

    Of each identifier's places at a time only those next to each other are compared.
    """
    parts = []
    for i, track in enumerate(tracks):
        if track is not None and track.place:
            k = np.arange(len(track.x))
            columns: dict[str, Any] = {
                "name": np.tile(list(track.place), len(k)),
                "time": np.repeat(track.first + k, len(track.place)),
                "sequence": i,
                "ahead": np.repeat(k == k[-1], len(track.place)),
            }
            x = track.x[:, list(track.place.values())]
            parts.append(pd.DataFrame(x.reshape(-1, x.shape[2])).assign(**columns))
    if not parts:
        return [], []
    table = pd.concat(parts)
    places = table.columns[:-4].to_list()
    table = table[np.isfinite(table[places].to_numpy()).all(axis=1)]
    table = table.assign(name=pd.factorize(table["name"])[0]).sort_values(
        ["name", "time", *places, "sequence"]
    )
    row, next_row = table[:-1].reset_index(), table[1:].reset_index()
    sequences = np.stack([row["sequence"], next_row["sequence"]], axis=1)
    met = (row["name"] == next_row["name"]) & (row["time"] == next_row["time"])
    met &= (row["sequence"] != next_row["sequence"]) & ~(row["ahead"] & next_row["ahead"])
    close = np.linalg.norm(row[places] - next_row[places], axis=1) <= error

    def pairs(mask: pd.Series) -> _Pairs:
        return [(int(i), int(j)) for i, j in np.unique(np.sort(sequences[mask], axis=1), axis=0)]

    return pairs(met & close), pairs(met & ~close & ~row["ahead"] & ~next_row["ahead"])


def _met(tracks: list[_Track | None], pair: tuple[int, int], error: float) -> dict[str, bool]:
    """Which identifiers that two sequences share are, in one, where anybody is in the other.

    Anybody, because agents whose names are exchanged are a fault within one world.
    """
    a, b = sorted((tracks[i] for i in pair), key=lambda t: t.first if t else 0)
    if a is None or b is None:
        return {}
    # the row ahead of the end counts only where the sequences have no other time in common
    rows = max(min(a.first + len(a.x), b.first + len(b.x)) - 1 - b.first, 1)
    path = a.x[b.first - a.first :][:rows]
    other = b.x[: len(path)]
    met = {}
    for name in a.place.keys() & b.place.keys():
        apart = np.linalg.norm(path[:, a.place[name], None] - other, axis=2)
        measured = np.isfinite(apart)
        if measured[:, b.place[name]].any():
            met[name] = bool((measured.any(0) & ((apart <= error) | ~measured).all(0)).any())
    return met


def _used_again(sequences: list[Sequence], domain: Domain) -> _Numbers | None:
    """Identifiers that turn up where their agent cannot have got to, on one clock."""
    stays: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for i in np.argsort([s.time[0] for s in sequences], kind="stable"):
        for n, name in enumerate(sequences[i].agents):
            stays[name].append((int(i), n))
    steps: list[tuple[str, int, tuple[int, int], bool]] = []
    votes: dict[tuple[int, int], int] = defaultdict(int)
    for name, places in stays.items():
        before = places[0]
        for number, place in enumerate(places[1:], start=1):
            s, t = sequences[before[0]], sequences[place[0]]
            gap = float(t.time[0] - s.time[-1])
            if gap > 0:
                can = bool(reachable(_end(s, before[1], -1), _end(t, place[1], 0), gap, domain))
                steps.append((name, number, (before[0], place[0]), can))
                votes[before[0], place[0]] += 1 if can else -1
            if t.time[-1] >= s.time[-1]:
                before = place
    # where most cannot be who they were, the others are there by chance
    new = {(name, number) for name, number, pair, can in steps if not can or votes[pair] < 0}
    if not new:
        return None
    numbers = [[1] * s.n_agents for s in sequences]
    for name, places in stays.items():
        count = 1
        for number, (i, n) in enumerate(places):
            count += (name, number) in new
            numbers[i][n] = count
    name, number = min(new)
    i = stays[name][number][0]
    return (
        numbers,
        f"{len({name for name, _ in new})} identifiers are used again for another agent, who "
        f"cannot have come from where the one before was (such as {name}, another one from "
        f"{sequences[i].time[0]:g} s on in {sequences[i].name})",
    )


def _end(s: Sequence, n: int, which: int) -> np.ndarray:
    """The first (0) or last (-1) known position of an agent, NaN where there is none."""
    x = s.x[:, n]
    measured = x[np.isfinite(x).all(axis=1)]
    return measured[which] if len(measured) else np.full(x.shape[1], np.nan)


def given_anew(time: np.ndarray, x: np.ndarray, other: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Behind which rows of a road an identifier is another vehicle's.

    Such are the holes over which no vehicle can have driven, and those that last longer than any
    vehicle is in view without one: by then it has left the road in view.

    Args:
        time: ``(rows,)`` s, ascending for each identifier, one identifier after the other.
        x: ``(rows,)`` m.
        other: ``(rows - 1,)`` whether the next row has another identifier.
        hole: ``(rows - 1,)`` whether the next row is the same one's after a hole.
    """
    first = np.concatenate([[0], np.flatnonzero(other | hole) + 1])
    last = np.append(first[1:] - 1, len(time) - 1)
    gap = np.diff(time)
    can = reachable(x[:-1, None], x[1:, None], gap, "traffic")
    return np.asarray(hole & (~can | (gap > (time[last] - time[first]).max())))


def reachable(
    start: np.ndarray, end: np.ndarray, gap: np.ndarray | float, domain: Domain
) -> np.ndarray:
    """Whether an agent at ``start`` can be at ``end`` (..., D; m) ``gap`` seconds later.

    No faster than the greatest possible speed, and a vehicle no further back than a path's reach
    (see :class:`~nnode.data.limits.Limits`); what is not known is possible.
    """
    limits = LIMITS[domain]
    step = np.asarray(end - start)
    far = np.linalg.norm(step, axis=-1) > limits.max_speed * gap + limits.reach
    if domain == "traffic":
        far |= step[..., 0] < -limits.reach
    return np.asarray(~far)
