"""People who differ: their desired velocities, and the variances between them and over time.

In each of a person's windows, the person is simulated alone among the measured and smoothed paths
of the others. The desired speed and the relaxation time are those of the typical person times
log-normal factors of the person. If only the direction of the stream is given, that of the person
is turned by a normal angle. With X the derivatives by the logarithm of the typical desired speed,
the measured positions y are

    y = f(theta, b) + X d + Z (b* - b) + e,    b* ~ N(0, Omega),

where b are the deviations with which people are simulated, and e has the covariance of
autocorrelated pushes, of measurement errors, and of the error of the smoothed state in which a
record starts. The windows of a person continue each other, see
:mod:`nnode.diagnosis.crowds.continuation`.

Source: the statistical model is that of :mod:`nnode.population`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.diagnosis.crowds.continuation import Change, Continuation, not_grown
from nnode.diagnosis.crowds.windows import Individuals, Windows
from nnode.diagnosis.eligibility import check_model
from nnode.model.effects.base import Effect
from nnode.model.expression import symbols
from nnode.model.system import Crowd, System
from nnode.population.drivers import (
    EXPLAINED,
    LASTING,
    LEAST_SPREAD,
    LONG,
    LONGEST,
    MOST_SPREAD,
    PUSH,
    ROUGH,
    SHORT,
    SPREAD,
    START_POSITION,
    TOLERANCE,
)
from nnode.population.estimate import Variances, fit_variances
from nnode.population.intervals import variance_intervals, variation_rows
from nnode.population.likelihood import (
    Linearised,
    Marginal,
    RestartNoise,
    Whitening,
    marginal,
)
from nnode.simulation.alone import PersonAlone, RunAlone, Surroundings
from nnode.simulation.linear import trapezoidal

#: Smallest standard deviation of errors of positions, m. Simulators integrate differently.
ERROR = 1e-3
#: Standard deviations of the positions, m, and speeds, m/s, in which records start, relative to the
#: smoothed ones. They are wider than sway and the errors of smoothed states, which are made of the
#: positions that are to be explained.
START = (0.1, 1.0)
#: Largest difference between simulated and measured positions, m. Differences are clipped because
#: contact forces may throw a person far away.
LIMIT = 3.0
#: Windows whose sum of squares Q is above this multiple q of the median m have less weight: the
#: loss is q m (1 + log(Q / (q m))).
OUTLYING = 2.0
#: Windows do not continue those with a smaller weight.
ORDINARY = 0.5
#: Windows are left out if a change of a start grows by more than this factor: people who touch
#: make paths chaotic.
GROWTH = 4.0
#: Smallest and largest number of linearisations in which people, variances and weights are
#: estimated, and the change (root mean square) of people's deviations at which they end, as a share
#: of their standard deviations.
ROUNDS, MOST_ROUNDS, CLOSE = 3, 8, 0.05
#: Number of pairs of people in the largest intermediate result.
CHUNK = 100_000
#: Difference of the logarithm of desired speeds, and of directions (rad), for derivatives.
DIFFERENCE = 1e-3
#: Smallest desired speed, m/s, and smallest value of a parameter that differs between people.
SLOWEST, TINY = 0.05, 1e-12
#: Names of the desired speed and of its direction among the quantities in which people differ.
DESIRED_SPEED, DESIRED_DIRECTION = "desired_speed", "desired_direction"


class Gait(NamedTuple):
    """How people walk, whatever the law.

    Attributes:
        sway: ``(4,)`` the last parameters of :class:`~nnode.population.likelihood.RestartNoise`;
            empty: people do not sway.
        acceleration: standard deviation of their other accelerations along a coordinate, m/s².
        window_loglik: ``(P,)`` log likelihoods of the windows by themselves, if people walk
            straight on and are pushed.
        loglik: of the records.
    """

    sway: np.ndarray
    acceleration: float
    window_loglik: np.ndarray
    loglik: float


@dataclass(frozen=True, kw_only=True)
class CrowdPopulation:
    """People who differ, as estimated with a model.

    Attributes:
        system: the model.
        random: names of the Q quantities in which people differ.
        variances: the noise is that of :class:`~nnode.population.likelihood.RestartNoise`.
        own: ``(D, Q)`` deviations b with which people are simulated.
        people: the D simulated people.
        typical: logarithm of the typical desired speed.
        data: the measured paths of D people, linearised.
        continuation: of their windows.
        by_deviation: ``(D, K, Q)`` the columns Z of windows that do not continue those before, m.
        posterior: the marginal likelihood, and the deviations from the simulated people.
        gait: how people walk, whatever the law.
        left_out: ``(D,)`` log likelihoods of the windows that are left out, see :class:`Gait`.
    """

    system: System
    random: list[str]
    variances: Variances
    own: np.ndarray
    people: Individuals
    typical: float
    data: Linearised
    continuation: Continuation
    by_deviation: np.ndarray
    posterior: Marginal
    gait: Gait
    left_out: np.ndarray

    @property
    def has_speed(self) -> int:
        """1 if people differ in their desired speeds, else 0."""
        return int(DESIRED_SPEED in self.random)

    @property
    def explains_rates(self) -> bool:
        """Whether pushes are small compared to accelerations, see
        :data:`~nnode.population.drivers.EXPLAINED`. Otherwise they stand for a deviation of the
        law."""
        return float(self.variances.noise[0]) <= EXPLAINED * self.gait.acceleration

    @property
    def plausible(self) -> bool:
        """See :attr:`explains_rates`. Records are often too short to show how long pushes last."""
        return self.explains_rates

    @property
    def price(self) -> float:
        """Half the number of parameters times the logarithm of the number of people (BIC)."""
        free = int(np.count_nonzero(self.variances.low < self.variances.high))
        number = len(ParameterVector(self.system).row) + free
        return number * math.log(max(len(self.own), 2)) / 2

    @property
    def criterion(self) -> float:
        """Log marginal likelihood minus :attr:`price`; the larger the better."""
        return float(self.each.sum()) - self.price

    @property
    def predicts(self) -> bool:
        """Whether the paths are likelier than if people walk straight on and are pushed."""
        return self.criterion > self.gait.loglik

    @property
    def each(self) -> np.ndarray:
        """``(D,)`` terms of the log marginal likelihood, with the loss of outlying windows. Where
        windows are left out, people walk straight on and are pushed."""
        terms: np.ndarray = self.posterior.each - lost(self.data)
        return terms + self.left_out

    def by_own(self, by_deviation: np.ndarray) -> np.ndarray:
        """``(D, K)`` m: the change of positions by the deviations with which people were simulated,
        with the columns Z ``(D, K, Q)``."""
        return displaced(by_deviation, self.own)


def lost(data: Linearised) -> np.ndarray:
    """``(D,)`` terms of the log likelihood that outlying windows lose by their weights, see
    :data:`OUTLYING`."""
    assert data.weight is not None
    terms = -OUTLYING / 2 * np.log(np.maximum(data.weight, 1e-12))
    total: np.ndarray = np.where(data.observed, terms, 0.0).sum(1)
    return total


def displaced(by_deviation: np.ndarray, own: np.ndarray) -> np.ndarray:
    """``(D, K)`` m: changes of positions by deviations ``(D, Q)``, with the columns Z ``(D, K, Q)``
    of people."""
    change: np.ndarray = (by_deviation * own[:, None]).sum(-1)
    return change


class LinearisedWindows(NamedTuple):
    """The P windows of single people, linearised by themselves.

    Attributes:
        difference: of one column, measured minus simulated.
        by_deviation: of the Q columns Z. by_start: of four, the state at the start.
        used: ``(P,)`` False where windows are left out, see :data:`GROWTH`.
        step, forced: ``(P, L, 4, 4)`` and ``(P, L, 4, 2)``, see
            :class:`~nnode.population.likelihood.Linearised`.
    """

    difference: Change
    by_deviation: Change
    by_start: Change
    used: np.ndarray
    step: np.ndarray
    forced: np.ndarray


def differing(system: System) -> list[str]:
    """Names of the quantities in which people differ: the desired speed if the model contains it,
    its direction if that of the stream is given, and positive parameters of the law that are in no
    sum over others or walls."""
    assert isinstance(system, Crowd)
    law = system.law_formula
    if law is None:
        return []
    in_sums = symbols([x for summands in law.sums.values() for x in summands.values()])
    calibrated, limits = ParameterVector(system).parameters, system.bounds()
    names = [
        name
        for symbol, (name, _, axes) in law.owned.items()
        if axes is None
        and name in calibrated
        and name in limits
        and limits[name].low >= 0
        and symbol in symbols(law.rate)
        and symbol not in in_sums
    ]
    if system.desired == "last" or "pace" not in law.symbols:
        return names
    directions = [DESIRED_DIRECTION] if system.desired == "direction" else []
    return [DESIRED_SPEED, *directions, *names]


def parameters_differ(system: System) -> bool:
    """Whether people differ in parameters of the law besides their desired speeds."""
    return system.domain == "crowd" and bool(
        set(differing(system)) - {DESIRED_SPEED, DESIRED_DIRECTION}
    )


class People:
    """The people of windows, simulated and linearised.

    Args:
        windows: their windows.

    Attributes:
        unit: ``(P,)`` number of the person of each of the P windows of single people.
        pairs: of each person the sequence and the place in it.
        measured: the people at first, with preferred speeds as measured, to the destinations.
        heading: ``(D, T, 2)`` unit vectors from the start to the end of each window, at all T times
            of a person.
        gait: at first without sway.
    """

    def __init__(self, windows: Windows) -> None:
        self.windows = windows
        window, place = windows.person.T
        pairs, first, unit = np.unique(
            np.stack([windows.sequence[window], place], 1),
            axis=0,
            return_index=True,
            return_inverse=True,
        )
        self.unit = unit.reshape(-1)
        self.pairs = [(int(b), int(i)) for b, i in pairs]
        # windows as places (person, number of the window), in the order of time
        self._place = self.unit, windows.number[window]
        self._number = int(windows.number.max()) + 1
        preferred = windows.batch.preferred
        assert preferred is not None
        speed = np.hypot(*preferred[window, place].numpy()[first].T)
        self.measured = Individuals(np.maximum(speed, SLOWEST), np.zeros(len(speed)), {})
        x = windows.batch.x[:, window, place].numpy()
        way = (x[-1] - x[0]) / np.maximum(np.hypot(*(x[-1] - x[0]).T), 1e-9)[:, None]
        self.heading = self.joined(np.repeat(way[:, None], windows.length, 1))
        self._last: tuple[Individuals, Surroundings] | None = None
        self.gait = Gait(np.zeros(0), math.inf, np.zeros(len(self.unit)), -math.inf)

    @property
    def noise(self) -> RestartNoise:
        """The covariance of residuals."""
        return RestartNoise(max(START[0], START_POSITION * self.error), START[1])

    @property
    def error(self) -> float:
        """Standard deviation of the errors of positions, m."""
        return max(math.sqrt(self.windows.variance), ERROR)

    @property
    def _duration(self) -> float:
        """Of the longest record, s."""
        return self.windows.interval * self.windows.length * self._number

    def initial_variances(self, random: list[str]) -> Variances:
        """Standard deviations and times where a search starts, and their bounds.

        Args:
            random: what differs.
        """
        windows, number, sway = self.windows, len(random), self.gait.sway
        dt = windows.interval
        low_push, high_push, push = PUSH[2]
        short, long = SHORT * dt, self._duration
        noise = np.array([push, np.clip(LASTING, short, long), self.error])
        low, high = [low_push, short, self.error], [high_push, long, self.error]
        return Variances(
            noise=np.concatenate([noise, sway]),
            spread=np.full(number, SPREAD),
            start=np.zeros(0),
            low=np.array([*low, *sway, *[LEAST_SPREAD] * number]),
            high=np.array([*high, *sway, *[MOST_SPREAD] * number]),
        )

    def estimated(
        self,
        system: System,
        start: CrowdPopulation | None = None,
        variances: Variances | None = None,
    ) -> CrowdPopulation:
        """Deviations of people, variances and weights of windows, with the parameters of a model.

        Args:
            start: where the search starts, if the same quantities differ.
            variances: of people and of noise, if they are not estimated.
        """
        random, weight = differing(system), np.ones(len(self.unit))
        speeds = np.log(self.measured.speed)
        own, typical = np.zeros((len(speeds), len(random))), float(speeds.mean())
        if DESIRED_SPEED in random:
            own[:, 0] = speeds - typical
        present = self.initial_variances(random) if variances is None else variances
        anew = start is None or start.random != random
        if start is not None and not anew:
            own, typical = start.own, start.typical
            assert start.data.weight is not None
            weight = self.parted(start.data.weight)[:, 0]
            present = start.variances if variances is None else variances
        share, last = np.ones((len(own), 1)), np.zeros_like(own)
        for round_ in range(MOST_ROUNDS):
            people = self.individuals(random, own, typical)
            windows = self._linearised(system, random, people)
            if round_ > 0:
                # weights of the linearisation before would count windows fully that it left out
                data, _ = self._continued(windows, own, weight)
                weight = self._weights(data, self.posterior(data, random, present), present)
            data, continuation = self._continued(windows, own, weight)
            if variances is None:
                tolerance = ROUGH if round_ < ROUNDS - 1 else TOLERANCE
                several = anew and round_ == 0
                present = self._fitted(data, random, present, several, tolerance)
            posterior = self.posterior(data, random, present)
            step = posterior.deviations - own
            square = ((step**2).mean(0) + posterior.change**2) / present.spread**2
            change = math.sqrt(square.max(initial=0.0))
            if round_ >= ROUNDS - 1 and (change < CLOSE or round_ == MOST_ROUNDS - 1):
                break
            reversed_step = (step * last / present.spread**2).sum(1, keepdims=True) < 0
            share, last = np.where(reversed_step, share / 2, share), step
            if DESIRED_SPEED in random:
                typical += float(posterior.change[0])
            own = np.clip(own + share * step, *_admissible(system, random, typical))
        left_out = np.where(windows.used, 0.0, self.gait.window_loglik)
        return CrowdPopulation(
            system=system,
            random=random,
            variances=present,
            own=own,
            people=people,
            typical=typical,
            data=data,
            continuation=continuation,
            by_deviation=self.joined(windows.by_deviation.position),
            posterior=posterior,
            gait=self.gait,
            left_out=np.bincount(self.unit, left_out),
        )

    def _fitted(
        self,
        data: Linearised,
        random: list[str],
        start: Variances,
        several: bool,
        tolerance: float,
    ) -> Variances:
        """The most likely variances; with ``several`` from several correlation times of pushes:
        the likelihood has maxima at short and at long ones."""
        limit, fits = _limit(random), list[tuple[float, Variances]]()
        short, long = start.low[1], start.high[1]
        for time in (start.noise[1], short, long) if several else start.noise[1:2]:
            noise = start.noise.copy()
            noise[1] = np.clip(time, 1.1 * short, long / 1.1)
            fit = fit_variances(
                data,
                self.noise,
                replace(start, noise=noise),
                tolerance=tolerance,
                low=-limit,
                high=limit,
            )
            fits.append((self.posterior(data, random, fit).loglik, fit))
        return max(fits, key=lambda each: each[0])[1]

    def individuals(self, random: list[str], own: np.ndarray, typical: float) -> Individuals:
        """People with deviations ``(D, Q)``; typical: logarithm of the typical desired speed."""
        people = self.measured
        for name, deviations in zip(random, own.T, strict=True):
            if name == DESIRED_SPEED:
                people = people._replace(speed=np.exp(typical + deviations))
            elif name == DESIRED_DIRECTION:
                people = people._replace(turn=deviations)
            else:
                people = people._replace(factors={**people.factors, name: np.exp(deviations)})
        return people

    def usual(self, system: System, start: CrowdPopulation | None = None) -> CrowdPopulation:
        """The estimate with the variances where searches start."""
        return self.estimated(system, start, self.initial_variances(differing(system)))

    def posterior(self, data: Linearised, random: list[str], variances: Variances) -> Marginal:
        """The most likely deviations of people."""
        products, limit = self.noise.products(data, variances.noise), _limit(random)
        return marginal(data, products, variances.spread, variances.start, low=-limit, high=limit)

    def variations(self, population: CrowdPopulation) -> dict[str, dict[str, Any]]:
        """Rows of a table, see :func:`nnode.population.intervals.variation_rows`.

        Pushes that last longer than a third of a record are not estimable: their time is biased,
        because they are hardly distinguished from differences between people."""
        limit, high = _limit(population.random), population.variances.high.copy()
        high[1] = LONG * self._duration
        variances = replace(population.variances, high=high)
        ends = variance_intervals(population.data, self.noise, variances, -limit, limit)
        names = [name.rpartition(".")[2] for name in population.random]
        shrinkage = population.posterior.shrinkage
        return variation_rows(variances, self.noise, names, ends, shrinkage, "m/s²")

    def whitening(self, data: Linearised, variances: Variances) -> Whitening:
        """The inverse square root of the covariance."""
        return Whitening(data, self.noise, variances.noise, variances.spread, variances.start)

    def _weights(self, data: Linearised, posterior: Marginal, variances: Variances) -> np.ndarray:
        """``(P,)`` weights of the windows, see :data:`OUTLYING`."""
        assert data.weight is not None
        residual = (data.residual - data.fixed @ posterior.change)[..., None]
        white = self.parted(self.whitening(data, variances)(residual))[..., 0]
        return outlying_weights((white**2).sum(1) / self.parted(data.weight)[:, 0])

    def _linearised(
        self,
        system: System,
        random: list[str],
        people: Individuals,
    ) -> LinearisedWindows:
        """The windows, linearised at the deviations of people."""
        windows, row = self.windows, ParameterVector(system).row[None]
        states = self.states(system, row, people)
        run = RunAlone(self.around(system, people), system, states[:, 0])
        stride, dt, times = windows.sub, windows.interval, windows.length
        by_start = run.by_start()
        # a free person's position changes by a unit with the first position, by the time with speed
        growth = np.abs(by_start[:, :, :2]) / np.repeat([1.0, dt * times], 2)
        step, after = trapezoidal(run.slopes[::stride], dt)
        fields = self._fields(system, run, random, people)
        return LinearisedWindows(
            difference=self.differences(states),
            by_deviation=self.change(run.displacements(fields)),
            by_start=self.change(by_start),
            used=growth.max((1, 2, 3)) < GROWTH,
            step=step.numpy().swapaxes(0, 1),
            forced=(dt / 2 * after[..., 2:]).numpy().swapaxes(0, 1),
        )

    def _continued(
        self, windows: LinearisedWindows, own: np.ndarray, weight: np.ndarray
    ) -> tuple[Linearised, Continuation]:
        """The measured paths of people who were simulated with deviations ``(D, Q)``, with weights
        ``(P,)`` of the windows, which also decide where windows continue those before."""
        ordinary = self.by_number(windows.used & (weight > ORDINARY))
        follows = np.pad(ordinary[:, :-1], ((0, 0), (1, 0)))
        end = self.by_number(windows.by_start.end)
        continuation = Continuation(
            position=self.by_number(windows.by_start.position),
            end=end,
            continues=not_grown(end, follows),
        )
        restart = np.zeros(self.heading.shape[:2], dtype=bool)
        restart[:, :: self.windows.length] = ~continuation.continues
        by_deviation = self.continued(windows.by_deviation, continuation)
        difference = self.continued(windows.difference, continuation)[..., 0]
        data = Linearised(
            residual=difference + displaced(by_deviation, own),
            fixed=by_deviation,
            random=np.arange(by_deviation.shape[-1]),
            start=np.zeros((*difference.shape, 0)),
            observed=self.at_samples(windows.used),
            agent=np.arange(len(self.pairs)),
            step=self.joined(windows.step)[:, :-1],
            forced=self.joined(windows.forced)[:, :-1],
            restart=restart,
            weight=self.at_samples(weight),
            heading=self.heading,
            dt=self.windows.interval,
        )
        return data, continuation

    def _fields(
        self, system: System, run: RunAlone, random: list[str], people: Individuals
    ) -> list[Tensor]:
        """Q accelerations ``(F, W, N, 2)`` per unit of the logarithm of what differs, or of the
        direction."""
        fields = list[Tensor]()
        differences = dict(zip(ParameterVector(system).names, differences_of(system), strict=True))
        for name in random:
            if name in (DESIRED_SPEED, DESIRED_DIRECTION):
                higher, lower = (
                    run.accelerations(self._changed(system, people, name, change))
                    for change in (DIFFERENCE, -DIFFERENCE)
                )
                fields.append((higher - lower) / (2 * DIFFERENCE))
            else:
                value = float(system.get_parameter(name).detach())
                fields.append(value * run.parameter(name, differences[name]))
        return fields

    def change(self, states: np.ndarray) -> Change:
        """Of changes ``(P, F, 4, C)`` of the states."""
        position = states[:, :: self.windows.sub, :2][:, : self.windows.length]
        coordinates = 2 * self.windows.length
        flat = position.reshape(len(states), coordinates, states.shape[-1])
        return Change(flat, states[:, -1])

    def continued(self, change: Change, continuation: Continuation) -> np.ndarray:
        """``(D, W K, C)`` changes of positions, with those of earlier windows."""
        return continuation(self.by_number(change.position), self.by_number(change.end))

    def at_samples(self, values: np.ndarray) -> np.ndarray:
        """``(D, W 2 L)``: values ``(P,)`` of windows at all of their samples."""
        return self.joined(np.repeat(values[:, None], 2 * self.windows.length, 1))

    def joined(self, values: np.ndarray) -> np.ndarray:
        """``(D, W K, ...)``: people's W windows one after the other, from ``(P, K, ...)``; 0 where
        a person has less."""
        joined = self.by_number(values)
        return joined.reshape(len(joined), self._number * values.shape[1], *values.shape[2:])

    def by_number(self, values: np.ndarray) -> np.ndarray:
        """``(D, W, ...)``: of people's W windows, from ``(P, ...)``; 0 where a person has less."""
        windows = np.zeros((len(self.pairs), self._number, *values.shape[1:]), values.dtype)
        windows[self._place] = values
        return windows

    def parted(self, joined: np.ndarray) -> np.ndarray:
        """``(P, 2 L, ...)`` from ``(D, W 2 L, ...)``, see :meth:`joined`."""
        shape = len(joined), self._number, 2 * self.windows.length
        values: np.ndarray = joined.reshape(*shape, *joined.shape[2:])[self._place]
        return values

    # -- simulation ------------------------------------------------------------------------

    def states(self, system: System, rows: Tensor, people: Individuals) -> Tensor:
        """``(F, R, W, N, 4)`` simulated positions (m) and velocities (m/s) at the steps.

        Args:
            rows: ``(R, K)`` parameters. people: the D people.
        """
        windows, around = self.windows, self.around(system, people)
        w, n = windows.batch.agent.shape
        first = torch.cat([windows.batch.x[0], windows.batch.v[0]], -1)
        states = []
        for part in rows.split(max(1, CHUNK // (w * n * n))):
            rhs = PersonAlone(around, system, ParameterVector(system).runs(part))
            states.append(rhs.simulated(first, windows.steps))
        return torch.cat(states, 1)

    def differences(self, states: Tensor) -> Change:
        """Measured minus simulated :meth:`states`, of R runs; where the next window starts the
        smoothed state is the measured one."""
        window, place = self.windows.person.T
        simulated = states[:, :, window, place]
        x = torch.from_numpy(self.windows.measured[:, window, place])[:, None]
        position = x - simulated[:: self.windows.sub][: len(x), ..., :2]
        batch = self.windows.batch
        end = torch.cat([batch.x[-1], batch.v[-1]], -1)[window, place] - simulated[-1]
        position, end = (part.nan_to_num(LIMIT).clamp(-LIMIT, LIMIT) for part in (position, end))
        coordinates = position.permute(2, 0, 3, 1).flatten(1, 2)
        return Change(coordinates.numpy(), end.permute(1, 2, 0).numpy())

    def around(self, system: System, people: Individuals) -> Surroundings:
        """The surroundings of the D people; the last ones are cached. All systems of one diagnosis
        share walls, radii and masses."""
        if self._last is None or self._last[0] is not people:
            self._last = people, self._surroundings(system, people)
        return self._last[1]

    def _surroundings(self, system: System, people: Individuals) -> Surroundings:
        check_model(system)
        return self.windows.around(system, people.of(self.unit))

    def _changed(
        self, system: System, people: Individuals, name: str, change: float
    ) -> Surroundings:
        """The surroundings if the logarithms of desired speeds, or their directions, change."""
        if name == DESIRED_SPEED:
            changed = people._replace(speed=people.speed * math.exp(change))
        else:
            changed = people._replace(turn=people.turn + change)
        return self._surroundings(system, changed)


def outlying_weights(square: np.ndarray) -> np.ndarray:
    """``(P,)`` weights of windows by their sums of squares ``(P,)``, see :data:`OUTLYING`; sums are
    0 where windows are not used."""
    if not square.any():
        return np.ones(len(square))
    limit = OUTLYING * float(np.median(square[square > 0]))
    weight: np.ndarray = limit / np.maximum(square, limit)
    return weight


def differences_of(system: System) -> Sequence[float]:
    """``(K,)``: finite differences of the parameters."""
    differences = []
    for name, p in ParameterVector(system).parameters.items():
        _, place, key = name.split(".", 2)
        term = system.terms[int(place)]
        strength = term.strengths.get(key) if isinstance(term, Effect) else None
        size = 1e-3 * max(1.0, float(p.detach().abs().max()))
        differences += [size if strength is None else abs(strength.step)] * p.numel()
    return differences


def _admissible(system: System, random: list[str], typical: float) -> np.ndarray:
    """``(2, Q)`` smallest and largest deviations of people with admissible parameters."""
    limits = {
        DESIRED_SPEED: [math.log(SLOWEST) - typical, math.inf],
        DESIRED_DIRECTION: [-math.inf, math.inf],
    }
    for name in [name for name in random if name not in limits]:
        value, bound = float(system.get_parameter(name).detach()), system.bounds()[name]
        with np.errstate(divide="ignore"):
            # of a parameter that is 0, all factors are admissible
            limits[name] = [np.log(end / max(value, TINY)) for end in (bound.low, bound.high)]
    return np.array([limits[name] for name in random]).reshape(-1, 2).T


def _limit(random: list[str]) -> np.ndarray:
    """``(Q,)`` largest changes of typical values: only that of the desired speed is estimated with
    the variances."""
    return np.array([LONGEST if name == DESIRED_SPEED else 0.0 for name in random])
