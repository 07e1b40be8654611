"""Engine of lanes with random effects: followers are simulated behind their measured leaders.

At the estimates of :mod:`nnode.population`, the deviations b of drivers and h of starts, the
residuals of a model f for the measured positions y are

    V^(-1/2) (y - f(theta, b, h) + Z b + H h),    V = V0 + Z Omega Z' + H S H',

where V0 is the covariance of autocorrelated pushes and of measurement errors. Their sum of squares
is that of generalised least squares. V, Z, H, b and h are fixed until the next estimate, so that
all models of a diagnosis are compared with the same whitening.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector, with_parameters
from nnode.data.sequence import Sequence
from nnode.diagnosis.lanes.engine import (
    LARGE,
    SMALL,
    TrafficEngine,
    huber_residuals,
    weights_of,
    with_all_strengths,
    with_each_strength,
)
from nnode.diagnosis.lanes.variables import place_variables, vehicle_variables
from nnode.diagnosis.outcome import Simulation
from nnode.diagnosis.residuals.engine import Squares, of_residuals
from nnode.diagnosis.residuals.variables import Curve, Variable
from nnode.model.effects import Effect, Probe
from nnode.model.scene import Scene
from nnode.model.system import System
from nnode.model.term import State
from nnode.population.drivers import (
    STEP,
    Population,
    at_steps,
    bias_corrected,
    corrected_biases,
    fit_all_random,
    fit_drivers,
    initial_variances,
    refit,
    with_random_effects,
    with_smaller_errors,
)
from nnode.population.estimate import fit_deviations
from nnode.population.followers import (
    PAIRS,
    Followers,
    Paths,
    Push,
    paths_of,
    simulated_pairs,
)
from nnode.population.likelihood import PushNoise, Whitening, marginal
from nnode.simulation.numpy import strides
from nnode.simulation.rhs import side_by_side

#: Smallest standard deviation of errors of positions, m. Paths without measurement errors differ
#: from the model's by some centimetres, because its zones have ends of finite width and simulators
#: integrate differently. The table in docs/discovery.md shows what other values do. For the same
#: reason, effects that move the simulated paths by less are not relevant.
ERROR = 0.05
#: Smallest standard deviation of the start of a memory in residuals, in its own unit. Residuals do
#: not depend on these starts then. They are not measured, and the mean of their deviations is not
#: 0: false effects were found that act on the whole record, and there on the start only.
DIFFUSE = 100.0
#: Largest number of values of rates that are kept at once, for memory.
NUMBERS = 4_000_000
#: Difference of a curve's scale for derivatives.
SCALE = 1e-3


@dataclass
class _Run:
    """A run of a model at the drivers' estimates.

    Attributes:
        system: the model, with the run's parameters. model: its followers.
        parameters: ``(P, F)`` parameters of each follower.
        states: ``(K, M, F)``.
        rates: ``(M, K, F)`` of its states. step, after: the linear response, see
            :meth:`Followers.linear`.
        weight: ``(n,)`` of the residuals: less than 1 for large ones.
    """

    system: System
    model: Followers
    parameters: np.ndarray
    states: np.ndarray
    rates: np.ndarray
    step: np.ndarray
    after: np.ndarray
    weight: Tensor

    @cached_property
    def scene(self) -> Scene:
        """The surroundings of all followers at all samples."""
        scene = self.model.system.scene(self.model.paths.batch)
        return side_by_side(scene, len(self.states), at_samples=True)


class FollowersEngine(TrafficEngine):
    """Residuals of followers; see :class:`~nnode.diagnosis.residuals.engine.Engine`.

    Args:
        sequences: at least one, of the same sampling interval.
        clusters: ``(S,)`` of the sequences; None: each is one.
        large: threshold of Huber's loss.
        like: an engine whose estimates are used for all models; only deviations of drivers and of
            starts are estimated.
        apart: smallest time between positions that are used, s. If it is not 0, sequences are
            simulated with samples at most :data:`~nnode.population.drivers.STEP` apart.

    Attributes:
        population: the last estimate of :meth:`fit_whitening`; None before.
    """

    def __init__(
        self,
        sequences: list[Sequence],
        clusters: np.ndarray | None = None,
        large: float = LARGE,
        like: FollowersEngine | None = None,
        apart: float = 0.0,
    ) -> None:
        self.apart: float = apart if like is None else like.apart
        if self.apart:
            sequences = at_steps(sequences)
        super().__init__(sequences, np.inf, clusters, large)
        self._paths_by_step, self._like = dict[tuple[int, int], Paths](), like
        self._label = np.arange(len(sequences)) if clusters is None else np.asarray(clusters)
        self.population: Population | None = None
        self._whitening: Whitening | None = None
        self._last_run: tuple[System, Tensor, _Run] | None = None
        paths = self._paths(STEP)
        self._observed = torch.from_numpy(paths.observed)
        f, k = np.nonzero(paths.observed)
        self.sequence = paths.sequence[f]
        self.cluster = of_residuals(clusters, self.sequence)
        self.clock = np.array([s.time[0] for s in sequences])[self.sequence] + k * paths.dt
        self.component = np.zeros(len(f), dtype=int)
        self.unit = self.sequence

    def residuals(self, system: System, rows: Tensor) -> Tensor:
        """``(R, n)`` whitened residuals, with Huber's loss for large ones."""
        difference = self._pseudo_residuals(system, rows)[0]
        return huber_residuals(self._whitened(difference.transpose(2, 1, 0)), self.large)

    def squares(self, system: System, row: Tensor) -> Squares:
        """Squared errors of the followers' positions after the first sample, with the deviations
        of drivers and starts that are most likely under this model."""
        compared = self._observed.numpy() & (np.arange(self._observed.shape[1]) > 0)
        sequence = np.repeat(self._paths(STEP).sequence, compared.sum(1))
        return Squares(self._position_errors(system, row)[compared] ** 2, sequence)

    def relevant(self, before: System, after: System, square: float) -> bool:
        """Whether simulated paths with and without an effect differ by :data:`ERROR` (root mean
        square), with the same drivers. Pushes produce most of the errors, and drivers may imitate
        an effect, so the decrease of the errors shows no effect."""
        without, with_effect = (
            self._simulated(system, ParameterVector(system).row[None])[1][:, 0, 0].T
            for system in (before, after)
        )
        change = (with_effect - without)[self._observed.numpy()]
        return not np.sqrt(np.mean(change**2)) < ERROR

    def simulated(self, system: System, row: Tensor) -> list[Simulation | None]:
        """The simulated followers of each sequence, with the deviations of :meth:`squares`."""
        errors, paths = self._position_errors(system, row), self._paths(STEP)
        simulations: list[Simulation | None] = []
        for b, s in enumerate(self.sequences):
            x = np.full_like(s.x[..., 0], np.nan)
            for f in np.flatnonzero(paths.sequence == b):
                x[:, paths.place[f]] = paths.x[f, : len(x)] - errors[f, : len(x)]
            simulations.append(Simulation(s, x[..., None], skip=1))
        return simulations

    def variables(self) -> list[Variable]:
        """The variables on which deviations of vehicles may depend; none of the vehicle behind, who
        reacts to the real path."""
        paths = self._paths(STEP)
        number = np.array([s.n_agents for s in self.sequences])[paths.sequence]
        places = place_variables(number - 1 - paths.place, paths.place)
        return [*vehicle_variables(self.smoothed), *places]

    @np.errstate(over="ignore", invalid="ignore")  # of simulations that diverge
    def tangents(self, system: System, row: Tensor) -> Tensor:
        """``(K, n)`` derivatives of the residuals, by finite differences."""
        _, curve = _parts(system)
        run = self._run_of(system, row)
        theta = run.model.at(row.numpy()[: len(run.model.names)])
        agents, start = self._deviations(run.model)
        columns, _ = run.model.columns(theta, agents, start)
        natural = run.model.natural(theta)
        columns = columns / np.where(run.model.logs, natural, 1.0)
        if curve is not None:
            sides = torch.stack([row, row])
            sides[0, -1] += SCALE
            sides[1, -1] -= SCALE
            higher, lower = self._simulated(system, sides)[1][:, 0].transpose(1, 2, 0)
            scale = ((higher - lower) / (2 * SCALE))[..., None]
            columns = np.concatenate([columns, scale], -1)
        return self._residual_changes(run, columns)

    def screen_columns(
        self, system: System, row: Tensor, effect: type[Effect], *probes: Probe
    ) -> Tensor:
        """``(S, n)`` derivatives of the residuals with respect to the strengths of one probe after
        the other: by linear response; of an effect with a memory, the change by it as a whole.

        Some changes are simulated, because the linear response is not exact enough. Effects by a
        property of the vehicle change the same as differences between drivers. Where those are
        large, V^(-1/2) leaves less of this direction than the errors of the linear response, which
        are some per mille. The speed of a map from step to step does not depend on a desired speed
        above it. The linear response to a factor that brings the desired speed below it adds the
        change of one step in every step."""
        run, changes = self._run_of(system, row), []
        at_once = max(1, NUMBERS // run.rates.size)
        if len(probes) > at_once:
            parts = [probes[i : i + at_once] for i in range(0, len(probes), at_once)]
            return torch.cat([self.screen_columns(system, row, effect, *part) for part in parts])
        simulated: list[tuple[System, float]] = []
        if effect.remembers():
            simulated = [with_all_strengths(run.system, effect, probe) for probe in probes]
        elif effect.covariate is not None:
            for probe in probes:
                small = replace(probe, steps={name: SMALL * x for name, x in probe.steps.items()})
                simulated += with_each_strength(run.system, effect, small)
        elif effect.consecutive and run.system.is_map:
            for probe in probes:
                simulated += with_each_strength(run.system, effect, probe)
        if simulated:
            changes = [self._displacement(run, changed) / size for changed, size in simulated]
            return self._residual_changes(run, np.stack(changes, 2))
        for probe in probes:
            for changed, size in with_each_strength(run.system, effect, probe):
                model = self._model(changed, ParameterVector(changed).row)
                parameters = model.spread(model.start, self._deviations(model)[0])
                changes.append((model.rates(parameters, run.states) - run.rates) / size)
        return self._residual_changes(run, self._propagate(run, np.stack(changes, 2)))

    def response(
        self, system: System, row: Tensor, rates: Callable[[State], list[Tensor]]
    ) -> Tensor:
        """``(M, n)`` derivatives of the residuals with respect to factors of M further speeds.

        Args:
            rates: of a state M speeds ``(B, N, 1)``, m/s.
        """
        run = self._run_of(system, row)
        paths, (k, _, f) = run.model.paths, run.states.shape
        speed = run.rates[0]
        time = torch.arange(k, dtype=torch.float64).repeat_interleave(f) * paths.dt
        ahead = paths.ahead_at_samples
        state = _state_of(run.model, time, run.states[:, 0], speed, ahead, run.scene)
        speeds = [rate[:, 0, 0].reshape(k, f).numpy() for rate in rates(state)]
        source = np.zeros((run.model.lane.order, k, len(speeds), f))
        source[-1] = np.stack(speeds, 1)
        return self._residual_changes(run, self._propagate(run, source))

    def on_sequences(self, sequences: list[Sequence]) -> FollowersEngine:
        """An engine of other sequences, with the estimates of this one."""
        assert self.population is not None
        engine = FollowersEngine(sequences, large=np.inf, like=self)
        model = self.population.model
        engine.fit_whitening(model.system, ParameterVector(model.system).row)
        return engine

    def fit_whitening(self, system: System, row: Tensor) -> None:
        """Estimate drivers, starts, pushes and their variances, with the model's parameters, and
        select which parameters differ between drivers."""
        population = self.population_of(with_parameters(system, row))
        selected = self.population is None or self._like is not None
        self.set_population(population if selected else with_random_effects(population))

    def population_of(self, system: System) -> Population:
        """The estimate with a model; the engine keeps its own. The same parameters differ between
        drivers as in the engine's estimate; if it has none, they are selected."""
        like = None if self._like is None else self._like.population
        fixed = system if like is None else like.system
        paths = self._paths_for(fixed, ParameterVector(fixed).row)
        start = like if self.population is None else self.population
        if start is None:
            return fit_drivers(fixed, paths, pairs=0)
        return refit(start, fixed, paths, fixed=self._like is not None)

    def reselected(self, population: Population) -> Population:
        return with_random_effects(population)

    def drivers(self, seed: int) -> Population:
        """The last estimate, corrected for its bias; where errors of positions are smaller than
        :data:`ERROR`, with errors estimated as well, because larger ones would lengthen the
        pushes."""
        population = self.population
        assert population is not None
        if population.model.paths.error <= ERROR:
            population = with_smaller_errors(population)
        return bias_corrected(population, seed, PAIRS)

    def log_likelihoods(self, *starts: System) -> tuple[np.ndarray, System]:
        """``(G,)`` log marginal likelihoods of the clusters under a law with parameters of its own,
        which all differ between drivers, minus their share of the number of parameters times half
        the logarithm of the number of drivers (BIC); and the calibrated law.

        Args:
            starts: the law with different parameters. The search starts from those that are most
                likely after one step.

        Raises:
            SimulationError: the simulations of all starts diverge.
        """
        population = fit_all_random((s, self._paths_for(s, ParameterVector(s).row)) for s in starts)
        paths = population.model.paths
        cluster = np.zeros(len(paths.names), dtype=int)
        cluster[paths.agent] = self._label[paths.sequence]
        each = np.bincount(cluster, population.marginal.each)
        present = np.bincount(cluster) > 0
        price = (population.marginal.loglik - population.criterion) / present.sum()
        return each[present] - price, population.system

    def with_usual_variances(self, system: System) -> FollowersEngine:
        """An engine with the variances where searches start, and all parameters of the law that can
        differ between drivers as random effects. The variances of a model that lacks a strong
        effect attribute it to pushes, and would hide where it acts."""
        row = ParameterVector(system).row
        paths = self._paths_for(system, row)
        alike = Followers(system, paths)
        model = alike.with_random(alike.may_differ)
        variances = initial_variances(model)
        deviations = fit_deviations(model, PushNoise(), model.start, variances)
        engine = copy.copy(self)
        engine.set_population(Population.uncorrected(model, deviations))
        return engine

    def simulated_engines(self, system: System, row: Tensor, seed: int) -> list[FollowersEngine]:
        """Engines of paths simulated by a model, with deviations of drivers, pushes and measurement
        errors as estimated under it: an antithetic pair of draws."""
        refitted, engines = self._deviations_under(system, row), []
        (pair,) = simulated_pairs(refitted.model, refitted.estimate, seed, pairs=1)
        for model, modes in pair:
            engine = copy.copy(self)
            engine._paths_by_step = {
                strides(model.paths.dt, 2 * model.paths.half + 1e-9): model.paths
            }
            engine.set_population(replace(refitted, model=model, estimate=modes))
            engines.append(engine)
        return engines

    def biases(self, system: System, row: Tensor, seed: int) -> np.ndarray:
        """``(R, K)`` biases of a model's parameters, in their units, see
        :func:`~nnode.population.drivers.corrected_biases`."""
        population = self._deviations_under(system, row)
        model, theta = population.model, population.estimate.theta
        biases = corrected_biases(population, seed, PAIRS).theta
        return model.natural(theta) - model.natural(theta - biases)

    def _deviations_under(self, system: System, row: Tensor) -> Population:
        """The last estimate, with the deviations of drivers and starts under a model."""
        assert self.population is not None
        fixed = with_parameters(system, row)
        return refit(self.population, fixed, self._paths_for(fixed, row), fixed=True)

    # -- parts -----------------------------------------------------------------------------------

    def _paths(self, longest: float) -> Paths:
        """The followers, for simulations with steps of at most ``longest`` s. A driver in several
        clusters counts as several drivers, because clusters must be independent."""
        key = strides(self.batch.dt, longest)
        if key not in self._paths_by_step:
            paths = paths_of(self.sequences, longest, ERROR).apart(self.apart)
            pairs = np.stack([paths.agent, self._label[paths.sequence]])
            drivers, agent = np.unique(pairs, axis=1, return_inverse=True)
            names = tuple(paths.names[i] for i in drivers[0])
            self._paths_by_step[key] = replace(paths, agent=agent.reshape(-1), names=names)
        return self._paths_by_step[key]

    def _paths_for(self, system: System, row: Tensor) -> Paths:
        """The followers, for simulations of a model with these parameters."""
        return self._paths(self._longest(system, row[None]))

    def _model(self, system: System, row: Tensor) -> Followers:
        random = [] if self.population is None else self.population.random
        paths = self._paths_for(system, row)
        model = Followers(system, paths)
        return model.with_random(random) if set(random) <= set(model.names) else model

    def _deviations(self, model: Followers) -> tuple[np.ndarray, np.ndarray]:
        """Estimated deviations of drivers ``(D, Q)`` and of starts ``(F, H)``; none for another
        law than the one they were estimated with."""
        population, start = self.population, np.zeros((len(model.paths.agent), model.starts))
        if population is None or len(population.model.random) != len(model.random):
            return np.zeros((0, 0)), start
        # initial memory states are not comparable between models with different terms
        same_starts = model.starts == population.model.starts
        shared = model.starts if same_starts else model.lane.order
        start[:, :shared] = population.estimate.start[:, :shared]
        return population.estimate.agents, start

    def _simulated(self, system: System, rows: Tensor) -> tuple[Followers, np.ndarray]:
        """``(K, M, R, F)`` states of R runs at the drivers' estimates."""
        model_system, curve = _parts(system)
        model = self._model(model_system, rows.amin(0)[: len(rows[0]) - (curve is not None)])
        agents, start = self._deviations(model)
        number, initial = len(model.names), start.T
        theta = [model.spread(model.at(row.numpy()[:number]), agents) for row in rows]
        pushed = None if curve is None else self._curve_push(model, curve, rows[:, -1])
        return model, model.simulate(np.stack(theta), np.stack([initial] * len(rows)), pushed)

    def _pseudo_residuals(
        self, system: System, rows: Tensor
    ) -> tuple[np.ndarray, Followers, np.ndarray]:
        """``(R, F, K)`` y - f + Z b + H h; the model, and its states ``(K, M, R, F)``."""
        model, states = self._simulated(system, rows)
        difference = model.paths.x - states[:, 0].transpose(1, 2, 0)
        agents, start = self._deviations(model)
        if self.population is not None:
            data = self.population.estimate.data
            n_common = min(data.start.shape[-1], start.shape[-1])
            difference = difference + np.einsum(
                "fkh,fh->fk", data.start[..., :n_common], start[:, :n_common]
            )
            if agents.size:
                difference = difference + np.einsum(
                    "fkq,fq->fk", data.by_deviation, agents[model.paths.agent]
                )
        return difference, model, states

    def set_population(self, population: Population) -> None:
        """Whiten residuals by an estimate."""
        estimate, variances = population.estimate, population.estimate.variances
        self.population = population
        start = variances.start.copy()
        memory = start[population.model.lane.order :]
        memory[:] = np.maximum(memory, DIFFUSE)
        self._whitening = Whitening(
            estimate.data, PushNoise(), variances.noise, variances.spread, start
        )
        self._last_run = None

    def _position_errors(self, system: System, row: Tensor) -> np.ndarray:
        """``(F, K)`` errors of positions, m, with deviations by generalised least squares."""
        difference, model, _ = self._pseudo_residuals(system, row[None])
        errors: np.ndarray = difference[0]
        if self._whitening is None or self.population is None:
            return errors
        variances = self.population.estimate.variances
        data = self.population.estimate.data
        diverged = ~np.isfinite(errors).all(1)
        data = replace(data, residual=np.where(diverged[:, None], 0.0, errors))
        products = PushNoise().products(data, variances.noise)
        unchanged = np.zeros(data.fixed.shape[-1])
        posterior = marginal(
            data, products, variances.spread, variances.start, low=unchanged, high=unchanged
        )
        errors = errors - np.einsum("fkh,fh->fk", data.start, posterior.start)
        driver_deviations = posterior.deviations[model.paths.agent]
        return np.asarray(errors - np.einsum("fkq,fq->fk", data.by_deviation, driver_deviations))

    def _whitened(self, columns: np.ndarray) -> Tensor:
        """``(C, n)`` of columns ``(K, F, C)``."""
        columns = columns.transpose(1, 0, 2)
        white = columns if self._whitening is None else self._whitening(columns)
        return torch.from_numpy(white)[self._observed].T

    def _residual_changes(self, run: _Run, columns: np.ndarray) -> Tensor:
        """``(C, n)`` changes of the residuals by displacements ``(F, K, C)``."""
        white = self._whitened(-np.nan_to_num(columns).transpose(1, 0, 2))
        return torch.nan_to_num(white * run.weight)

    def _run_of(self, system: System, row: Tensor) -> _Run:
        """A run of a model; the last one is cached."""
        cached = self._last_run
        if cached is not None and cached[0] is system and torch.equal(cached[1], row):
            return cached[2]
        difference, model, states = self._pseudo_residuals(system, row[None])
        plain, _ = _parts(system)
        fixed = with_parameters(plain, row[: len(model.names)])
        parameters = model.spread(
            model.at(row.numpy()[: len(model.names)]), self._deviations(model)[0]
        )
        step, after, _ = model.linear(parameters, states[:, :, 0])
        weight = weights_of(self._whitened(difference.transpose(2, 1, 0))[0], self.large)
        rates = model.rates(parameters, states[:, :, 0])
        run = _Run(fixed, model, parameters, states[:, :, 0], rates, step, after, weight)
        self._last_run = system, row.clone(), run
        return run

    def _propagate(self, run: _Run, source: np.ndarray) -> np.ndarray:
        """``(F, K, C)`` displacements by changes ``(W, K, C, F)`` of the first W rates."""
        f, n_intervals, m, _ = run.after.shape
        source = source[:m]
        forcing = (source[:, 1:] + source[:, :-1]).transpose(1, 3, 0, 2)
        state = np.zeros((f, m, source.shape[2]))
        positions = np.zeros((n_intervals + 1, *state[:, 0].shape))
        for k in range(n_intervals):
            state = run.step[:, k] @ state + run.after[:, k, :, : len(source)] @ forcing[k]
            positions[k + 1] = state[:, 0]
        return positions.transpose(1, 0, 2)

    def _displacement(self, run: _Run, changed: System) -> np.ndarray:
        """``(F, K)`` displacements by a changed model, m; zero if they exceed the observed road,
        because the change is then not small."""
        x = self._simulated(changed, ParameterVector(changed).row[None])[1][:, 0, 0]
        paths = run.model.paths
        displacement: np.ndarray = (x - run.states[:, 0]).T
        largest, road = np.abs(displacement[paths.observed]).max(), np.ptp(paths.x[paths.observed])
        if not largest <= road:
            return np.zeros_like(displacement)
        return displacement

    def _curve_push(self, model: Followers, curve: Curve, scale: Tensor) -> Push:
        """The push of a curve on the highest rate, in runs with several scales."""
        paths = model.paths
        scene = side_by_side(model.system.scene(paths.batch), len(scale))

        def pushed(at: int, y: np.ndarray, rates: np.ndarray) -> np.ndarray:
            time = torch.tensor(at * paths.half, dtype=torch.float64)
            ahead = np.repeat(paths.ahead[at][None], len(scale), 0)
            state = _state_of(model, time, y[0], rates[0], ahead, scene)
            height = curve.variable.curve(curve.variable.value(state), curve.amounts)
            change = height[..., None] * curve.variable.direction(state)
            push: np.ndarray = change[:, 0, 0].reshape(len(scale), -1).numpy()
            return push * scale.numpy()[:, None]

        return pushed


def _parts(system: System) -> tuple[System, Curve | None]:
    """A model without the curve that is its last term, and the curve."""
    last = system.terms[-1]
    if not isinstance(last, Curve):
        return system, None
    plain = copy.deepcopy(system)
    del plain.terms[-1]
    return plain, last


def _state_of(
    model: Followers,
    time: Tensor,
    x: np.ndarray,
    speed: np.ndarray,
    ahead: np.ndarray,
    scene: Scene,
) -> State:
    """The state of every follower with the one or two vehicles ahead, for terms.

    Args:
        time: s. x, speed: ``(L, F)`` of the followers, m and m/s. ahead: ``(L, 4, F)``.
    """
    n_vehicles = model.paths.batch.x.shape[2]
    place = np.stack([x, ahead[:, 0], ahead[:, 2]][:n_vehicles], -1)
    rate = np.stack([speed, ahead[:, 1], ahead[:, 3]][:n_vehicles], -1)
    places, rates = (
        torch.from_numpy(values.reshape(-1, n_vehicles, 1)) for values in (place, rate)
    )
    second = model.lane.order > 1
    return State(time, places, rates if second else None, scene, rate=rates)
