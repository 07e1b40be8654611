"""Engine of lanes: platoons are simulated behind their measured leader."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor, nn

from nnode.calibrate.parameters import ParameterVector, with_parameters
from nnode.data.paths import noise_variance, smooth, velocity
from nnode.data.sequence import Sequence, collate
from nnode.diagnosis import thresholds
from nnode.diagnosis.lanes.variables import platoon_variables
from nnode.diagnosis.lanes.whitening import PlatoonFilter
from nnode.diagnosis.outcome import Simulation
from nnode.diagnosis.residuals.engine import Squares, of_residuals, square_of
from nnode.diagnosis.residuals.variables import Variable
from nnode.model.effects import Effect, IndividualEffect, Probe
from nnode.model.extend import effects_of, extended, without
from nnode.model.system import System
from nnode.model.term import State
from nnode.population.followers import longest_step
from nnode.simulation.linear import LinearResponse
from nnode.simulation.numpy import simulated, strides
from nnode.simulation.rhs import RightHandSide, rates_along

#: Longest step of the simulation, s, by the law's order. Steps are no longer than the shortest time
#: constant of the states that terms own.
STEP = {1: 0.4, 2: 0.2}
#: Length of the windows in which sequences are compared, s; the preceding time in which the
#: influence of the start decays, s, and its largest share of the sequence.
WINDOW, FORGET, SHARE = 10.0, 5.0, 0.2
#: Threshold of Huber's loss for whitened residuals.
LARGE = 6.0
#: Difference of an agent's parameter for derivatives, and share of an effect's step.
SMALL = 1e-4
#: Number of sequences times changes whose response is computed at once; so many fit the cache.
BLOCK = 4096
#: Largest order of the autoregressive filter.
ORDER = 6


class TrafficEngine:
    """Residuals of platoons; see :class:`~nnode.diagnosis.residuals.engine.Engine`.

    Only the leader's path and the starts are taken from the smoothed measurement. Followers are
    simulated behind each other, so that no follower's noise enters the right-hand side. Because the
    influence of the start decays within seconds, windows lose little information. They keep the
    simulated paths near the measured ones, even if the model is very wrong.

    Args:
        sequences: at least one, of the same sampling interval.
        window: length of a window, s; infinite simulates whole sequences.
        clusters: ``(S,)`` of the sequences; None: each is one.
        large: threshold of Huber's loss.

    Attributes:
        unit: ``(n,)`` agents whose parameters are estimated jointly: those of a sequence.
        people: of each unit, per direction the sequence and the place of its agent.
    """

    def __init__(
        self,
        sequences: list[Sequence],
        window: float = WINDOW,
        clusters: np.ndarray | None = None,
        large: float = LARGE,
    ) -> None:
        self.sequences, self.large = sequences, large
        self.names = [sequence.name for sequence in sequences]
        parts = [_windows(sequence, window) for sequence in sequences]
        self.batch = collate(part[0] for each in parts for part in each)
        smoothed = [_windows(_smoothed(sequence), window) for sequence in sequences]
        self.smoothed = collate(part[0] for each in smoothed for part in each)
        sequence_of = np.repeat(np.arange(len(parts)), [len(each) for each in parts])
        leader = self.batch.agent.sum(1) - 1
        index = torch.arange(self.batch.x.shape[2])
        follower = self.batch.agent & (index != leader[:, None])
        self.follows = self.batch.valid & follower
        # the start is given, and contains disturbances that continue
        n_skipped = [part[1] for each in parts for part in each]
        time = torch.arange(self.batch.n_samples)[:, None]
        self.compared = self.follows & (time > torch.tensor(n_skipped))[..., None]
        self.filter = PlatoonFilter.none()
        self._last: tuple[System, Tensor, Tensor] | None = None
        self._response: tuple[System, Tensor, LinearResponse] | None = None
        k, b, _ = (axis.numpy() for axis in torch.nonzero(self.compared, as_tuple=True))
        self.sequence = sequence_of[b]
        self.cluster = of_residuals(clusters, self.sequence)
        self.clock = self.batch.start.numpy()[b] + k * self.batch.dt
        self.component = np.zeros(len(b), dtype=int)
        self.unit = self.sequence
        self.people = [
            [(i, n) for n in range(self.batch.agent.shape[1])] for i in range(len(sequences))
        ]

    def noise_floor(self) -> float:
        """Mean square error of positions due to measurement noise, m²."""
        variances = [noise_variance(s.x[:, :-1]) for s in self.sequences if s.n_samples > 4]
        weight = [s.n_samples * (s.n_agents - 1) for s in self.sequences if s.n_samples > 4]
        return float(np.average(variances, weights=weight)) if variances else float("nan")

    @np.errstate(all="ignore")
    def simulate(self, system: System, rows: Tensor) -> Tensor:
        """``(R, K, B, N, W)`` states; their first component are positions, m."""
        batch, longest = self.smoothed, self._longest(system, rows)
        scene = replace(system.scene(batch), step=self._step(longest))
        rhs = RightHandSide(system, scene, ParameterVector(system).runs(rows))
        states = simulated(rhs, rhs.start(batch), batch.dt, batch.n_samples, longest)
        return torch.from_numpy(states).permute(3, 0, 4, 2, 1).contiguous()

    def _longest(self, system: System, rows: Tensor) -> float:
        """Longest step, s."""
        return longest_step(system, rows, STEP[system.order])

    def _step(self, longest: float) -> float:
        stride, steps = strides(self.batch.dt, longest)
        return self.batch.dt * stride / steps

    def deviations(self, system: System, rows: Tensor) -> Tensor:
        """``(R, K, B, N)`` measured minus simulated positions, m; 0 for leaders and outside of
        what was measured."""
        with torch.no_grad():
            states = self.simulate(system, rows)
        self._last = system, rows[0].clone(), states[0]
        difference = self.batch.x[..., 0] - states[..., 0]
        return torch.where(self.follows, difference, 0.0)

    def residuals(self, system: System, rows: Tensor) -> Tensor:
        """``(R, n)`` whitened residuals, with Huber's loss for large ones."""
        return huber_residuals(
            self.filter(self.deviations(system, rows))[:, self.compared], self.large
        )

    def tangents(self, system: System, row: Tensor) -> Tensor:
        """``(K, n)`` derivatives of the residuals, by linear response."""
        response = self.linear(system, row)
        with torch.no_grad():
            return self._columns(response, response.parameters(ParameterVector(system).places))

    def screen_columns(
        self, system: System, row: Tensor, effect: type[Effect], *probes: Probe
    ) -> Tensor:
        """``(S, n)`` derivatives of the residuals with respect to the strengths of one probe after
        the other, by linear response; the change by the effect as a whole where it has none."""
        response = self.linear(system, row)
        if effect.remembers():
            return torch.cat([self._finite_change(response, effect, probe) for probe in probes])
        base = response.rates(response.system)
        sources = [
            (response.rates(changed) - base) / step
            for probe in probes
            for changed, step in with_each_strength(response.system, effect, probe)
        ]
        return self._columns(response, response.response(torch.stack(sources)))

    def _finite_change(
        self, response: LinearResponse, effect: type[Effect], probe: Probe
    ) -> Tensor:
        """``(1, n)`` change of the residuals by an effect of finite strength; zero if it moves
        vehicles by more than the observed road, because it is then not small."""
        changed, amount = with_all_strengths(response.system, effect, probe)
        with torch.no_grad():
            x = self.simulate(changed, ParameterVector(changed).row[None])[0][..., 0]
        displacement = torch.where(self.follows, x - response.states[..., 0], 0.0)
        measured = self.batch.x[..., 0][self.batch.valid]
        if not float(displacement.abs().max()) <= float(measured.max() - measured.min()):
            displacement = torch.zeros_like(displacement)
        return self._columns(response, displacement[None] / amount)

    def response(
        self, system: System, row: Tensor, rates: Callable[[State], list[Tensor]]
    ) -> Tensor:
        """``(M, n)`` derivatives of the residuals with respect to factors of M further speeds.

        Args:
            rates: of a state M speeds ``(B, N, 1)``, m/s.
        """
        linear = self.linear(system, row)
        k, b, n = linear.states.shape[:3]
        speeds = [speed.reshape(k, b, n).transpose(1, 2) for speed in rates(linear.state())]
        size = max(1, BLOCK // b)
        columns = []
        for start in range(0, len(speeds), size):
            source = torch.stack(speeds[start : start + size], 2).permute(2, 0, 3, 1)[..., None]
            # rates of places, or of speeds, before which those of places do not change
            source = nn.functional.pad(source, (system.order - 1, 0))
            columns.append(self._columns(linear, linear.response(source)))
        return torch.cat([speed.T for speed in columns], 1).T

    def linear(self, system: System, row: Tensor) -> LinearResponse:
        """The linear response of a run; the last one is cached."""
        cached = self._response
        if cached is not None and cached[0] is system and torch.equal(cached[1], row):
            return cached[2]
        previous = self._last
        if previous is None or previous[0] is not system or not torch.equal(previous[1], row):
            self.deviations(system, row[None])
        assert self._last is not None
        fixed = with_parameters(system, row)
        step = self._step(self._longest(system, row[None]))
        scene = replace(fixed.scene(self.smoothed), step=step)
        with torch.no_grad():
            response = LinearResponse(fixed, self.smoothed, scene, self._last[2])
        self._response = system, row.clone(), response
        return response

    def _columns(self, response: LinearResponse, displacement: Tensor) -> Tensor:
        """``(C, n)`` changes of the residuals by displacements ``(C, K, B, N)``."""
        difference = self.batch.x[..., 0] - response.states[..., 0]
        residual = self.filter(torch.where(self.follows, difference, 0.0))[self.compared]
        weight = weights_of(residual, self.large)
        white_columns = self.filter(torch.where(self.follows, -displacement, 0.0)).permute(
            1, 2, 3, 0
        )[self.compared]
        return torch.nan_to_num(white_columns.mul_(weight[:, None])).T

    def regression_start(self, system: System) -> System:
        """A copy whose law is fitted to the smoothed rates by regression. The regression is biased
        by noise, but calibrations that start there avoid distant local minima."""
        fitted, batch = copy.deepcopy(system), self.smoothed
        if fitted.memory:
            return fitted  # memory states are not measured
        vector = ParameterVector(fitted)
        low, high = vector.bounds
        states, measured_rates = batch.x, batch.v[..., 0]
        if system.order > 1 and batch.n_samples > 1:
            states = torch.cat([batch.x, batch.v], -1)
            measured_rates = torch.from_numpy(velocity(batch.v[..., 0].numpy(), batch.dt))
        scene = fitted.scene(batch)

        def missed(row: np.ndarray) -> np.ndarray:
            rates = rates_along(vector.fill_(row), scene, states)
            rate = rates[..., system.order - 1]
            misfit: np.ndarray = (measured_rates - rate)[self.follows].numpy()
            return np.nan_to_num(misfit, nan=1e3, posinf=1e3, neginf=-1e3)

        start = np.clip(vector.row.numpy(), low, high)
        best = least_squares(missed, start, bounds=(low, high), loss="soft_l1", max_nfev=50)
        return vector.fill_(best.x)

    def squares(self, system: System, row: Tensor) -> Squares:
        """Squared errors of the followers' positions."""
        difference = self.deviations(system, row[None])[0][self.compared].numpy()
        return Squares(difference**2, self.sequence)

    def relevant(self, before: System, after: System, square: float) -> bool:
        """Whether squared errors fall by :data:`~nnode.diagnosis.thresholds.SMALLEST_SHARE` of
        ``square``."""
        removed = square_of(self, before) - square_of(self, after)
        return removed >= thresholds.SMALLEST_SHARE * square

    def simulated(self, system: System, row: Tensor) -> list[Simulation | None]:
        """Whole sequences behind their leaders; of engines without windows."""
        difference = self.deviations(system, row[None])[0].numpy()
        simulations: list[Simulation | None] = []
        for i, s in enumerate(self.sequences):
            x = s.x[..., 0] - difference[: s.n_samples, i, : s.n_agents]
            x[:, -1] = np.nan
            simulations.append(Simulation(s, x[..., None], skip=1))
        return simulations

    def variables(self) -> list[Variable]:
        """The variables on which deviations of vehicles may depend."""
        return platoon_variables(self.smoothed)

    def individual(
        self, system: System, row: Tensor, effect: type[IndividualEffect], options: dict[str, Any]
    ) -> Tensor:
        """``(N, n)``: derivatives of the residuals with respect to the number of the vehicle at
        each place of the platoon, in all sequences at once."""
        linear = self.linear(system, row)
        ((values, number),) = effect.directions(options)
        effects = [term for term in effects_of(linear.system) if isinstance(term, effect)]
        numbers = effects[0].people if effects else {}
        without_effect = without(linear.system, effect.name) if effects else linear.system
        size = self.batch.agent.shape[1]

        def rates(place: int | None) -> Tensor:
            people = {name: [*numbers.get(name, []), *[0.0] * size][:size] for name in self.names}
            for agent_numbers in people.values():
                if place is not None:
                    agent_numbers[place] += number * SMALL
            return linear.rates(extended(without_effect, effect(people=people, **values))[0])

        base = rates(None)
        sources = [(rates(place) - base) / SMALL for place in range(size)]
        return self._columns(linear, linear.response(torch.stack(sources)))

    def on_sequences(self, sequences: list[Sequence]) -> TrafficEngine:
        """An engine of other sequences, with the filter of this one."""
        engine = TrafficEngine(sequences, np.inf, None, np.inf)
        engine.filter = self.filter
        return engine

    def fit_whitening(self, system: System, row: Tensor) -> None:
        """Fit the autoregressive filter to the residuals of a model."""
        shortest = int(self.batch.valid.any(-1).sum(0).min())
        order = min(ORDER, max(0, (shortest - 2) // 3))
        difference = self.deviations(system, row[None])[0]
        self.filter = PlatoonFilter.fitted(difference, self.compared, order)


def huber_residuals(residual: Tensor, threshold: float = LARGE) -> Tensor:
    """Residuals whose squares are Huber's loss, so that an outlier, such as a vehicle that breaks
    down, does not dominate.

    Source: Huber 1964.
    """
    size = residual.abs()
    if math.isinf(threshold):
        return residual
    large = torch.sqrt((2 * threshold * size - threshold**2).clamp(min=0)).copysign(residual)
    return torch.where(size <= threshold, residual, large)


def weights_of(residual: Tensor, threshold: float) -> Tensor:
    """Derivatives of :func:`huber_residuals`: less than 1 for large residuals."""
    size = huber_residuals(residual, threshold).abs()
    return torch.where(residual.abs() <= threshold, 1.0, threshold / size)


def with_all_strengths(system: System, effect: type[Effect], probe: Probe) -> tuple[System, float]:
    """A model with an effect whose strengths are all changed by a probe's steps, and the size of
    the step; 1 if the probe changes none. Its other terms are those of the given model."""
    values, amount = dict(probe.options), 1.0
    for name, step in probe.steps.items():
        values[name], amount = effect.strengths[name].neutral + step, step
    return extended(system, effect(**values), same_terms=True)[0], amount


def with_each_strength(
    system: System, effect: type[Effect], probe: Probe
) -> list[tuple[System, float]]:
    """Models with an effect of which one strength at a time is changed by a probe's step, with the
    size of the step. If the probe changes none: the effect itself, and 1."""
    if not probe.steps:
        return [with_all_strengths(system, effect, probe)]
    probes = [replace(probe, steps={name: step}) for name, step in probe.steps.items()]
    return [with_all_strengths(system, effect, single) for single in probes]


def _windows(sequence: Sequence, length: float) -> list[tuple[Sequence, int]]:
    """Windows, and of each the number of samples after its start that are not compared.

    The compared pieces have equal lengths and share their boundary samples. Each is preceded by
    samples in which the influence of the start decays. Whole sequences are compared from their
    start.
    """
    intervals = sequence.n_samples - 1
    if intervals < 1 or not math.isfinite(length):
        return [(sequence, 0)]
    forget = int(min(FORGET, SHARE * intervals * sequence.dt) / sequence.dt + 1e-9)
    number = max(1, round((intervals - forget) * sequence.dt / length))
    ends = np.linspace(forget, intervals, number + 1).round().astype(int)
    return [
        (
            replace(
                sequence,
                time=sequence.time[first - forget : last + 1],
                x=sequence.x[first - forget : last + 1],
                v=None if sequence.v is None else sequence.v[first - forget : last + 1],
            ),
            forget,
        )
        for first, last in pairwise(ends)
    ]


def _smoothed(sequence: Sequence) -> Sequence:
    x = smooth(sequence.x)
    return replace(sequence, x=x, v=velocity(x, sequence.dt) if len(x) > 1 else None)
