"""Synthetic measured crowds in which an effect is hidden: people who walk both ways in a corridor,
alone and in groups."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from benchmarks.synthetic_cases.case import Case
from benchmarks.synthetic_cases.catalogue import CATALOGUES
from benchmarks.synthetic_cases.crowd.motion import Base, Hidden, People, simulate
from benchmarks.synthetic_cases.noise import ornstein_uhlenbeck
from benchmarks.synthetic_cases.subject import Range, Subject, Truth

#: Steps of Runge–Kutta's method between two samples, and when the truth is replayed.
SUBSTEPS, _FINE = 10, 2
#: Seconds that people walk before they are recorded, and length of a window that is replayed, s.
BURN_IN, WINDOW = 1.0, 1.5
#: Half the length of the walls, m.
HALF_LENGTH = 11.0
#: Seconds from the end of a sequence to the start of the next.
_PAUSE = 2.0
#: People begin within this distance of the middle, and at least so far from each other, m.
_REACH, _APART = 8.0, 0.75
#: Centres of people stay so far from each other, and from walls, by the base law, m; a start that
#: leads elsewhere is drawn again, so many times at most.
_CLOSEST, _GRAZE, _TRIES = 0.3, 0.1, 12
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

Start = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class Motion(NamedTuple):
    """Simulated crowds.

    Attributes:
        x, v: ``(S, K + 1, N, 2)`` true positions (m) and velocities (m/s) at the samples.
        some: which of the case's sequences they are.
    """

    x: np.ndarray
    v: np.ndarray
    some: slice


class CrowdCase(Subject):
    """A case of crowds.

    Attributes:
        people: before the burn-in; ``eta`` has mean 0 and variance 1.
        width: of the corridor, m.
        kick: ``(S, M + 1, N, 2)`` disturbance of accelerations, of variance 1.
    """

    unit = "m/s²"
    range = Range(preferred=(0.02, 0.15), extreme=(0.005, 0.35), idle=(0.04, 0.15), probe=0.02)
    some = slice(8)
    tolerance = 1e-4

    def __init__(self, case: Case) -> None:
        self.case, self.step = case, case.size[2] / SUBSTEPS
        self._set_scene()
        rng, catalogue = case.generator("effects"), CATALOGUES["crowd"]
        effects = {name: catalogue.effects[name].draw(rng, self.width) for name in case.effects}
        if case.variant == "heterogeneous":
            effects |= {name: nuisance.draw(rng) for name, nuisance in catalogue.nuisance.items()}
        self.truth = Truth(effects, smooth=float(case.variant == "smooth"))
        self.set_strength(rng)

    def simulate(self, truth: Truth, some: slice = slice(None)) -> Motion:
        clocks = self.clocks[some]
        x, v = simulate(
            self.law,
            self._hidden(truth),
            self._people(truth, some),
            self.walls,
            truth.amplitude * self.kick[some],
            clocks - BURN_IN,
            np.full(len(clocks), -BURN_IN),
            self.step,
            SUBSTEPS,
        )
        burn = round(BURN_IN / self.case.size[2])
        return Motion(x[:, burn:], v[:, burn:], some)

    def errors(
        self, motion: Motion, measured: np.ndarray, parameters: Any, truth: Truth | None = None
    ) -> np.ndarray:
        """``(S, W, k, N, 2)``, in W windows that start from the true states."""
        dt = self.case.size[2]
        sequences, samples, number_of_people = motion.x.shape[:3]
        length = min(round(WINDOW / dt), samples - 1)
        starts = np.arange(0, samples - length, length)
        number, since = len(starts), np.tile(starts * dt, sequences)
        substeps = 1 if truth is None else _FINE
        people = self._people(truth or Truth({}), motion.some)
        spread = People(*(np.repeat(part, number, axis=0) for part in people))
        spread = spread._replace(
            x=motion.x[:, starts].reshape(spread.x.shape),
            v=motion.v[:, starts].reshape(spread.x.shape),
        )
        simulated, _ = simulate(
            self.law._replace(**dict(zip(self.base, map(float, parameters), strict=True))),
            Hidden() if truth is None else self._hidden(truth),
            spread,
            self.walls,
            np.zeros((sequences * number, length * substeps + 1, number_of_people, 2)),
            np.repeat(self.clocks[motion.some], number) + since,
            since,
            dt / substeps,
            substeps,
        )
        shape = sequences, number, length + 1, number_of_people, 2
        wanted = np.stack([measured[:, s + 1 : s + 1 + length] for s in starts], axis=1)
        return simulated.reshape(shape)[:, :, 1:] - wanted

    def squares(self, error: np.ndarray) -> np.ndarray:
        return (error**2).sum(-1)

    def columns(self, x: np.ndarray) -> dict[str, np.ndarray]:
        people, runs = self.people, np.array(self.case.runs)[:, None]
        group = np.char.add(runs, np.char.add("g", people.group.astype(str)))
        return {
            "x": np.round(x[..., 0], 5),
            "y": np.round(x[..., 1], 5),
            "group": np.where(people.group < 0, "", group),
            "dest_x": np.round(people.goal[..., 0], 4),
            "dest_y": np.round(people.goal[..., 1], 4),
        }

    def _hidden(self, truth: Truth) -> Hidden:
        return Hidden(**self.fields(truth), bell=truth.smooth)

    def _people(self, truth: Truth, some: slice) -> People:
        """People who steer as vigorously as the truth says."""
        sigma = truth.effects.get("walker_heterogeneity", {}).get("sigma", 0.0)
        people = self.people._replace(eta=sigma * self.people.eta)
        return People(*(part[some] for part in people))

    def _set_scene(self) -> None:
        """Everything random about a case's people, except what is hidden."""
        case, rng = self.case, self.case.generator("law")
        number, duration, dt = case.size
        draws = {"A": (12, 22), "k": (300, 600), "kappa": (10, 40)}
        self.base = {name: float(rng.uniform(*ends)) for name, ends in draws.items()}
        self.law = Base(**self.base)
        options = {"B": self.law.B, "r": self.law.r, "tau": self.law.tau}
        self.model = {"name": "sf", "options": options}
        self.width = float(rng.uniform(4, 5))
        half, width = HALF_LENGTH, self.width
        self.walls = np.array([[-half, 0.0, half, 0.0], [half, width, -half, width]])
        rng = case.generator("people")
        starts = [self._start(rng) for _ in range(case.n_sequences)]
        x, v, goal, group = (np.array(parts) for parts in zip(*starts, strict=True))

        steps = (round(BURN_IN / dt) + case.n_steps) * SUBSTEPS
        shape = (case.n_sequences, number)
        rng = case.generator("walkers")
        self.correlation = float(rng.uniform(*(_SLOW if case.variant == "slow" else _CORRELATION)))
        kick = ornstein_uhlenbeck(
            rng,
            (*shape, 2, steps + 1),
            step=self.step,
            correlation=self.correlation,
            heavy_tails=case.variant == "heavy_tails",
        )
        self.kick = np.ascontiguousarray(kick.transpose(0, 3, 1, 2))
        eta = rng.standard_normal(shape)
        eta = (eta - eta.mean()) / eta.std()
        self.people = People(x, v, goal, group, eta)
        self.clocks = np.arange(case.n_sequences) * round(duration + _PAUSE, 6)
        self.error = case.generator("measurement").standard_normal(
            (shape[0], case.n_steps + 1, shape[1], 2)
        )

    def _start(self, rng: np.random.Generator) -> Start:
        """Positions, velocities, destinations ``(N, 2)`` and groups ``(N,)`` of a crowd."""
        if self.case.arm == "no_excitation":
            return _same_way(rng, self.case.size[0], self.width)
        for _ in range(_TRIES + 1):
            start = _both_ways(rng, self.case.size[0], self.width)
            if self._comfortable(start):
                break
        return start

    def _comfortable(self, start: Start) -> bool:
        """Whether by the base law alone nobody bumps into somebody or grazes a wall."""
        x0, v0, goal, group = (part[None] for part in start)
        nobody, steps = np.zeros(group.shape), round((BURN_IN + self.case.size[1]) / 0.05)
        (x,), _ = simulate(
            self.law,
            Hidden(),
            People(x0, v0, goal, group, nobody),
            self.walls,
            np.zeros((1, steps + 1, *start[0].shape)),
            np.zeros(1),
            np.zeros(1),
            0.05,
            2,
        )
        distance = np.hypot(*(x[:, :, None] - x[:, None]).transpose(3, 0, 1, 2))
        distance += np.where(np.eye(len(start[0]), dtype=bool), np.inf, 0.0)
        y = x[..., 1]
        clear = y.min() > _GRAZE and y.max() < self.width - _GRAZE
        return bool(distance.min() > _CLOSEST and clear)


def _both_ways(rng: np.random.Generator, number: int, width: float) -> Start:
    """Two-way flow."""
    x = np.empty((0, 2))
    v, goal, group = [], [], []
    lane = float(rng.choice([-1, 1]))
    while len(x) < number:
        size = min(int(rng.choice(_GROUP_SIZES, p=_GROUP_SHARES)), number - len(x))
        way = float(rng.choice([-1, 1]))
        place = _free_place(rng, x, size, way, width, lane)
        crosses = size == 1 and rng.uniform() < _CROSSING
        speed = float(np.clip(rng.normal(1.3, 0.2), 0.8, 1.8))
        for start in place:
            if crosses:
                across = width - start[1] if abs(start[1] - width / 2) > 1 else start[1] + way
                end = np.array([way * _AHEAD_CROSSING, across])
            else:
                end = np.array([way * _AHEAD, start[1] + rng.normal(0, 0.3)])
            end[1] = np.clip(end[1], _FROM_WALL, width - _FROM_WALL)
            angle = math.atan2(*(end - start)[::-1]) + rng.normal(0, 0.15)
            pace = speed + rng.normal(0, 0.03)
            v.append(pace * np.array([math.cos(angle), math.sin(angle)]))
            goal.append(end)
            group.append(len(x) if size > 1 else -1)
        x = np.concatenate([x, place])
    return x, np.array(v), np.array(goal), np.array(group)


def _free_place(
    rng: np.random.Generator, taken: np.ndarray, size: int, way: float, width: float, lane: float
) -> np.ndarray:
    """``(size, 2)`` people side by side, away from those that are there."""
    margin, reach = 0.5 * (size - 1) * _SIDE_BY_SIDE + _FROM_WALL, _REACH
    while True:
        # people come from their side, so that most of them meet
        along = -way * rng.uniform(-0.15 * reach, reach)
        across = rng.uniform(margin, width - margin)
        if rng.uniform() < _LANES:
            # most people keep to a lane of their direction, as real crowds soon do
            across = 0.5 * width + way * lane * abs(across - 0.5 * width)
        offset = _SIDE_BY_SIDE * (np.arange(size) - 0.5 * (size - 1))
        place = np.stack([along + rng.normal(0, 0.1, size), across + offset], axis=1)
        distance = np.hypot(*(place[:, None] - taken[None]).transpose(2, 0, 1))
        if distance.min(initial=np.inf) > _APART:
            return place
        # a full corridor becomes a longer one
        reach *= 1.01


def _same_way(rng: np.random.Generator, number: int, width: float) -> Start:
    """People far apart, side by side, in one direction and at one speed."""
    rows = np.arange(number) // 2
    lane = np.where(np.arange(number) % 2 == 0, -0.5, 0.5)
    first = -HALF_LENGTH + 1 + rng.uniform(0, 1)
    x = np.stack([first + _LOOSE * rows, 0.5 * width + _LOOSE * lane], axis=1)
    v = np.tile([float(rng.uniform(1.1, 1.4)), 0.0], (number, 1))
    goal = x + np.array([2 * _AHEAD, 0.0])
    return x, v, goal, np.full(number, -1)
