"""Followers of a lane, each behind the measured and smoothed paths of the vehicles ahead.

Given these paths, the likelihood of a platoon is the product of those of its followers, and what is
particular about a leader does not disturb the estimates of those behind. The price is an error in
variables: the smoothed path of a leader has errors of its own.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, cast

import numpy as np
from scipy.interpolate import CubicSpline

from nnode.calibrate.parameters import ParameterVector
from nnode.data.paths import smooth
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.smooth import measured_noise
from nnode.errors import ConfigError, SimulationError
from nnode.model.differentiate import derivatives
from nnode.model.formula import inputs_of
from nnode.model.lane_rates import SAFE, Formulas
from nnode.model.system import System
from nnode.model.term import Term
from nnode.model.terms import LaneDynamics, own_values, values_of
from nnode.population.estimate import Estimate, fit_deviations
from nnode.population.likelihood import Linearised, Noise
from nnode.simulation.linear import trapezoidal
from nnode.simulation.numpy import simulated, strides
from nnode.simulation.rhs import formula_of

#: Least standard deviation of errors of measurement, m: that of a camera.
FLOOR = 0.01
#: Errors of positions that are new at every sample, m, between which followers are simulated
#: behind their own leaders unless something else is asked for. Below, positions were smoothed or
#: simulated: SUMO's paths at 5 Hz, which have none, look like errors of 0.011 m, and errors of
#: smoothed positions last, which the likelihood does not know of. Above, smoothed leaders keep too
#: much: ESIMAS's errors of 0.57 m are taken for pushes. A table in docs/discovery.md compares both
#: ways at errors below the upper limit.
NOISE = (0.015, 0.45)
#: Differences for derivatives: of parameters, relative; of states at the start, m and m/s.
DIFFERENCE, START_DIFFERENCE = 1e-4, 1e-2
#: What is added to the highest rate ``(R, F)``, of the number among the times of the paths ahead,
#: and of states and rates ``(M, R, F)``.
Push = Callable[[int, np.ndarray, np.ndarray], np.ndarray]
#: Standard normal numbers of a shape.
Draw = Callable[[tuple[int, ...]], np.ndarray]
#: States beside those of motion that disturbances may act through.
STATES = 4


@dataclass(frozen=True, kw_only=True)
class Paths:
    """What F followers were measured to do, and the vehicles ahead of them.

    Attributes:
        x: ``(F, K)`` measured positions of the followers, m.
        seen: ``(F, K)`` True where there is a sample.
        sequence, place: ``(F,)`` the sequence and the place in the platoon.
        agent: ``(F,)`` number of the follower, from 0.
        names: of the agents.
        smoothed: of each sequence ``(K, N)`` smoothed positions, m.
        dt: sampling interval, s. half: that of ``ahead``, s.
        ahead: ``(H, 4, F)`` smoothed positions (m) and speeds (m/s) of the first and the second
            vehicle ahead. The second is a safe distance ahead of the first where there is none.
        ahead_at_samples: ``(K, 4, F)`` the same at the sampling times.
        second: ``(F,)`` 1 where there is a second vehicle ahead.
        start: ``(2, F)`` smoothed position and speed at the first sample.
        error: standard deviation of the errors of measurement, m.
        batch: of each follower the sequence with himself and the one or two vehicles ahead.
    """

    x: np.ndarray
    seen: np.ndarray
    sequence: np.ndarray
    place: np.ndarray
    agent: np.ndarray
    names: tuple[str, ...]
    smoothed: list[np.ndarray]
    dt: float
    half: float
    ahead: np.ndarray
    ahead_at_samples: np.ndarray
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
        which = smoothed, self.sequence, self.place, self.dt
        start = np.stack(
            [
                _start(smooth(path[seen]), self.dt)
                for path, seen in zip(measured, self.seen, strict=True)
            ],
            1,
        )
        return replace(
            self,
            x=measured,
            smoothed=smoothed,
            start=start,
            ahead=_ahead(*which, len(self.ahead), self.half),
            ahead_at_samples=_ahead(*which, x.shape[1], self.dt),
        )


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
    start = np.stack([_start(smoothed[b][:, i], dt) for b, i in which], 1)
    noise = measured_noise(sequences).position
    return Paths(
        x=x,
        seen=seen,
        sequence=sequence,
        place=place,
        agent=np.array(agent),
        names=tuple(names),
        smoothed=smoothed,
        dt=dt,
        half=half,
        ahead=_ahead(smoothed, sequence, place, dt, times, half),
        ahead_at_samples=_ahead(smoothed, sequence, place, dt, samples, dt),
        start=start,
        second=np.array([float(i + 2 < sequences[b].n_agents) for b, i in which]),
        error=max(noise, FLOOR) if math.isfinite(noise) else FLOOR,
        batch=collate(_with_those_ahead(sequences[b], i) for b, i in which),
    )


def _with_those_ahead(s: Sequence, place: int) -> Sequence:
    """The sequence of a follower and of the one or two vehicles ahead of him."""
    index = np.arange(s.n_agents)
    return s.select((index >= place) & (index <= place + 2))


def _start(path: np.ndarray, dt: float) -> np.ndarray:
    """``(2,)`` position and speed at the first sample of a smoothed path."""
    spline = CubicSpline(dt * np.arange(len(path)), path)
    return np.array([spline(0.0), spline(0.0, 1)])


def _ahead(
    smoothed: list[np.ndarray],
    sequence: np.ndarray,
    place: np.ndarray,
    dt: float,
    times: int,
    apart: float,
) -> np.ndarray:
    """``(H, 4, F)`` as in :class:`Paths`, at so many times so far apart (s); after the last sample
    vehicles stay where they were."""
    found = np.empty((times, 4, len(sequence)))
    for b, paths in enumerate(smoothed):
        time = dt * np.arange(len(paths))
        at = np.minimum(apart * np.arange(times), time[-1])
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


def _named(ahead: np.ndarray) -> dict[str, np.ndarray]:
    """What formulas call the vehicles ahead ``(4, ..., F)``."""
    x1, v1, x2, v2 = ahead
    return {"x_1": x1, "v_1": v1, "dx_1": v1, "x_2": x2, "v_2": v2, "measured": v1}


def behind_leaders(system: System) -> LaneDynamics | None:
    """The formula of a model that needs no more than the positions and the speeds of the vehicles
    ahead; None for others."""
    lane = formula_of(system)
    if lane is None or any(name not in ("x", "v") for name, _ in lane.ahead):
        return None
    return lane


def drivers_differ(system: System, sequences: Iterable[Sequence]) -> bool:
    """Whether it is estimated how drivers differ unless something else is asked for: with formulas
    of the positions and the speeds of a driver and of the vehicles ahead, where these were measured
    well enough."""
    if behind_leaders(system) is None:
        return False
    return NOISE[0] < measured_noise(sequences).position < NOISE[1]


def _followed(lane: LaneDynamics) -> int:
    """States through which disturbances act, those at the start as well."""
    number = len(lane.rates)
    return number if number <= lane.order + STATES else lane.order


@cache
def _slopes(lane: LaneDynamics) -> tuple[list[tuple[int, int]], Formulas]:
    """Derivatives of the rates by the states through which disturbances act: which, and a function
    of all."""
    states = list(lane.rates)
    number = _followed(lane)
    found = [
        ((p, states.index(name)), slope)
        for p, state in enumerate(states[:number])
        for name, slope in derivatives(lane.rates[state], states[:number]).items()
    ]
    return [place for place, _ in found], Formulas([slope for _, slope in found])


class Followers:
    """A model of a lane, as a response to parameters and to deviations of drivers and starts.

    Parameters that are positive are varied in logarithms.

    Args:
        system: the model; only its parameters that need a gradient are varied.
        paths: the followers.
        random: names of the parameters that differ between drivers, as ``idm.T``.

    Attributes:
        names: P names of the parameters.
        law: ``(P,)`` True for those of the law; logs: for those that are varied in logarithms.
        starts: number H of states whose start is estimated.
        random: ``(Q,)`` numbers of those that differ between drivers.

    Raises:
        ConfigError: a model that is no formula, or that reads states of other vehicles.
    """

    def __init__(self, system: System, paths: Paths, random: list[str] | None = None) -> None:
        self.system, self.paths = system, paths
        terms, lane = cast(list[Term], list(system.terms)), behind_leaders(system)
        if lane is None:
            raise ConfigError(
                "drivers who differ need a model of a lane whose law and effects are formulas of "
                "the positions and speeds of the vehicles ahead; take drivers=none"
            )
        self.lane, self.starts = lane, _followed(lane)
        self.vector = ParameterVector(system)
        symbols = {(name, place): symbol for symbol, (name, place, _) in lane.owned.items()}
        self._symbols = [symbols[place] for place in self.vector.places]
        self.names = [symbol.replace("__", ".", 1) for symbol in self._symbols]
        low, high = self.vector.bounds
        row = self.vector.row.numpy()
        own = f"{terms[0].name}."
        self.law = np.array([name.startswith(own) for name in self.names], dtype=bool)
        # a law without a bound leaves it open; its quantities have a sign
        self.logs = ((low >= 0) | (self.law & np.isinf(low))) & (row > 0)
        self.random = np.array([self.names.index(name) for name in random or []], dtype=int)
        self.start = self.at(row)
        least = 1e-3 * np.abs(row)
        self.low, self.high = self.at(np.maximum(low, least * self.logs)), self.at(high)
        inputs = inputs_of(terms, lane, system.scene(paths.batch))
        self._fixed: dict[str, Any] = {n: v[:, 0].double().numpy() for n, v in inputs.items()}
        self._fixed |= {
            "start": paths.batch.start.numpy(),
            "dt": 2 * paths.half,
            "second": paths.second,
        }
        known = {name: value.detach().double() for name, value in own_values(terms, lane).items()}
        values = values_of(lane, known)
        self._fixed |= {s: float(v) for s, v in zip(lane.owned, values, strict=True)}
        self._rates = Formulas(list(lane.rates.values()))
        self._starts = Formulas(list(lane.starts.values())) if lane.starts else None

    @property
    def that_may_differ(self) -> list[str]:
        """Names of the law's parameters that are varied in logarithms."""
        own = zip(self.names, self.logs & self.law, strict=True)
        return [name for name, differs in own if differs]

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
        self, theta: np.ndarray, start: np.ndarray, pushed: Push | None = None
    ) -> np.ndarray:
        """``(K, M, R, F)`` states of R runs.

        Args:
            theta: ``(R, P, F)`` parameters.
            start: ``(R, H, F)`` deviations of the first H states at the start, from what was
                measured and from what terms begin with.
            pushed: what is added to the highest rate.
        """
        paths, order = self.paths, self.lane.order
        given = self._given(theta)

        def rate(t: float, y: np.ndarray) -> np.ndarray:
            at = round(t / paths.half)
            values = {**given, **dict(zip(self.lane.rates, y, strict=True)), "t": t}
            found = np.empty_like(y)
            rates = self._rates({**values, **_named(paths.ahead[at])})
            for own, one in zip(found, rates, strict=True):
                own[...] = one
            if pushed is not None:
                found[order - 1] += pushed(at, y, found)
            return found

        shape = len(theta), len(paths.agent)
        begin = np.stack([np.broadcast_to(one, shape) for one in paths.start[:order]])
        begin += start.transpose(1, 0, 2)[:order]
        if self._starts is not None:
            at = {**given, "x": begin[0], "v": begin[-1], "t": 0.0, **_named(paths.ahead[0])}
            if order == 1:
                at["v"] = np.broadcast_to(paths.start[1], shape)
            added = [np.broadcast_to(one, shape) for one in self._starts(at)]
            begin = np.concatenate([begin, np.stack(added)])
            begin[order : start.shape[1]] += start.transpose(1, 0, 2)[order:]
        with np.errstate(all="ignore"):
            return simulated(rate, begin, paths.dt, paths.x.shape[1], 2 * paths.half + 1e-9)

    def _given(self, theta: np.ndarray) -> dict[str, Any]:
        """What does not change in runs with parameters ``(R, P, F)``."""
        natural = self.natural(theta.transpose(0, 2, 1)).transpose(2, 0, 1)
        return {**self._fixed, **dict(zip(self._symbols, natural, strict=True))}

    def spread(self, theta: np.ndarray, agents: np.ndarray) -> np.ndarray:
        """``(P, F)`` parameters of each follower."""
        found = np.repeat(theta[:, None], len(self.paths.agent), 1)
        if agents.size:
            found[self.random] += agents[self.paths.agent].T
        return found

    def __call__(self, theta: np.ndarray, agents: np.ndarray, start: np.ndarray) -> Linearised:
        paths, order = self.paths, self.lane.order
        own, number, several = self.spread(theta, agents), len(theta), self.starts
        begin = start.T if start.size else np.zeros((several, len(paths.agent)))
        runs = np.repeat(own[None], 1 + 2 * (number + several), 0)
        begins = np.repeat(begin[None], len(runs), 0)
        for p in range(number):
            runs[1 + 2 * p, p] += DIFFERENCE
            runs[2 + 2 * p, p] -= DIFFERENCE
        for h in range(several):
            begins[1 + 2 * (number + h), h] += START_DIFFERENCE
            begins[2 + 2 * (number + h), h] -= START_DIFFERENCE
        states = self.simulate(runs, begins)
        x = states[:, 0].transpose(1, 2, 0)  # (R, F, K)
        higher, lower = x[1::2], x[2::2]
        step = np.repeat([DIFFERENCE, START_DIFFERENCE], [number, several])
        columns = ((higher - lower) / (2 * step[:, None, None])).transpose(1, 2, 0)
        fixed, first = columns[..., :number], columns[..., number:]
        random = fixed[..., self.random]
        residual = paths.x - x[0]
        if agents.size:
            residual = residual + np.einsum("fkq,fq->fk", random, agents[paths.agent])
        if start.size:
            residual = residual + np.einsum("fkh,fh->fk", first, start)
        moved, after = self.linear(own, states[:, :, 0])
        forced = np.ascontiguousarray(after[..., order - 1])
        return Linearised(
            residual=residual,
            fixed=fixed,
            random=random,
            start=first,
            seen=paths.seen,
            agent=paths.agent,
            step=moved,
            forced=forced,
            dt=paths.dt,
        )

    def rates(self, own: np.ndarray, states: np.ndarray) -> np.ndarray:
        """``(M, K, F)`` rates along a run.

        Args:
            own: ``(P, F)`` parameters of each follower. states: ``(K, M, F)`` of the run.
        """
        with np.errstate(all="ignore"):
            found = self._rates(self._along(own, states))
        return np.stack([np.broadcast_to(one, states[:, 0].shape) for one in found])

    def _along(self, own: np.ndarray, states: np.ndarray) -> dict[str, Any]:
        """What formulas name along a run."""
        times = self.paths.dt * np.arange(len(states))
        return {
            **self._given(own[None]),
            **dict(zip(self.lane.rates, states.transpose(1, 0, 2), strict=True)),
            "t": times[:, None],
            **_named(self.paths.ahead_at_samples.swapaxes(0, 1)),
        }

    def linear(self, own: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The linear response along a run by the trapezoidal rule, of the M states of motion and
        of a few that terms remember.

        Args:
            own, states: as of :meth:`rates`.

        Returns:
            Two arrays ``(F, K - 1, M, M)``: the states after a sampling interval by those before,
            and by the sum of the changes of their rates at both ends.
        """
        paths, lane = self.paths, self.lane
        which, function = _slopes(lane)
        size = max([lane.order, *(max(place) + 1 for place in which)])
        matrix = np.zeros((len(states), len(paths.agent), size, size))
        with np.errstate(all="ignore"):
            for (p, q), value in zip(which, function(self._along(own, states)), strict=True):
                matrix[..., p, q] = np.broadcast_to(value, matrix.shape[:2])
        # a linearisation that blows up describes no disturbance
        matrix = np.clip(np.nan_to_num(matrix), -1 / paths.dt, 1 / paths.dt)
        step, after = (one.numpy().swapaxes(0, 1) for one in trapezoidal(matrix, paths.dt))
        return np.ascontiguousarray(step), np.ascontiguousarray(paths.dt / 2 * after)

    def drawn(self, found: Estimate, draw: Draw) -> Paths:
        """Paths that the estimated model would have had.

        Args:
            found: an estimate of this model, with pushes ``sigma``, ``tau``.
            draw: of deviations of drivers, pushes and errors.

        Raises:
            SimulationError: drawn drivers blow up.
        """
        paths, (sigma, tau) = self.paths, found.variances.noise
        agents = found.variances.spread * draw(found.agents.shape)
        keep = math.exp(-paths.half / tau)
        shape = len(paths.ahead), len(paths.agent)
        fresh = sigma * draw(shape)
        pushes = fresh.copy()
        for k in range(1, shape[0]):
            pushes[k] = keep * pushes[k - 1] + math.sqrt(1 - keep**2) * fresh[k]
        own = self.spread(found.theta, agents)
        x = self.simulate(own[None], found.start.T[None], lambda at, *_: pushes[at])[:, 0, 0].T
        if not np.isfinite(x[paths.seen]).all():
            raise SimulationError("followers with drawn parameters and disturbances blow up")
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
    changes = []
    for _ in range(pairs):
        for draw in opposite(int(rng.integers(2**63))):
            paths = model.drawn(found, draw)
            again = fit_deviations(model.behind(paths), noise, found.theta, found.variances)
            changes.append(again.marginal.change)
    return np.asarray(np.mean(changes, 0))


def opposite(seed: int) -> list[Draw]:
    """Two draws of opposite signs, in which all that is linear in them cancels."""
    return [partial(_signed, np.random.default_rng(seed), sign) for sign in (1.0, -1.0)]


def _signed(rng: np.random.Generator, sign: float, shape: tuple[int, ...]) -> np.ndarray:
    return sign * rng.standard_normal(shape)
