"""Followers of a lane, each behind the measured and smoothed paths of the vehicles ahead.

Given these paths, the likelihood of a platoon is the product of the likelihoods of its followers,
and an unusual leader does not affect the estimates of the followers behind. The price is an error
in variables: the smoothed path of a leader has errors.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, cast

import numpy as np
from scipy.interpolate import CubicSpline
from torch import Tensor

from nnode.calibrate.cost import LEAST_GAP
from nnode.calibrate.intervals import at_bounds
from nnode.calibrate.parameters import ParameterVector
from nnode.data.paths import smooth, whittaker
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.smooth import measured_noise
from nnode.errors import ConfigError, SimulationError
from nnode.model.arrays import Formulas
from nnode.model.differentiate import derivatives
from nnode.model.extend import effects_of
from nnode.model.formula import inputs_of
from nnode.model.lane_rates import SAFE
from nnode.model.system import System
from nnode.model.term import Term
from nnode.model.terms import LaneDynamics, parameter_values
from nnode.population.estimate import Estimate, fit_deviations, fit_variances
from nnode.population.likelihood import Linearised, PushNoise, flat_solve
from nnode.simulation.kernels.followers import AHEAD
from nnode.simulation.kernels.followers import simulate as simulate_compiled
from nnode.simulation.linear import subdivided, trapezoidal
from nnode.simulation.numpy import simulated, strides
from nnode.simulation.rhs import formula_of

#: Smallest standard deviation of measurement errors that fourth differences show, m: that of a
#: camera. Smaller ones are estimated with the other variances.
FLOOR = 0.01
#: Smallest white measurement errors, m. Below it, positions were simulated, or they were smoothed:
#: then their errors are autocorrelated, which the likelihood neglects. SUMO's paths at 5 Hz, which
#: have no errors, seem to have errors of 0.011 m.
WHITE = 0.015
#: Largest errors of smoothed leaders' speeds, relative to how much these speeds vary. With larger
#: ones, leaders' errors are attributed to their followers. The table in docs/discovery.md has what
#: this is for some data.
LEADER_ERROR = 0.2
#: Longest step of laws that are maps from step to step, s: SUMO's default.
MAPPED = 0.1
#: Longest step of models with zones or periods, s: vehicles pass the end of a zone within 0.1 to
#: 0.3 s. Longer steps make errors that are attributed to pushes.
ENDS = 0.1
#: Linear responses of models with a memory take 2**DOUBLINGS steps in a sampling interval, because
#: rates of a memory are larger than 5 per second: 12 / T of a delay T. The table in docs/method.md
#: has what single steps lead to.
DOUBLINGS = 4
#: Positions that were smoothed are used at times that are at least so many seconds apart, because
#: their errors are autocorrelated. The table in docs/method.md has the autocorrelations.
APART = 1.0
#: Differences for derivatives: of parameters, relative; of states at the start, m and m/s.
DIFFERENCE, START_DIFFERENCE = 1e-6, 1e-4
#: Antithetic pairs of simulations that estimate the bias. The Monte Carlo error of four pairs is
#: about 15 % of an estimate's standard error.
PAIRS = 4
#: An estimate is at a bound if its logarithm, or the parameter itself, is closer to it than this.
NEAR = 1e-3
#: At most so many times as many pairs are simulated as are used, see :func:`simulated_pairs`.
ATTEMPTS = 3
#: The push on the highest rate ``(R, F)``, as a function of the index of the time in the paths
#: ahead, and of states and rates ``(M, R, F)``.
Push = Callable[[int, np.ndarray, np.ndarray], np.ndarray]
#: Draws standard normal numbers of a shape.
Draw = Callable[[tuple[int, ...]], np.ndarray]
#: Largest number of states besides those of motion through which disturbances act.
STATES = 4


@dataclass(frozen=True, kw_only=True)
class Paths:
    """The measured paths of F followers, and of the vehicles ahead of them.

    Attributes:
        x: ``(F, K)`` measured positions of the followers, m.
        observed: ``(F, K)`` True where there is a sample.
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
        error: standard deviation of the errors of measurement by fourth differences, m.
        leader: standard deviation (m) and correlation time (s) of the errors of smoothed paths, see
            :func:`_smoothed_error`; the former is 0 if positions have no white errors.
        batch: of each follower the sequence with himself and the one or two vehicles ahead.
    """

    x: np.ndarray
    observed: np.ndarray
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
    leader: tuple[float, float]
    batch: Batch

    @property
    def _samples(self) -> np.ndarray:
        """``(F,)`` number of samples up to the last one that is used."""
        return self.x.shape[1] - np.argmax(self.observed[:, ::-1], 1)

    def apart(self, seconds: float) -> Paths:
        """The same paths, measured only at times that are at least so many seconds apart."""
        stride = max(1, math.ceil(seconds / self.dt - 1e-9))
        return replace(self, observed=self.observed & (np.arange(self.x.shape[1]) % stride == 0))

    def starting_from(self, given: np.ndarray) -> Paths:
        """The same paths, with starts that are smoothed from the given samples ``(K,)`` only."""
        start = [
            _start(smooth(path[:number][given[:number]]), self.dt)
            for path, number in zip(self.x, self._samples, strict=True)
        ]
        return replace(self, start=np.stack(start, 1))

    def remeasured(self, x: np.ndarray, errors: Draw) -> Paths:
        """Simulated measurements: of other followers, and of leaders whose true paths are the
        smoothed ones.

        Args:
            x: ``(F, K)`` true positions of the followers, m.
            errors: draws the errors of measurement of paths ``(..., K)``, m.
        """
        measured = x + errors(x.shape)
        smoothed = [smooth(true + errors(true.shape[::-1]).T) for true in self.smoothed]
        which = smoothed, self.sequence, self.place, self.dt
        remeasured = replace(
            self,
            x=measured,
            smoothed=smoothed,
            ahead=_ahead(*which, len(self.ahead), self.half),
            ahead_at_samples=_ahead(*which, x.shape[1], self.dt),
        )
        return remeasured.starting_from(np.ones(x.shape[1], dtype=bool))


def paths_of(sequences: list[Sequence], step: float, floor: float = FLOOR) -> Paths:
    """The followers of sequences of one sampling interval.

    Args:
        step: longest step of a simulation, s.
        floor: smallest standard deviation of measurement errors, m.
    """
    dt, samples = sequences[0].dt, max(s.n_samples for s in sequences)
    stride, parts = strides(dt, step)
    half = dt * stride / parts / 2
    times = 2 * math.ceil((samples - 1) / stride) * parts + 1
    which = [(b, i) for b, s in enumerate(sequences) for i in range(s.n_agents - 1)]
    x, observed = np.zeros((len(which), samples)), np.zeros((len(which), samples), dtype=bool)
    agents = dict[tuple[str, str], int]()
    names, agent = list[str](), list[int]()
    for f, (b, i) in enumerate(which):
        s = sequences[b]
        x[f, : s.n_samples], observed[f, : s.n_samples] = s.x[:, i, 0], True
        key = (s.site or s.recording, s.agents[i]) if s.agents else (s.name, f"{s.name}:{i}")
        if key not in agents:
            agents[key] = len(names)
            names.append(key[1])
        agent.append(agents[key])
    sequence, place = np.array(which).T
    smoothed, weights = map(list, zip(*[whittaker(s.x[..., 0]) for s in sequences], strict=True))
    start = np.stack([_start(smoothed[b][:, i], dt) for b, i in which], 1)
    noise = measured_noise(sequences).position
    return Paths(
        x=x,
        observed=observed,
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
        error=max(noise, floor) if math.isfinite(noise) else floor,
        leader=_smoothed_error(weights, dt, noise),
        batch=collate(_with_vehicles_ahead(sequences[b], i) for b, i in which),
    )


def longest_step(system: System, rows: Tensor, longest: float) -> float:
    """The longest step with which a model is simulated, s.

    It is at most the shortest time constant of the states of terms, :data:`MAPPED` for maps from
    step to step, and :data:`ENDS` for zones and periods.

    Args:
        rows: ``(R, P)`` parameters, as of a
            :class:`~nnode.calibrate.parameters.ParameterVector`.
        longest: of all models, s.
    """
    factors = {
        f"terms.{i}.{name}": factor
        for i, term in enumerate(system.terms)
        for name, factor in cast(Term, term).fast.items()
    }
    steps = [longest]
    steps += [
        factors[name] * float(rows[:, j].min())
        for j, name in enumerate(ParameterVector(system).names)
        if name in factors
    ]
    if system.is_map:
        steps.append(MAPPED)
    if any(effect.consecutive for effect in effects_of(system)):
        steps.append(ENDS)
    return min(steps)


def _smoothed_error(weights: list[float], dt: float, noise: float) -> tuple[float, float]:
    """The error of smoothed paths, as an Ornstein-Uhlenbeck process.

    The smoother keeps the errors of low frequencies and removes those above
    omega = weight^(-1/6) / dt. The process has the same spectral density at frequency 0 and half of
    it at omega, to which followers hardly respond. If paths are hardly smoothed, their errors are
    white: the shortest time is half a sampling interval, at which the variance is that of errors.

    Args:
        weights: of smoothness, of each sequence. noise: of measurement, m.

    Returns:
        Its standard deviation, m, and its correlation time, s.
    """
    time = dt * max(float(np.median(weights)) ** (1 / 6), 0.5)
    variance = noise**2 * dt / (2 * time) if noise > WHITE else 0.0
    return math.sqrt(variance), time


def _with_vehicles_ahead(s: Sequence, place: int) -> Sequence:
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
    """``(H, 4, F)`` as in :class:`Paths`, at ``times`` times that are ``apart`` s apart; constant
    after the last sample."""
    ahead_paths = np.empty((times, 4, len(sequence)))
    for b, paths in enumerate(smoothed):
        time = dt * np.arange(len(paths))
        at = np.minimum(apart * np.arange(times), time[-1])
        spline = CubicSpline(time, paths)
        x, v = spline(at), spline(at, 1)
        for f in np.flatnonzero(sequence == b):
            next_place = place[f] + 1
            after_next = min(next_place + 1, paths.shape[1] - 1)
            offset = SAFE if after_next == next_place else 0.0
            ahead_paths[:, :, f] = np.stack(
                [x[:, next_place], v[:, next_place], x[:, after_next] + offset, v[:, after_next]], 1
            )
    return ahead_paths


def _ahead_symbols(ahead: np.ndarray) -> dict[str, np.ndarray]:
    """The formulas' names of the states ``(4, ..., F)`` of the vehicles ahead."""
    return {name: ahead[column] for name, column in AHEAD.items()}


def follower_formula(system: System) -> LaneDynamics | None:
    """The formula of a model that only reads the positions and speeds of the vehicles ahead; None
    for other models."""
    lane = formula_of(system)
    if lane is None or any(name not in ("x", "v") for name, _ in lane.ahead):
        return None
    return lane


def drivers_differ(system: System, sequences: Iterable[Sequence]) -> bool:
    """Whether differences between drivers can be estimated by default: if the model is a formula
    of the positions and speeds of a driver and of the vehicles ahead, and the errors of smoothed
    leaders are not above :data:`LEADER_ERROR`."""
    if follower_formula(system) is None:
        return False
    return leader_error(list(sequences)) <= LEADER_ERROR


def leader_error(sequences: list[Sequence]) -> float:
    """The standard deviation of the errors of smoothed speeds, relative to that of smoothed speeds
    over time: medians over the sequences. 0 if positions have no white errors, NaN if errors are
    unknown, because no sequence has five samples."""
    noise = measured_noise(sequences).position
    if not noise > WHITE:
        return 0.0 * noise
    errors, variations = list[float](), list[float]()
    for s in (s for s in sequences if s.n_samples > 1):
        smoothed, weight = whittaker(s.x[..., 0])
        error, time = _smoothed_error([weight], s.dt, noise)
        # with x = omega time, speeds have the variance 2 error²/(pi time²) times the integral of
        # x²/(1 + x^6)², which is pi/12
        errors.append(error / time / math.sqrt(6))
        variations.append(float(np.gradient(smoothed, s.dt, axis=0).std(0).mean()))
    return float(np.median(errors) / np.median(variations))


def without_errors(sequences: Iterable[Sequence]) -> bool:
    """Whether positions have no white measurement errors: they were simulated or smoothed."""
    return measured_noise(sequences).position < WHITE


def _n_disturbed(lane: LaneDynamics) -> int:
    """The number of states through which disturbances act, also at the start."""
    number = len(lane.rates)
    return number if number <= lane.order + STATES else lane.order


@cache
def _jacobian(lane: LaneDynamics) -> tuple[list[tuple[int, int]], Formulas]:
    """Derivatives of the rates of the disturbed states: their places in a matrix with a row per
    rate, whose columns are by these states, by the position and by the speed of the vehicle ahead;
    and a function that computes them."""
    number = _n_disturbed(lane)
    states = list(lane.rates)[:number]
    column = {name: k for k, name in enumerate(states)}
    column |= {name: number + k for name, k in AHEAD.items() if k < 2}
    slopes = [
        ((row, column[name]), slope)
        for row, state in enumerate(states)
        for name, slope in derivatives(lane.rates[state], list(column)).items()
    ]
    return [place for place, _ in slopes], Formulas([slope for _, slope in slopes])


class Followers:
    """A model of a lane, as a response to parameters and to deviations of drivers and starts.

    Parameters that are positive are varied in logarithms.

    Args:
        system: the model; only its parameters that need a gradient are varied.
        paths: the followers.

    Attributes:
        names: P names of the parameters.
        law: ``(P,)`` True for those of the law; logs: for those that are varied in logarithms.
        starts: number H of states whose start is estimated.
        random: ``(Q,)`` numbers of those that differ between drivers; none at first.

    Raises:
        ConfigError: a model that is no formula, or that reads states of other vehicles.
    """

    def __init__(self, system: System, paths: Paths) -> None:
        self.system, self.paths = system, paths
        terms, lane = cast(list[Term], list(system.terms)), follower_formula(system)
        if lane is None:
            raise ConfigError(
                "drivers who differ need a model of a lane whose law and effects are formulas of "
                "the positions and speeds of the vehicles ahead; take drivers=none"
            )
        self.lane, self.starts = lane, _n_disturbed(lane)
        self._doublings = DOUBLINGS if self.starts > lane.order else 0
        self.vector = ParameterVector(system)
        symbols = {(name, place): symbol for symbol, (name, place, _) in lane.owned.items()}
        self._symbols = [symbols[place] for place in self.vector.places]
        self.names = [symbol.replace("__", ".", 1) for symbol in self._symbols]
        low, high = self.vector.bounds
        row = self.vector.row.numpy()
        law_prefix = f"{terms[0].name}."
        self.law = np.array([name.startswith(law_prefix) for name in self.names], dtype=bool)
        # a positive quantity of a law without a bound has a sign
        self.logs = ((low >= 0) | (self.law & np.isinf(low))) & (row > 0)
        self.random = np.zeros(0, dtype=int)
        self.start = self.at(row)
        smallest = 1e-3 * np.abs(row)
        self.low, self.high = self.at(np.maximum(low, smallest * self.logs)), self.at(high)
        inputs = inputs_of(terms, lane, system.scene(paths.batch))
        self._fixed: dict[str, Any] = {n: v[:, 0].double().numpy() for n, v in inputs.items()}
        self._fixed |= {
            "start": paths.batch.start.numpy(),
            "dt": 2 * paths.half,
            "second": paths.second,
            "v": paths.start[1],
        }
        self._fixed |= {s: float(v.detach()) for s, v in parameter_values(terms, lane).items()}
        self._rates = Formulas(list(lane.rates.values()))

    @property
    def may_differ(self) -> list[str]:
        """Names of the law's parameters that are varied in logarithms."""
        flags = zip(self.names, self.logs & self.law, strict=True)
        return [name for name, differs in flags if differs]

    def with_random(self, names: Iterable[str]) -> Followers:
        """The same model, in which other parameters, such as ``idm.T``, differ between drivers."""
        model = copy.copy(self)
        model.random = np.array([self.names.index(name) for name in names], dtype=int)
        return model

    def with_paths(self, paths: Paths) -> Followers:
        """The same model with other paths of the same followers."""
        model = copy.copy(self)
        model.paths = paths
        return model

    def at(self, row: np.ndarray) -> np.ndarray:
        """Parameters in the scales in which they are varied."""
        return np.where(self.logs, np.log(np.where(self.logs, np.maximum(row, 1e-12), 1.0)), row)

    def natural(self, theta: np.ndarray) -> np.ndarray:
        """Parameters in SI units, from those in the scales in which they are varied."""
        return np.where(self.logs, np.exp(np.where(self.logs, theta, 0.0)), theta)

    def simulate(
        self, theta: np.ndarray, start: np.ndarray, pushed: Push | np.ndarray | None = None
    ) -> np.ndarray:
        """``(K, M, R, F)`` states of R runs.

        Args:
            theta: ``(R, P, F)`` parameters.
            start: ``(R, H, F)`` deviations of the first H states at the start, from what was
                measured and from the initial states of terms.
            pushed: the push on the highest rate: at the times of the paths ahead, ``(H, F)``, or a
                function, with which the simulation takes about ten times as long.
        """
        paths, order = self.paths, self.lane.order
        constants, starts = self._constants(theta), start.transpose(1, 0, 2)
        motion = paths.start[:order, None] + starts[:order]
        added = np.zeros((len(self.lane.rates) - order, *motion.shape[1:]))
        added[: len(starts) - order] = starts[order:]
        longest = 2 * paths.half + 1e-9
        if pushed is None or isinstance(pushed, np.ndarray):
            return simulate_compiled(
                self.lane,
                constants,
                paths.ahead,
                motion,
                added,
                pushed,
                paths.dt,
                paths.x.shape[1],
                longest,
            )

        def rate(t: float, y: np.ndarray) -> np.ndarray:
            at = round(t / paths.half)
            values = {**constants, **dict(zip(self.lane.rates, y, strict=True)), "t": t}
            rate_values = np.empty_like(y)
            rates = self._rates({**values, **_ahead_symbols(paths.ahead[at])})
            for target, part in zip(rate_values, rates, strict=True):
                target[...] = part
            rate_values[order - 1] += pushed(at, y, rate_values)
            return rate_values

        values = {**constants, "x": motion[0], "t": 0.0, **_ahead_symbols(paths.ahead[0])}
        if order == 2:
            values["v"] = motion[1]
        for state, formula in zip(added, Formulas(self.lane.starts.values())(values), strict=True):
            state += formula
        initial = np.concatenate([motion, added])
        with np.errstate(all="ignore"):
            return simulated(rate, initial, paths.dt, paths.x.shape[1], longest)

    def _constants(self, theta: np.ndarray) -> dict[str, Any]:
        """The constants of runs with parameters ``(R, P, F)``."""
        natural = self.natural(theta.transpose(0, 2, 1)).transpose(2, 0, 1)
        return {**self._fixed, **dict(zip(self._symbols, natural, strict=True))}

    def spread(self, theta: np.ndarray, agents: np.ndarray) -> np.ndarray:
        """``(P, F)`` parameters of each follower."""
        parameters = np.repeat(theta[:, None], len(self.paths.agent), 1)
        if agents.size:
            parameters[self.random] += agents[self.paths.agent].T
        return parameters

    @np.errstate(over="ignore", invalid="ignore")  # of simulations that diverge
    def columns(
        self, theta: np.ndarray, agents: np.ndarray, start: np.ndarray, n_starts: int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the positions, by forward differences.

        Args:
            theta, agents, start: see :class:`~nnode.population.estimate.Response`.
            n_starts: number of states whose start is varied.

        Returns:
            ``(F, K, P + n_starts)`` by parameters and starts, and the states ``(K, M, F)``.
        """
        parameters, n_parameters = self.spread(theta, agents), len(theta)
        initial = start.T if start.size else np.zeros((self.starts, len(self.paths.agent)))
        runs = np.repeat(parameters[None], 1 + n_parameters + n_starts, 0)
        initials = np.repeat(initial[None], len(runs), 0)
        for p in range(n_parameters):
            runs[1 + p, p] += DIFFERENCE
        for h in range(n_starts):
            initials[1 + n_parameters + h, h] += START_DIFFERENCE
        states = self.simulate(runs, initials)
        x = states[:, 0].transpose(1, 2, 0)  # (R, F, K)
        step = np.repeat([DIFFERENCE, START_DIFFERENCE], [n_parameters, n_starts])
        columns = (x[1:] - x[0]) / step[:, None, None]
        return columns.transpose(1, 2, 0), states[:, :, 0]

    def __call__(self, theta: np.ndarray, agents: np.ndarray, start: np.ndarray) -> Linearised:
        paths, n_parameters = self.paths, len(theta)
        columns, states = self.columns(theta, agents, start, self.starts)
        fixed, by_start = columns[..., :n_parameters], columns[..., n_parameters:]
        residual = paths.x - states[:, 0].T
        if agents.size:
            by_deviation = fixed[..., self.random]
            residual = residual + np.einsum("fkq,fq->fk", by_deviation, agents[paths.agent])
        if start.size:
            residual = residual + np.einsum("fkh,fh->fk", by_start, start)
        step, _, forced = self.linear(self.spread(theta, agents), states)
        return Linearised(
            residual=residual,
            fixed=fixed,
            random=self.random,
            start=by_start,
            observed=paths.observed,
            agent=paths.agent,
            step=step,
            forced=forced,
            leader=paths.leader,
            dt=paths.dt,
        )

    def rates(self, parameters: np.ndarray, states: np.ndarray) -> np.ndarray:
        """``(M, K, F)`` rates along a run.

        Args:
            parameters: ``(P, F)`` parameters of each follower. states: ``(K, M, F)`` of the run.
        """
        with np.errstate(all="ignore"):
            rates = self._rates(self._symbols_along(parameters, states))
        return np.stack([np.broadcast_to(rate, states[:, 0].shape) for rate in rates])

    def _symbols_along(self, parameters: np.ndarray, states: np.ndarray) -> dict[str, Any]:
        """The formulas' symbols along a run."""
        times = self.paths.dt * np.arange(len(states))
        return {
            **self._constants(parameters[None]),
            **dict(zip(self.lane.rates, states.transpose(1, 0, 2), strict=True)),
            "t": times[:, None],
            **_ahead_symbols(self.paths.ahead_at_samples.swapaxes(0, 1)),
        }

    def linear(
        self, parameters: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The linear response along a run by the trapezoidal rule, of the M states of motion and
        of memory.

        With the derivatives A of the rates by the states, and a and b by position and speed of the
        vehicle ahead, whose path has the error e, y' = A y + a e + b e'. Therefore z = y - b e has
        z' = A z + (a + A b) e; the difference b e is neglected. So are errors of the second vehicle
        ahead.

        Args:
            parameters, states: as of :meth:`rates`.

        Returns:
            Three arrays. ``(F, K - 1, M, M)``: the states after a sampling interval by those
            before, and by the sums of the changes of their rates at both ends;
            ``(F, K - 1, M, 2)``: by the sums at both ends of pushes on the highest rate and of e.
        """
        by_states, by_position, by_speed = self._slopes(parameters, states)
        matrices = (
            subdivided(by_states, self.paths.dt, self._doublings)
            if self._doublings
            else trapezoidal(by_states, self.paths.dt)
        )
        step, after = (matrix.numpy().swapaxes(0, 1) for matrix in matrices)
        after = self.paths.dt / 2 * after
        source = (by_position + by_states @ by_speed).swapaxes(0, 1)
        by_push = after[..., self.lane.order - 1, None]
        by_error = after @ (source[:, 1:] + source[:, :-1]) / 2
        forced = np.concatenate([by_push, by_error], -1)
        return np.ascontiguousarray(step), np.ascontiguousarray(after), forced

    def _slopes(
        self, parameters: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of the rates along a run: ``(K, F, M, M)`` by the states, ``(K, F, M, 1)`` by
        position and by speed of the vehicle ahead.

        Args:
            parameters, states: as of :meth:`rates`.
        """
        entries, slopes = _jacobian(self.lane)
        shape, disturbed = (len(states), len(self.paths.agent)), _n_disturbed(self.lane)
        matrix = np.zeros((*shape, disturbed, disturbed + 2))
        with np.errstate(all="ignore"):
            values = slopes(self._symbols_along(parameters, states))
        for (row, column), value in zip(entries, values, strict=True):
            matrix[..., row, column] += value
        # the linearisation is only valid while it does not diverge
        largest = 2**self._doublings / self.paths.dt
        matrix = np.clip(np.nan_to_num(matrix), -largest, largest)
        by_states, by_position, by_speed = np.split(matrix, [disturbed, disturbed + 1], -1)
        return by_states, by_position, by_speed

    def bounds_reached(self, theta: np.ndarray) -> np.ndarray:
        """``(P,)`` the bounds at which parameters ``(P,)`` are, see
        :func:`nnode.calibrate.intervals.at_bounds`."""
        return at_bounds(theta, self.low, self.high, NEAR)

    def simulated_paths(self, estimate: Estimate, draw: Draw) -> Paths:
        """Simulated measurements of the estimated model (parametric bootstrap).

        Starts move with the drawn drivers, see :meth:`_longer_distance`.

        Args:
            estimate: of this model.
            draw: of deviations of drivers, pushes and errors.

        Raises:
            SimulationError: a drawn driver passes the vehicle ahead, or his path blows up.
        """
        paths, (push, push_time, error, *lasting) = self.paths, estimate.variances.noise
        agents = draw(estimate.agents.shape)
        # drawn drivers differ exactly as estimated, which reduces the Monte Carlo error
        agents *= estimate.variances.spread / np.sqrt((agents**2).mean(0))
        shape = len(paths.ahead), len(paths.agent)
        pushes = push * _ornstein_uhlenbeck(draw(shape), paths.half / push_time)

        def errors(shape: tuple[int, ...]) -> np.ndarray:
            drawn = error * draw(shape)
            if lasting:
                deviation, time = lasting
                drawn += deviation * _ornstein_uhlenbeck(draw(shape).T, paths.dt / time).T
            return drawn

        parameters = self.spread(estimate.theta, agents)
        start = estimate.start.copy()
        start[:, 0] -= self._longer_distance(estimate, agents - estimate.agents)
        x = self.simulate(parameters[None], start.T[None], pushes)[:, 0, 0].T
        behind = x[paths.observed] < paths.ahead_at_samples[:, 0].T[paths.observed]
        if not behind.all():  # of a path that blows up, this is False
            raise SimulationError("followers with drawn parameters pass the vehicle ahead")
        return paths.remeasured(x, errors)

    def _longer_distance(self, estimate: Estimate, change: np.ndarray) -> np.ndarray:
        """``(F,)`` by how much the first distance to the vehicle ahead (m) is longer, if drivers'
        deviations differ by ``change`` ``(D, Q)`` from the estimated ones.

        A driver who keeps a longer gap has kept it before the record. Simulated drivers whose
        starts did not depend on them would first approach their own gaps, and this motion would
        change the bias of the parameters. The dependence is a linear regression of the logarithm of
        the distance on deviations and, in laws of second order, the speed.
        """
        paths, order = self.paths, self.lane.order
        start = paths.start[:order].T + estimate.start[:, :order]
        distance = np.maximum(paths.ahead_at_samples[0, 0] - start[:, 0], LEAST_GAP)
        regressors = [np.ones(len(start)), *start[:, 1:].T, *estimate.agents[paths.agent].T]
        coefficients = np.linalg.lstsq(np.column_stack(regressors), np.log(distance))[0]
        longer: np.ndarray = distance * np.expm1(change[paths.agent] @ coefficients[order:])
        return longer


def _ornstein_uhlenbeck(normal: np.ndarray, step: float) -> np.ndarray:
    """A process of standard deviation 1 at times that are ``step`` correlation times apart, along
    the first axis.

    Args:
        normal: independent standard normal numbers.
    """
    keep, process = math.exp(-step), normal.copy()
    for k in range(1, len(normal)):
        process[k] = keep * process[k - 1] + math.sqrt(1 - keep**2) * normal[k]
    return process


#: Antithetic pairs of simulated data: the model with these data, and the deviations of drivers.
Simulated = list[list[tuple[Followers, Estimate]]]


def score_biases(simulated: Simulated) -> np.ndarray:
    """``(pairs, P)`` biases of the parameters, in the scales in which they are varied; their mean
    is the best estimate.

    Simulated data are scored at the parameters that they were simulated with. The mean of a correct
    score is zero; the linearisation at the modes and the errors of smoothed leaders shift it. A
    bias is the Gauss-Newton step of the mean score of an antithetic pair of draws, in which the
    linear part of the score cancels. Parameters at bounds are fixed.
    """
    return np.array([np.mean([_step(*each) for each in pair], 0) for pair in simulated])


def _step(drawn: Followers, modes: Estimate) -> np.ndarray:
    """``(P,)`` the Gauss-Newton step of the parameters that are not at bounds."""
    products, free = modes.marginal.agents.sum(0)[1:], drawn.bounds_reached(modes.theta) == ""
    step = np.zeros(len(free))
    step[free] = flat_solve(products[free][:, 1:][:, free], products[free, 0])
    return step


def variance_biases(simulated: Simulated) -> np.ndarray:
    """``(pairs, V)`` estimated standard deviations and times relative to the simulated ones, as in
    :attr:`nnode.population.estimate.Variances.row`. They are estimated from the data as linearised
    at the modes, with parameters within their bounds, and without changes of those at bounds, along
    which the linearised likelihood may rise without limit."""
    return np.array([np.mean([_ratios(*each) for each in pair], 0) for pair in simulated])


def _ratios(drawn: Followers, modes: Estimate) -> np.ndarray:
    fixed = drawn.bounds_reached(modes.theta) != ""
    estimated = fit_variances(
        modes.data,
        PushNoise(),
        modes.variances,
        low=np.where(fixed, 0.0, drawn.low - modes.theta),
        high=np.where(fixed, 0.0, drawn.high - modes.theta),
    )
    ratios: np.ndarray = estimated.row / modes.variances.row
    return ratios


def simulated_pairs(model: Followers, estimate: Estimate, seed: int, pairs: int) -> Simulated:
    """Antithetic pairs of simulated data of an estimated model: the model with these data, and the
    deviations of their drivers.

    A drawn driver can come so close to the vehicle ahead that the law throws him off the road. Such
    a driver alone would determine the scores, so the pair is replaced by the next one. The same is
    done if the search for deviations does not converge.

    Args:
        seed: of the first pair; the others have the following ones. pairs: their number.

    Raises:
        SimulationError: fewer than one in :data:`ATTEMPTS` pairs can be used.
    """
    simulated: Simulated = []
    for attempt in range(ATTEMPTS * pairs):
        with suppress(SimulationError, np.linalg.LinAlgError):
            draws = antithetic_draws(seed + attempt)
            simulated.append([_simulated_data(model, estimate, draw) for draw in draws])
        if len(simulated) == pairs:
            return simulated
    raise SimulationError("most simulations of the estimated model have drivers who leave the road")


def _simulated_data(model: Followers, estimate: Estimate, draw: Draw) -> tuple[Followers, Estimate]:
    """One of the data sets of :func:`simulated_pairs`.

    Raises:
        SimulationError: it cannot be used.
    """
    drawn = model.with_paths(model.simulated_paths(estimate, draw))
    modes = fit_deviations(drawn, PushNoise(), estimate.theta, estimate.variances)
    if not modes.converged:
        raise SimulationError("the search for the deviations of drawn drivers does not converge")
    return drawn, modes


def antithetic_draws(seed: int) -> list[Draw]:
    """An antithetic pair of draws: they have opposite signs, so that linear terms cancel."""
    return [partial(_signed, np.random.default_rng(seed), sign) for sign in (1.0, -1.0)]


def _signed(rng: np.random.Generator, sign: float, shape: tuple[int, ...]) -> np.ndarray:
    return sign * rng.standard_normal(shape)
