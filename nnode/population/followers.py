"""Followers of a lane, each behind the measured and smoothed paths of the vehicles ahead.

Given these paths, the likelihood of a platoon is the product of those of its followers, and what is
particular about a leader does not disturb the estimates of those behind. The price is an error in
variables: the smoothed path of a leader has errors of its own.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, cast

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from nnode.calibrate.parameters import ParameterVector
from nnode.data.clusters import clusters, index_of
from nnode.data.paths import smooth, velocity
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.smooth import measured_noise
from nnode.errors import ConfigError
from nnode.model.differentiate import derivatives
from nnode.model.formula import inputs_of
from nnode.model.lane_rates import SAFE, Formulas
from nnode.model.scene import Scene
from nnode.model.system import System, with_parameters
from nnode.model.term import State, Term
from nnode.model.terms import own_values, values_of
from nnode.population.estimate import Estimate, estimate
from nnode.population.likelihood import Linearised, Noise
from nnode.simulation.numpy import simulated, strides
from nnode.simulation.rhs import formula_of, side_by_side

#: Longest step, s, by the law's order; that of laws which say what holds one step later.
STEP, MAPPED = {1: 0.4, 2: 0.2}, 0.1
#: Least standard deviation of errors of measurement, m: that of a camera.
FLOOR = 0.01
#: Differences for derivatives: of parameters, relative; of states at the start, m and m/s.
DIFFERENCE, START_DIFFERENCE = 1e-4, 1e-2
#: Standard normal numbers of a shape.
Draw = Callable[[tuple[int, ...]], np.ndarray]
#: How closely modes are found where the parameters are given, see :func:`estimate`.
MODES = 0.02
#: States beside those of motion that disturbances may act through.
STATES = 4


@dataclass(frozen=True, kw_only=True)
class Paths:
    """What F followers were measured to do, and the vehicles ahead of them.

    Attributes:
        x: ``(F, K)`` measured positions of the followers, m.
        seen: ``(F, K)`` True where there is a sample.
        sequence, place: ``(F,)`` the sequence and the place in the platoon.
        agent, cluster: ``(F,)`` numbers of the follower and of its cluster, from 0.
        names: of the agents.
        smoothed: of each sequence ``(K, N)`` smoothed positions, m.
        dt: sampling interval, s. half: that of ``ahead``, s.
        ahead: ``(H, 4, F)`` smoothed positions (m) and speeds (m/s) of the first and the second
            vehicle ahead. The second is a safe distance ahead of the first where there is none.
        second: ``(F,)`` 1 where there is a second vehicle ahead.
        start: ``(2, F)`` smoothed position and speed at the first sample.
        error: standard deviation of the errors of measurement, m.
        batch: of each follower the smoothed paths of himself and of the one or two vehicles ahead.
    """

    x: np.ndarray
    seen: np.ndarray
    sequence: np.ndarray
    place: np.ndarray
    agent: np.ndarray
    cluster: np.ndarray
    names: tuple[str, ...]
    smoothed: list[np.ndarray]
    dt: float
    half: float
    ahead: np.ndarray
    second: np.ndarray
    start: np.ndarray
    error: float
    batch: Batch

    def remeasured(self, x: np.ndarray, draw: Draw) -> Paths:
        """The paths with other followers, and with leaders as they would be measured and smoothed
        if the smoothed paths were their true ones.

        Args:
            x: ``(F, K)`` true positions of the followers, m.
            draw: of the errors of measurement.
        """
        measured = x + self.error * draw(x.shape)
        smoothed = [smooth(true + self.error * draw(true.shape)) for true in self.smoothed]
        ahead = _ahead(smoothed, self.sequence, self.place, len(self.ahead), self.half, self.dt)
        start = np.empty_like(self.start)
        for f, path in enumerate(measured):
            own = smooth(path[self.seen[f]])
            spline = CubicSpline(self.dt * np.arange(len(own)), own)
            start[:, f] = spline(0.0), spline(0.0, 1)
        return replace(self, x=measured, smoothed=smoothed, ahead=ahead, start=start)


def paths_of(sequences: list[Sequence], step: float) -> Paths:
    """The followers of sequences of one sampling interval.

    Args:
        step: longest step of a simulation, s.
    """
    dt, samples = sequences[0].dt, max(s.n_samples for s in sequences)
    stride, parts = strides(dt, step)
    half = dt * stride / parts / 2
    times = 2 * math.ceil((samples - 1) / stride) * parts + 1
    which = [(b, i) for b, s in enumerate(sequences) for i in range(s.n_agents - 1)]
    x, seen = np.zeros((len(which), samples)), np.zeros((len(which), samples), dtype=bool)
    agents = dict[tuple[str, str], int]()
    names, agent = list[str](), list[int]()
    for f, (b, i) in enumerate(which):
        s = sequences[b]
        x[f, : s.n_samples], seen[f, : s.n_samples] = s.x[:, i, 0], True
        key = (s.site or s.recording, s.agents[i]) if s.agents else (s.name, f"{s.name}:{i}")
        if key not in agents:
            agents[key] = len(names)
            names.append(key[1])
        agent.append(agents[key])
    sequence, place = np.array(which).T
    smoothed = [smooth(s.x[..., 0]) for s in sequences]
    start = np.empty((2, len(which)))
    for f, (b, i) in enumerate(which):
        spline = CubicSpline(dt * np.arange(len(smoothed[b])), smoothed[b][:, i])
        start[:, f] = spline(0.0), spline(0.0, 1)
    noise = measured_noise(sequences).position
    return Paths(
        x=x, seen=seen, sequence=sequence, place=place, agent=np.array(agent),
        cluster=np.unique(clusters(index_of(sequences))[sequence], return_inverse=True)[1],
        names=tuple(names), smoothed=smoothed, dt=dt, half=half,
        ahead=_ahead(smoothed, sequence, place, times, half, dt), start=start,
        second=np.array([float(i + 2 < sequences[b].n_agents) for b, i in which]),
        error=max(noise, FLOOR) if math.isfinite(noise) else FLOOR,
        batch=collate(_with_those_ahead(sequences[b], smoothed[b], i) for b, i in which),
    )  # fmt: skip


def _with_those_ahead(s: Sequence, smoothed: np.ndarray, place: int) -> Sequence:
    """The smoothed paths of a follower and of the one or two vehicles ahead of him."""
    x = smoothed[..., None]
    index = np.arange(s.n_agents)
    smooth_sequence = replace(s, x=x, v=velocity(x, s.dt))
    return smooth_sequence.select((index >= place) & (index <= place + 2))


def _ahead(
    smoothed: list[np.ndarray], sequence: np.ndarray, place: np.ndarray, times: int, half: float,
    dt: float,
) -> np.ndarray:  # fmt: skip
    """``(H, 4, F)`` as in :class:`Paths`; after the last sample vehicles stay where they were."""
    found = np.empty((times, 4, len(sequence)))
    for b, paths in enumerate(smoothed):
        time = dt * np.arange(len(paths))
        at = np.minimum(half * np.arange(times), time[-1])
        spline = CubicSpline(time, paths)
        x, v = spline(at), spline(at, 1)
        for f in np.flatnonzero(sequence == b):
            first = place[f] + 1
            second = min(first + 1, paths.shape[1] - 1)
            far = SAFE if second == first else 0.0
            found[:, :, f] = np.stack(
                [x[:, first], v[:, first], x[:, second] + far, v[:, second]], 1
            )
    return found


class Followers:
    """A model of a lane, as a response to parameters and to deviations of drivers and starts.

    Parameters that are positive are varied in logarithms.

    Args:
        system: the model; only its parameters that need a gradient are varied.
        paths: the followers.
        random: names of the parameters that differ between drivers, as ``idm.T``.

    Attributes:
        names: P names of the parameters.
        logs: ``(P,)`` True for parameters that are varied in logarithms.
        random: ``(Q,)`` numbers of those that differ between drivers.

    Raises:
        ConfigError: a model that is no formula, or that reads states of other vehicles.
    """

    def __init__(self, system: System, paths: Paths, random: list[str] | None = None) -> None:
        self.system, self.paths = system, paths
        terms = cast(list[Term], list(system.terms))
        lane, self.code = formula_of(system), None
        if lane is None and terms and terms[-1].side_by_side:
            lane, self.code = formula_of(system, -1), terms[-1]
        if lane is None or any(name not in ("x", "v") for name, _ in lane.ahead):
            raise ConfigError(
                "drivers who differ need a model of a lane whose law and effects are formulas of "
                "the positions and speeds of the vehicles ahead; take drivers=none"
            )
        self.lane, formulas = lane, terms if self.code is None else terms[:-1]
        self.vector = ParameterVector(system)
        symbols = {(name, place): symbol for symbol, (name, place, _) in lane.owned.items()}
        # parameters of code have no symbol
        self._symbols = [symbols.get(place, place[0]) for place in self.vector.places]
        self.names = [symbol.replace("__", ".", 1) for symbol in self._symbols]
        low, high = self.vector.bounds
        row = self.vector.row.numpy()
        law = np.array([name.startswith(f"{terms[0].name}.") for name in self.names], dtype=bool)
        # a law without a bound leaves it open; its quantities have a sign
        self.logs = ((low >= 0) | (law & np.isinf(low))) & (row > 0)
        self.random = np.array([self.names.index(name) for name in random or []], dtype=int)
        self.start = self.at(row)
        least = 1e-3 * np.abs(row)
        self.low, self.high = self.at(np.maximum(low, least * self.logs)), self.at(high)
        self._scene = system.scene(paths.batch)
        inputs = inputs_of(formulas, lane, self._scene)
        self._fixed: dict[str, Any] = {n: v[:, 0].double().numpy() for n, v in inputs.items()}
        self._fixed |= {
            "start": paths.batch.start.numpy(),
            "dt": 2 * paths.half,
            "second": paths.second,
        }
        own = {name: value.detach().double() for name, value in own_values(formulas, lane).items()}
        values = values_of(lane, own)
        self._fixed |= {s: float(v) for s, v in zip(lane.owned, values, strict=True)}
        self._rates = Formulas(list(lane.rates.values()))
        self._starts = Formulas(list(lane.starts.values())) if lane.starts else None
        self._scenes: dict[tuple[int, bool], Scene] = {}

    def behind(self, paths: Paths) -> Followers:
        """The same model of other paths of the same followers."""
        found = copy.copy(self)
        found.paths = paths
        return found

    def at(self, row: np.ndarray) -> np.ndarray:
        """Parameters in the scales in which they are varied."""
        return np.where(self.logs, np.log(np.where(self.logs, np.maximum(row, 1e-12), 1.0)), row)

    def natural(self, theta: np.ndarray) -> np.ndarray:
        """Parameters in SI units, from those in the scales in which they are varied."""
        return np.where(self.logs, np.exp(np.where(self.logs, theta, 0.0)), theta)

    def simulate(
        self, theta: np.ndarray, start: np.ndarray, pushes: np.ndarray | None = None
    ) -> np.ndarray:
        """``(K, M, R, F)`` states of R runs.

        Args:
            theta: ``(R, P, F)`` parameters. start: ``(R, 2, F)`` positions and speeds at the start.
            pushes: ``(H, F)`` on the highest rate, by the times of the paths ahead.
        """
        paths, order = self.paths, self.lane.order
        given = self._given(theta)

        def rate(t: float, y: np.ndarray) -> np.ndarray:
            rates = self._rate(t, y, given, self._ahead(round(t / paths.half)))
            if pushes is not None:
                rates[order - 1] += pushes[round(t / paths.half)]
            return rates

        motion = list(start.transpose(1, 0, 2)[:order])
        if self._starts is not None:
            at = {**given, "x": start[:, 0], "v": start[:, 1], "t": 0.0, **self._ahead(0)}
            motion += [np.broadcast_to(one, motion[0].shape) for one in self._starts(at)]
        with np.errstate(all="ignore"):
            return simulated(
                rate, np.stack(motion), paths.dt, paths.x.shape[1], 2 * paths.half + 1e-9
            )

    def rates(self, theta: np.ndarray, states: np.ndarray) -> np.ndarray:
        """``(K, M, F)`` rates along a run.

        Args:
            theta: ``(P, F)`` parameters. states: ``(K, M, F)`` at the samples.
        """
        with np.errstate(all="ignore"):
            return self._rate(
                self._times, states.transpose(1, 0, 2), self._given(theta[None]),
                self._ahead(self._samples), along=True,
            ).transpose(1, 0, 2)  # fmt: skip

    def state(self, states: np.ndarray, rates: np.ndarray) -> State:
        """What terms see along a run, ``(K F, 3, 1)``; simulation f of sample k is k F + f.

        Args:
            states, rates: ``(K, M, F)`` at the samples.
        """
        ahead = self._ahead(self._samples)
        return self._state(self._times, states[:, 0], rates[:, 0], ahead, along=True)

    @cached_property
    def _samples(self) -> np.ndarray:
        """``(K,)`` where the samples are in the paths ahead."""
        number = self.paths.x.shape[1]
        return np.round(np.arange(number) * self.paths.dt / self.paths.half).astype(int)

    @cached_property
    def _times(self) -> np.ndarray:
        """``(K, 1)`` times of the samples, s."""
        return self.paths.dt * np.arange(self.paths.x.shape[1])[:, None]

    def _given(self, theta: np.ndarray) -> dict[str, Any]:
        """What does not change in runs with parameters ``(R, P, F)``."""
        natural = self.natural(theta.transpose(0, 2, 1)).transpose(2, 0, 1)
        return {**self._fixed, **dict(zip(self._symbols, natural, strict=True))}

    def _ahead(self, at: Any) -> dict[str, Any]:
        """The vehicles ahead at one or several of the times of their paths."""
        x1, v1, x2, v2 = np.moveaxis(self.paths.ahead[at], -2, 0)
        return {"x_1": x1, "v_1": v1, "dx_1": v1, "x_2": x2, "v_2": v2, "measured": v1}

    def _rate(
        self, t: Any, y: np.ndarray, given: dict[str, Any], ahead: dict[str, Any], *,
        along: bool = False,
    ) -> np.ndarray:  # fmt: skip
        """``(M, L, F)`` rates of L runs, or along a run of L samples."""
        values = {**given, **dict(zip(self.lane.rates, y, strict=True)), "t": t, **ahead}
        found = np.stack([np.broadcast_to(one, y.shape[1:]) for one in self._rates(values)])
        if self.code is not None:
            wide = {
                name.rpartition(".")[2]: torch.from_numpy(given[name]).reshape(-1, 1, 1)
                for name in self.vector.names
                if name in given
            }
            if along:
                wide = {name: one.repeat(len(y[0]), 1, 1) for name, one in wide.items()}
            state = self._state(t, y[0], found[0], ahead, along)
            with torch.no_grad():
                added = with_parameters(self.code, wide)(state)
            found[self.lane.order - 1] += added[:, 0, 0].numpy().reshape(y.shape[1:])
        return found

    def _state(
        self, t: Any, x: np.ndarray, speed: np.ndarray, ahead: dict[str, Any], along: bool
    ) -> State:
        shape, key = x.shape, (len(x), along)
        if key not in self._scenes:
            self._scenes[key] = side_by_side(self._scene, len(x), at_samples=along)
        every = [
            np.stack([np.broadcast_to(one, shape) for one in of], -1).reshape(-1, 3, 1)
            for of in ((x, ahead["x_1"], ahead["x_2"]), (speed, ahead["v_1"], ahead["v_2"]))
        ]
        place, rate = (torch.from_numpy(one)[:, : self._scene.agent.shape[1]] for one in every)
        time = torch.as_tensor(t, dtype=torch.float64)
        time = time.expand(shape).flatten() if time.ndim else time
        moving = rate if self.lane.order > 1 else None
        return State(time, place, moving, self._scenes[key], rate=rate)

    def _spread(self, theta: np.ndarray, agents: np.ndarray) -> np.ndarray:
        """``(P, F)`` parameters of each follower."""
        found = np.repeat(theta[:, None], len(self.paths.agent), 1)
        if agents.size:
            found[self.random] += agents[self.paths.agent].T
        return found

    def __call__(self, theta: np.ndarray, agents: np.ndarray, start: np.ndarray) -> Linearised:
        paths, order = self.paths, self.lane.order
        own, begin = self._spread(theta, agents), paths.start.copy()
        begin[:order] += start.T if start.size else 0.0
        number = len(theta)
        runs = np.repeat(own[None], 1 + 2 * (number + order), 0)
        begins = np.repeat(begin[None], len(runs), 0)
        for p in range(number):
            runs[1 + 2 * p, p] += DIFFERENCE
            runs[2 + 2 * p, p] -= DIFFERENCE
        for h in range(order):
            begins[1 + 2 * (number + h), h] += START_DIFFERENCE
            begins[2 + 2 * (number + h), h] -= START_DIFFERENCE
        states = self.simulate(runs, begins)
        x = states[:, 0].transpose(1, 2, 0)  # (R, F, K)
        higher, lower = x[1::2], x[2::2]
        step = np.repeat([DIFFERENCE, START_DIFFERENCE], [number, order])
        columns = ((higher - lower) / (2 * step[:, None, None])).transpose(1, 2, 0)
        fixed, first = columns[..., :number], columns[..., number:]
        random = fixed[..., self.random]
        residual = paths.x - x[0]
        if agents.size:
            residual = residual + np.einsum("fkq,fq->fk", random, agents[paths.agent])
        if start.size:
            residual = residual + np.einsum("fkh,fh->fk", first, start)
        moved, forced = self._linear(own, states[:, :, 0])
        return Linearised(
            residual=residual, fixed=fixed, random=random, start=first, seen=paths.seen,
            agent=paths.agent, step=moved, forced=forced, dt=paths.dt,
        )  # fmt: skip

    @cached_property
    def _slopes(self) -> tuple[list[tuple[int, int]], Formulas]:
        """Derivatives of the rates by the states through which disturbances act."""
        states = list(self.lane.rates)
        number = len(states) if len(states) <= self.lane.order + STATES else self.lane.order
        states = states[:number]
        found = [
            ((p, q), slope)
            for p, state in enumerate(states)
            for q, name in enumerate(states)
            if (slope := derivatives(self.lane.rates[state], [name]).get(name)) is not None
        ]
        return [place for place, _ in found], Formulas([slope for _, slope in found])

    def _linear(self, own: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The linear response along a run ``(K, M, F)``, by the trapezoidal rule."""
        paths, lane = self.paths, self.lane
        samples = len(states)
        values = {
            **self._given(own[None]),
            **dict(zip(lane.rates, states.transpose(1, 0, 2), strict=True)),
            "t": self._times, **self._ahead(self._samples),
        }  # fmt: skip
        which, function = self._slopes
        size = max((max(place) for place in which), default=lane.order - 1) + 1
        size = max(size, lane.order)
        matrix = np.zeros((samples, len(paths.agent), size, size))
        with np.errstate(all="ignore"):
            for (p, q), value in zip(which, function(values), strict=True):
                matrix[..., p, q] = np.broadcast_to(value, matrix.shape[:2])
        # a linearisation that blows up describes no disturbance
        matrix = np.clip(np.nan_to_num(matrix.transpose(1, 0, 2, 3)), -1 / paths.dt, 1 / paths.dt)
        half, one = paths.dt / 2, np.eye(size)
        after = np.linalg.inv(one - half * matrix[:, 1:])
        push = np.zeros(size)
        push[lane.order - 1] = half
        return np.ascontiguousarray(after @ (one + half * matrix[:, :-1])), np.ascontiguousarray(
            after @ push
        )

    def drawn(self, found: Estimate, draw: Draw) -> Paths:
        """Paths that the estimated model would have had.

        Args:
            found: an estimate of this model, with pushes ``sigma``, ``tau``.
            draw: of deviations of drivers, pushes and errors.
        """
        paths, (sigma, tau) = self.paths, found.variances.noise
        agents = found.variances.spread * draw(found.agents.shape)
        keep = math.exp(-paths.half / tau)
        shape = len(paths.ahead), len(paths.agent)
        fresh = sigma * draw(shape)
        pushes = fresh.copy()
        for k in range(1, shape[0]):
            pushes[k] = keep * pushes[k - 1] + math.sqrt(1 - keep**2) * fresh[k]
        begin = paths.start.copy()
        begin[: self.lane.order] += found.start.T
        own = self._spread(found.theta, agents)
        x = self.simulate(own[None], begin[None], pushes)[:, 0, 0].T
        return paths.remeasured(x, draw)


def score_bias(
    model: Followers, noise: Noise, found: Estimate, rng: np.random.Generator, pairs: int = 4
) -> np.ndarray:
    """``(P,)`` by how much estimates are off, by simulation.

    Data that the estimated model draws are scored at the parameters that they were drawn with. The
    mean of a correct score is zero; the linearisation at the modes and the errors of smoothed
    leaders move it. Draws come in pairs of opposite signs, in which the linear part of the score
    cancels.

    Args:
        pairs: number of pairs.
    """
    fixed = found.variances
    fixed = replace(fixed, low=fixed.row, high=fixed.row)
    changes = []
    for _ in range(pairs):
        seed = rng.integers(2**63)
        for sign in (1.0, -1.0):
            draw = partial(_signed, np.random.default_rng(seed), sign)
            paths = model.drawn(found, draw)
            again = estimate(
                model.behind(paths), noise, found.theta, fixed, low=found.theta, high=found.theta,
                tolerance=MODES,
            )  # fmt: skip
            changes.append(again.marginal.change)
    return np.asarray(np.mean(changes, 0))


def _signed(rng: np.random.Generator, sign: float, shape: tuple[int, ...]) -> np.ndarray:
    return sign * rng.standard_normal(shape)
