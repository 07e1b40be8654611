"""Faults of measured sequences: what no vehicle and no person can have done.

Each limit below is physical, not fitted. Two things are deliberately not judged. Accelerations:
positions from video are uncertain by metres (second differences of the ESIMAS positions reach
8 m within 0.2 s although nothing is wrong with the path), so a limit on acceleration would
condemn noise. And what a fault means for a calibration: see the ``faults`` option.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from nnode.data.sequence import UNEVEN, Domain, Sequence

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

#: Standard deviations of a step's error that are no fault: noise exceeds them once in 16,000 steps.
NOISY = 4.0

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


@dataclass(frozen=True)
class Limits:
    """What is physically possible.

    Attributes:
        max_speed: m/s. 60 (216 km/h) for vehicles; 5 for people in a corridor, who walk at
            1-2 and would have to run.
        max_reverse: m/s at which a vehicle may go backwards: 10, what a reverse gear allows.
            Beyond it a step back is a jump.
        noise: m, an error that a single position may have without being a fault: 0.5 for a
            vehicle in a road camera's image, 0.1 for a head seen from above.
        spacing: m. Fronts of consecutive vehicles in one lane: 2, as no car is shorter.
            Centres of two people: 0.1, half the breadth of a head.
        reach: m within which a position continues a path extrapolated at constant velocity:
            5, a car's length, or 0.4, a person's depth. Decides between swap and jump.
        min_agents, min_samples: needed for an interaction and for an acceleration.
    """

    max_speed: float
    max_reverse: float
    noise: float
    spacing: float
    reach: float
    min_agents: int
    min_samples: int = 3


#: Limits by domain.
LIMITS: dict[Domain, Limits] = {
    "traffic": Limits(
        max_speed=60.0, max_reverse=10.0, noise=0.5, spacing=2.0, reach=5.0, min_agents=2
    ),
    "crowd": Limits(
        max_speed=5.0,
        max_reverse=5.0,
        noise=0.1,
        spacing=0.1,
        reach=0.4,
        min_agents=1,
    ),
}


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
    found = [*_short(view), *_times(view), *_values(view), *_duplicates(view)]
    if sequence.n_samples and sequence.n_agents:
        found += [*_zero_rows(view), *_displacements(view)]
        found += [*_order(view, found), *_bumpers(view)] if domain == "traffic" else []
        found += _overlaps(view)
    return sorted(found, key=lambda f: -np.inf if f.time is None else f.time)


def usable(sequence: Sequence, faults: list[Fault]) -> bool:
    """Whether a sequence can be simulated at all, whatever its faults."""
    return sequence.n_samples > 1 and not any(fault.kind in UNUSABLE for fault in faults)


def by_kind(found: Iterable[Iterable[str]]) -> dict[str, int]:
    """Number of sequences with each kind of fault, the most frequent first.

    Args:
        found: the kinds of the faults of every sequence.
    """
    kinds = Counter(kind for own in found for kind in set(own))
    return dict(sorted(kinds.items(), key=lambda item: (-item[1], item[0])))


class _View:
    """A sequence as the checks look at it."""

    def __init__(self, sequence: Sequence, domain: Domain, limits: Limits) -> None:
        self.sequence, self.domain, self.limits = sequence, domain, limits
        x = sequence.x
        self.time = sequence.time
        # A vehicle that merely starts at the origin has a single zero there.
        zero = (x == 0).all(axis=2)
        again = np.zeros_like(zero)
        if len(x) > 1:
            again[1:] |= zero[1:] & zero[:-1]
            again[:-1] |= zero[1:] & zero[:-1]
        self.zero = again
        self.x = np.where(again[:, :, None] | ~np.isfinite(x).all(axis=2, keepdims=True), np.nan, x)
        steps = np.diff(sequence.time)
        self.dt = float(np.median(steps)) if steps.size else float("nan")

    def fault(self, kind: str, agents: tuple[int, ...], sample: int | None, detail: str) -> Fault:
        time = None if sample is None else float(self.time[sample])
        if time is not None and not np.isfinite(time):
            time = None
        return Fault(kind, self.sequence.name, agents, time, detail)

    def who(self, i: int) -> str:
        """An agent in words."""
        word = "car" if self.domain == "traffic" else "person"
        if self.sequence.agents:
            return f"{word} {i} (id {self.sequence.agents[i]})"
        return f"{word} {i}"

    def where(self, k: int, i: int) -> str:
        """A position in words."""
        return ", ".join(f"{value:.1f}" for value in self.sequence.x[k, i])


def _samples(mask: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Columns of ``(K, N)`` in which something holds, each with the samples at which it does."""
    for i in map(int, np.flatnonzero(mask.any(axis=0))):
        yield i, np.flatnonzero(mask[:, i])


def _short(view: _View) -> Iterator[Fault]:
    limits, s = view.limits, view.sequence
    if s.n_samples < limits.min_samples:
        text = f"{s.n_samples} samples, at least {limits.min_samples} are needed"
        yield view.fault("too_short", (), None, text)
    if s.n_agents < limits.min_agents:
        text = f"{s.n_agents} agents, at least {limits.min_agents} are needed"
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
    for mask, kind, what in (
        (absent, "gap_in_time", "has no position"),
        (broken, "non_finite", "has a position that is no number"),
    ):
        for i, k in _samples(mask):
            span = f"{view.time[k[0]]:g}-{view.time[k[-1]]:g} s"
            text = f"{view.who(i)} {what} at {len(k)} of {len(x)} samples ({span})"
            yield view.fault(kind, (i,), int(k[0]), text)


def _duplicates(view: _View) -> Iterator[Fault]:
    s = view.sequence
    bearers: dict[str, list[int]] = {}
    for i, name in enumerate(s.agents):
        bearers.setdefault(name, []).append(i)
    for name, agents in bearers.items():
        if len(agents) > 1:
            text = f"identifier {name} is given to {len(agents)} agents"
            yield view.fault("duplicate", tuple(agents), None, text)
    same: dict[bytes, list[int]] = {}
    for i in range(s.n_agents):
        if not np.isnan(s.x[:, i]).any():
            same.setdefault(s.x[:, i].tobytes(), []).append(i)
    for agents in same.values():
        if len(agents) > 1:
            text = f"{len(agents)} agents have the same positions at all {s.n_samples} samples"
            yield view.fault("duplicate", tuple(agents), None, text)


def _zero_rows(view: _View) -> Iterator[Fault]:
    for i, k in _samples(view.zero):
        text = f"{view.who(i)} is at exactly zero at {len(k)} of {len(view.x)} samples"
        yield view.fault("zero_row", (i,), int(k[0]), text)


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
    known = np.isfinite(before).any(axis=0)
    own = np.nanmedian(np.where(known, before, 0.0), axis=0) if len(before) else usual
    return np.where(known, own, usual)


def _continuations(expected: np.ndarray, then: np.ndarray, reach: float) -> dict[int, int]:
    """Which agent's next position continues which agent's path, where it is not its own."""
    found: dict[int, int] = {}
    for rows, columns in _groups(expected, then, reach):
        cost = np.minimum(cdist(expected[rows], then[columns]), reach)
        for a, b in zip(*linear_sum_assignment(cost), strict=True):
            i, j = int(rows[a]), int(columns[b])
            if i != j and cost[a, b] < reach:
                found[i] = j
    return dict(sorted(found.items()))


def _groups(a: np.ndarray, b: np.ndarray, reach: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Numbers of points of ``a`` and ``b`` (N, D) that are joined by distances up to ``reach``.

    Points of different groups are farther apart, so that each group is a problem of its own. Groups
    of more than :data:`CROWDED` points are left out: paths cannot be told apart there.
    """
    known = [np.flatnonzero(_placed(x)) for x in (a, b)]
    i, j = (own[k] for own, k in zip(known, _near(a[known[0]], b[known[1]], reach), strict=True))
    n = len(a)
    graph = coo_array((np.ones(len(i)), (i, n + j)), shape=(2 * n, 2 * n))
    label = connected_components(graph, directed=False)[1]
    members = np.argsort(label, kind="stable")
    for group in np.split(members, np.flatnonzero(np.diff(label[members])) + 1):
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
    one, other = cKDTree(a), cKDTree(b)
    # a little farther, because trees compare squares; the caller decides at the limit
    reach *= 1 + 1e-9
    if one.count_neighbors(other, reach) <= PAIRS:
        found = one.sparse_distance_matrix(other, reach, output_type="ndarray")
        return found["i"], found["j"]
    _, j = other.query(a, k=2, distance_upper_bound=reach)
    i = np.repeat(np.arange(len(a)), 2)
    there = j.ravel() < len(b)
    return i[there], j.ravel()[there]


def _order(view: _View, found: list[Fault]) -> Iterator[Fault]:
    """Neighbours in the lane that are not in the order of their positions."""
    gap = np.diff(view.x[:, :, 0], axis=1)
    swapped = [set(f.agents) for f in found if f.kind == "identity_swap"]
    for i, k in _samples(gap < 0):
        # After a swap the wrong order is its consequence, not another fault.
        if any({i, i + 1} <= agents for agents in swapped):
            continue
        text = (
            f"{view.who(i)} is up to {-np.nanmin(gap[:, i]):.1f} m ahead of {view.who(i + 1)}, "
            f"its leader, at {len(k)} of {len(view.x)} samples"
        )
        yield view.fault("overtaking", (i, i + 1), int(k[0]), text)


def _bumpers(view: _View) -> Iterator[Fault]:
    """Vehicles whose front is in the vehicle ahead, by more than the error of one position."""
    if view.sequence.length is None:
        return
    limits = view.limits
    gap, length = np.diff(view.x[:, :, 0], axis=1), view.sequence.length[1:]
    # fronts that are nearer, or in the wrong order, are another fault
    inside = (gap >= limits.spacing) & (length - gap > limits.noise)
    for i, k in _samples(inside):
        text = (
            f"the front of {view.who(i)} is {gap[k, i].min():.2f} m behind that of "
            f"{view.who(i + 1)}, which is {length[i]:.2f} m long, at {len(k)} of {len(view.x)} "
            "samples"
        )
        yield view.fault("overlap", (i, i + 1), int(k[0]), text)


def _overlaps(view: _View) -> Iterator[Fault]:
    x, limit = view.x, view.limits.spacing
    time, agent = np.nonzero(_placed(x))
    # times lie apart by more than the limit in a dimension of their own
    points = np.column_stack([x[time, agent], 2 * limit * time])
    i, j = _near(points, points, limit)
    distance = np.sqrt(((x[time[i], agent[i]] - x[time[j], agent[j]]) ** 2).sum(axis=1))
    first, second = np.minimum(agent[i], agent[j]), np.maximum(agent[i], agent[j])
    rows = np.stack([first, second, time[i]], axis=1)
    close = (first < second) & (distance < limit)
    # each pair stands there twice
    rows, index = np.unique(rows[close], axis=0, return_index=True)
    distance = distance[close][index]
    starts = np.flatnonzero(np.diff(rows[:, :2], axis=0, prepend=-1).any(axis=1))
    for rank in np.argsort(rows[starts, 2], kind="stable"):
        begin = starts[rank]
        end = starts[rank + 1] if rank + 1 < len(starts) else len(rows)
        pair = int(rows[begin, 0]), int(rows[begin, 1])
        text = (
            f"{view.who(pair[0])} and {view.who(pair[1])} are down to "
            f"{distance[begin:end].min():.2f} m apart at {end - begin} of {len(x)} samples, less "
            f"than {limit:g} m"
        )
        yield view.fault("overlap", pair, int(rows[begin, 2]), text)
