"""The stage on which crowds play: a corridor, people who walk both ways, groups, moods."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.synthetic_cases.case import Case
from benchmarks.synthetic_cases.crowd.motion import Base, Hidden, simulate
from benchmarks.synthetic_cases.noise import ornstein_uhlenbeck

#: Steps of Runge–Kutta's method between two samples.
SUBSTEPS = 10
#: Seconds that people walk before they are recorded.
BURN_IN = 1.0
#: Half the length of the walls, and largest distance of their points, m.
HALF_LENGTH, WALL_SPACING = 11.0, 0.25
#: Seconds from the end of a sequence to the start of the next.
_PAUSE = 2.0
#: People begin within this distance of the middle, and at least so far from each other, m.
_REACH, _APART = 8.0, 0.75
#: Centres of people stay so far from each other, and from walls, by the base law, m; a start that
#: leads elsewhere is drawn again, so many times at most.
_LEAST_APART, _GRAZE, _TRIES = 0.3, 0.1, 12
#: Share of the people who begin in a lane of their direction.
_LANES = 0.85
#: Distance of group members, and of everyone from walls, at first, m.
_SIDE_BY_SIDE, _FROM_WALL = 0.7, 0.5
_GROUP_SIZES, _GROUP_SHARES = (1, 2, 3), (0.45, 0.4, 0.15)
#: Share of those who cross to the other side of the corridor.
_CROSSING = 0.25
#: Destinations lie so far ahead of the corridor's middle, m; of those who cross, nearer.
_AHEAD, _AHEAD_CROSSING = 25.0, 13.0
#: Walkers' disturbances are correlated over this time, s. Of people in a corridor (Jülich, what the
#: social force leaves) the correlation falls below 1/e within 0.1 s, and crosses zero after 0.2 s.
_CORRELATION = (0.3, 0.6)
#: The same where they last longer than a window of the diagnosis.
_SLOW = (1.0, 2.0)
#: Distance of people who all walk the same way, m.
_LOOSE = 2.0


@dataclass(frozen=True)
class Scene:
    """S crowds of N people before anyone has moved; M steps, K + 1 samples.

    Attributes:
        base: parameters of the base law.
        width: of the corridor, m.
        segments: ``(W, 4)`` walls, m; the walkable side is on their left.
        points: ``(P, 2)`` of the walls, m.
        clocks: ``(S,)`` time of the first sample, s.
        step: of Runge–Kutta's method, s.
        x, v, goal: ``(S, N, 2)`` at the start of the burn-in, m, m/s, m.
        group: ``(S, N)`` number of the social group, -1 for those who walk alone.
        kick: ``(S, M + 1, N, 2)`` disturbance of accelerations, of variance 1.
        correlation: its correlation time, s.
        error: ``(S, K + 1, N, 2)`` error of the measured positions, of variance 1.
        eta: ``(S, N)`` of mean 0 and variance 1.
        phase: ``(S, N)`` of the gait, rad.
    """

    base: Base
    width: float
    segments: np.ndarray
    points: np.ndarray
    clocks: np.ndarray
    step: float
    x: np.ndarray
    v: np.ndarray
    goal: np.ndarray
    group: np.ndarray
    kick: np.ndarray
    correlation: float
    error: np.ndarray
    eta: np.ndarray
    phase: np.ndarray

    def only(self, places: list[int]) -> Scene:
        """The crowds at some places alone."""
        names = ("clocks", "x", "v", "goal", "group", "kick", "error", "eta", "phase")
        return replace(self, **{name: getattr(self, name)[places] for name in names})


def set_scene(case: Case) -> Scene:
    """Everything random about a case's people, except what is hidden."""
    rng = case.generator("law")
    base = Base(
        A=float(rng.uniform(12, 22)),
        k=float(rng.uniform(300, 600)),
        kappa=float(rng.uniform(10, 40)),
    )
    width = float(rng.uniform(4, 5))
    segments = np.array(
        [[-HALF_LENGTH, 0.0, HALF_LENGTH, 0.0], [HALF_LENGTH, width, -HALF_LENGTH, width]]
    )
    # longer corridors for larger crowds keep the density
    reach = _REACH * case.n_agents / 16
    rng = case.generator("people")
    points = _points(segments)
    people: list[tuple[np.ndarray, ...]] = []
    while len(people) < case.n_sequences:
        if case.arm == "no_excitation":
            people.append(_same_way(rng, case.n_agents, width))
            continue
        drawn = _both_ways(rng, case.n_agents, width, reach)
        for _ in range(_TRIES):
            if _comfortable(drawn, base, width, points, segments, BURN_IN + case.duration):
                break
            drawn = _both_ways(rng, case.n_agents, width, reach)
        people.append(drawn)
    x, v, goal, group = (np.array(parts) for parts in zip(*people, strict=True))

    step = case.dt / SUBSTEPS
    steps = (round(BURN_IN / case.dt) + case.n_steps) * SUBSTEPS
    shape = (case.n_sequences, case.n_agents)
    rng = case.generator("walkers")
    correlation = float(rng.uniform(*(_SLOW if case.variant == "slow" else _CORRELATION)))
    kick = ornstein_uhlenbeck(
        rng,
        (*shape, 2, steps + 1),
        step=step,
        correlation=correlation,
        heavy_tails=case.variant == "heavy_tails",
    )
    eta = rng.standard_normal(shape)
    return Scene(
        base=base,
        width=width,
        segments=segments,
        points=points,
        clocks=np.arange(case.n_sequences) * round(case.duration + _PAUSE, 6),
        step=step,
        x=x,
        v=v,
        goal=goal,
        group=group,
        kick=np.ascontiguousarray(kick.transpose(0, 3, 1, 2)),
        correlation=correlation,
        error=case.generator("measurement").standard_normal(
            (shape[0], case.n_steps + 1, shape[1], 2)
        ),
        eta=(eta - eta.mean()) / eta.std(),
        phase=rng.uniform(0, 2 * np.pi, shape),
    )


def _points(segments: np.ndarray) -> np.ndarray:
    """``(P, 2)`` points of the walls, no farther apart than :data:`WALL_SPACING`."""
    found = []
    for x1, y1, x2, y2 in segments:
        number = math.ceil(math.hypot(x2 - x1, y2 - y1) / WALL_SPACING - 1e-9) + 1
        found.append(np.linspace((x1, y1), (x2, y2), number))
    return np.concatenate(found)


def _comfortable(
    people: tuple[np.ndarray, ...],
    base: Base,
    width: float,
    points: np.ndarray,
    segments: np.ndarray,
    duration: float,
) -> bool:
    """Whether by the base law alone nobody bumps into somebody or grazes a wall."""
    x0, v0, goal, group = (part[None] for part in people)
    nobody = np.zeros(group.shape)
    x, _ = simulate(
        base,
        Hidden(),
        x0,
        v0,
        goal,
        group,
        nobody,
        nobody,
        points,
        segments,
        np.zeros((1, 1, *x0.shape[1:])),
        np.zeros(1),
        np.zeros(1),
        0.05,
        round(duration / 0.05),
        2,
    )
    distance = np.hypot(*(x[0][:, :, None] - x[0][:, None]).transpose(3, 0, 1, 2))
    distance += np.where(np.eye(len(goal[0]), dtype=bool), np.inf, 0.0)
    y = x[..., 1]
    return bool(distance.min() > _LEAST_APART and y.min() > _GRAZE and y.max() < width - _GRAZE)


def _both_ways(
    rng: np.random.Generator, number: int, width: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities, destinations ``(N, 2)`` and groups ``(N,)`` of two-way flow."""
    x = np.empty((0, 2))
    v, goal, group = [], [], []
    lane = float(rng.choice([-1, 1]))
    while len(x) < number:
        size = min(int(rng.choice(_GROUP_SIZES, p=_GROUP_SHARES)), number - len(x))
        way = float(rng.choice([-1, 1]))
        place = _free_place(rng, x, size, way, width, reach, lane)
        crosses = size == 1 and rng.uniform() < _CROSSING
        speed = float(np.clip(rng.normal(1.3, 0.2), 0.8, 1.8))
        for own in place:
            if crosses:
                other_side = width - own[1] if abs(own[1] - width / 2) > 1 else own[1] + way
                end = np.array([way * _AHEAD_CROSSING, other_side])
            else:
                end = np.array([way * _AHEAD, own[1] + rng.normal(0, 0.3)])
            end[1] = np.clip(end[1], _FROM_WALL, width - _FROM_WALL)
            angle = math.atan2(*(end - own)[::-1]) + rng.normal(0, 0.15)
            pace = speed + rng.normal(0, 0.03)
            v.append(pace * np.array([math.cos(angle), math.sin(angle)]))
            goal.append(end)
            group.append(len(x) if size > 1 else -1)
        x = np.concatenate([x, place])
    return x, np.array(v), np.array(goal), np.array(group)


def _free_place(
    rng: np.random.Generator,
    taken: np.ndarray,
    size: int,
    way: float,
    width: float,
    reach: float,
    lane: float,
) -> np.ndarray:
    """``(size, 2)`` people side by side, away from those that are there."""
    room = 0.5 * (size - 1) * _SIDE_BY_SIDE + _FROM_WALL
    while True:
        # people come from their side, so that most of them meet
        along = -way * rng.uniform(-0.15 * reach, reach)
        across = rng.uniform(room, width - room)
        if rng.uniform() < _LANES:
            # most people keep to a lane of their direction, as real crowds soon do
            across = 0.5 * width + way * lane * abs(across - 0.5 * width)
        offset = _SIDE_BY_SIDE * (np.arange(size) - 0.5 * (size - 1))
        place = np.stack([along + rng.normal(0, 0.1, size), across + offset], axis=1)
        if not len(taken):
            return place
        distance = np.hypot(*(place[:, None] - taken[None]).transpose(2, 0, 1))
        if distance.min() > _APART:
            return place
        # a full corridor becomes a longer one
        reach *= 1.01


def _same_way(
    rng: np.random.Generator, number: int, width: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """As :func:`_both_ways`, but far apart, side by side, in one direction and at one speed."""
    rows = np.arange(number) // 2
    lane = np.where(np.arange(number) % 2 == 0, -0.5, 0.5)
    first = -HALF_LENGTH + 1 + rng.uniform(0, 1)
    x = np.stack([first + _LOOSE * rows, 0.5 * width + _LOOSE * lane], axis=1)
    v = np.tile([float(rng.uniform(1.1, 1.4)), 0.0], (number, 1))
    goal = x + np.array([2 * _AHEAD, 0.0])
    return x, v, goal, np.full(number, -1)
