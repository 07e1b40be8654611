"""Engine of crowds: residuals of people who differ, each among the measured paths of the others.

In a crowd, errors of one person's simulated path would propagate to all. Therefore sequences are
cut into windows, and in each of them every person is simulated alone. With the notation of
:mod:`nnode.diagnosis.crowds.people`, the residuals of a model are

    V^(-1/2) (y - f(theta, b) + Z b)

without their projection on V^(-1/2) X. V, Z and b are fixed until the next estimate, so that all
models of a diagnosis are compared with the same whitening.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from collections.abc import Sequence as Many
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector, with_parameters
from nnode.data.sequence import Sequence, collate
from nnode.diagnosis.crowds.continuation import Change
from nnode.diagnosis.crowds.gait import estimated_gait
from nnode.diagnosis.crowds.people import CrowdPopulation, Gait, People, differences_of
from nnode.diagnosis.crowds.simulated import simulated_pair
from nnode.diagnosis.crowds.variables import crowd_variables
from nnode.diagnosis.crowds.windows import Individuals, Windows
from nnode.diagnosis.outcome import Simulation
from nnode.diagnosis.residuals.engine import Squares, of_residuals
from nnode.diagnosis.residuals.fit import ROUGH as ROUGH_COST
from nnode.diagnosis.residuals.fit import refine
from nnode.diagnosis.residuals.variables import Variable
from nnode.errors import SimulationError
from nnode.model.effects.base import Effect, IndividualEffect, Probe
from nnode.model.extend import effects_of, with_missing
from nnode.model.system import Crowd, System
from nnode.model.term import State
from nnode.population.drivers import ROUGH
from nnode.simulation.alone import PersonAlone, RunAlone

#: Length of windows, s.
SECONDS = 1.0
#: Antithetic pairs of simulated crowds that estimate the bias of parameters.
PAIRS = 3
#: Largest number of alternations between a calibration and an estimate of people.
ALTERNATIONS = 8
#: Number of columns that are computed at once, for memory.
COLUMNS = 64


class CrowdEngine:
    """Residuals of a crowd; see :class:`~nnode.diagnosis.residuals.engine.Engine`.

    Args:
        sequences: of people, equally sampled.
        window: length of a window, s.
        clusters: ``(S,)`` of the sequences; None: each is one.
        gait: of the people; None: it is estimated.
        given: the law with the parameters where calibrations start, see :meth:`population_of`.

    Attributes:
        batch: the sequences.
        sequence: ``(n,)`` position of each residual's sequence in the batch.
        clock: ``(n,)`` start time of its window, s.
        unit: ``(n,)`` number of its person, counted through all sequences.
        people: of each unit the sequence and the place of the person.
        population: the last estimate; None before.

    Raises:
        DataError: sequences too short for a window, or positions that are no numbers.
    """

    def __init__(
        self,
        sequences: Many[Sequence],
        window: float = SECONDS,
        clusters: np.ndarray | None = None,
        gait: Gait | None = None,
        given: System | None = None,
    ) -> None:
        self.sequences, self._seconds = list(sequences), window
        self._given = None if given is None else copy.deepcopy(given).double()
        self.batch = collate(sequences)
        self.windows = windows = Windows(sequences, window)
        self._people = People(windows)
        self._people.gait = estimated_gait(self._people) if gait is None else gait
        self._label = np.arange(len(sequences)) if clusters is None else np.asarray(clusters)
        self.people = [[pair] for pair in self._people.pairs]
        self.names = [item.name for item in sequences]
        window_of, n_residuals = windows.person[:, 0], 2 * windows.length
        self.sequence = windows.sequence[window_of].repeat(n_residuals)
        self.cluster = of_residuals(clusters, self.sequence)
        self.clock = windows.batch.start.numpy()[window_of].repeat(n_residuals)
        self.component = np.tile(np.arange(n_residuals), len(window_of))
        self.unit = self._people.unit.repeat(n_residuals)
        self.population: CrowdPopulation | None = None
        self._run: tuple[System, Tensor, RunAlone] | None = None

    # -- the interface of engines ----------------------------------------------------------

    def residuals(self, system: System, rows: Tensor) -> Tensor:
        """``(R, n)``: whitened differences, measured minus simulated, of R runs of one model."""
        population = self._fitted(system, rows[0])
        differences = self._people.differences(self._states(system, rows))
        joined = self._people.continued(differences, population.continuation)
        return self._whitened(joined + population.by_own(population.data.fixed)[..., None])

    def squares(self, system: System, row: Tensor) -> Squares:
        """Squared errors of positions, with the deviations of people that are most likely under
        this model."""
        window = self.windows.person[:, 0]
        squares = (self._errors(system, row) ** 2).sum(-1)
        n_samples = squares.shape[1]
        return Squares(squares.ravel(), self.windows.sequence[window].repeat(n_samples))

    def relevant(self, before: System, after: System, square: float) -> bool:
        """Whether records that are simulated with and without an effect differ by the error of
        measured positions (root mean square), with the same people. Pushes produce most of the
        errors, so the decrease of the errors shows no effect."""
        without, with_effect = (
            self._people.differences(self._states(system, ParameterVector(system).row[None]))
            for system in (before, after)
        )
        moved = Change(with_effect.position - without.position, with_effect.end - without.end)
        assert self.population is not None
        record = self._people.continued(moved, self.population.continuation)
        return not math.sqrt(np.mean(record**2)) < self._people.error

    def simulated(self, system: System, row: Tensor) -> list[Simulation | None]:
        """The windows in sequence, with the deviations of :meth:`squares`."""
        difference, length = self._errors(system, row), self.windows.length
        simulations: list[Simulation | None] = [None] * len(self.sequences)
        for i in self.windows.used:
            s, first, stride = self.sequences[i], *self.windows.compared[i]
            windows = np.flatnonzero(self.windows.sequence == i)
            keep = first + stride * np.arange(length * len(windows))
            goal = s.x[-1] if s.destination is None else s.destination
            part = replace(
                s,
                time=s.time[keep],
                x=s.x[keep],
                v=None if s.v is None else s.v[keep],
                destination=goal,
            )
            x = part.x.copy()
            for number, window in enumerate(windows):
                people = self.windows.person[:, 0] == window
                who = self.windows.person[people, 1]
                x[number * length : (number + 1) * length, who] -= difference[people].swapaxes(0, 1)
            simulations[i] = Simulation(part, x, restart=length)
        return simulations

    def variables(self) -> list[Variable]:
        """The variables on which deviations of people may depend."""
        windows, no_forces = self.windows, Crowd([])
        measured = torch.cat([windows.batch.x[::2], windows.batch.v[::2]], -1)
        run = RunAlone(windows.around(no_forces), no_forces, measured)
        start_of = dict(zip(self.batch.names, self.batch.start.tolist(), strict=True))
        return crowd_variables(run.state, start_of)

    def noise_floor(self) -> float:
        """Mean square error of positions due to measurement noise, summed over both coordinates,
        m²."""
        return 2 * self.windows.variance

    def fit_whitening(self, system: System, row: Tensor) -> None:
        """Estimate deviations of people, variances and weights, with the model's parameters.

        Residuals before and after the call cannot be compared.
        """
        fixed = with_parameters(system, row)
        self.set_population(self._people.estimated(fixed, self.population))

    # -- people who differ -----------------------------------------------------------------

    def set_population(self, population: CrowdPopulation) -> None:
        """Whiten residuals by an estimate."""
        self.population, self._run, data = population, None, population.data
        self._whitening = self._people.whitening(data, population.variances)
        common = self._people.parted(self._whitening(data.fixed[..., : population.has_speed]))
        self._common = np.linalg.qr(common.reshape(len(self.unit), population.has_speed))[0]

    def population_of(self, system: System) -> CrowdPopulation:
        """The likeliest estimate with a model, whose parameters are calibrated with it; the engine
        keeps its own. Calibrations start from the model's parameters, and for formulas from a
        regression that starts from those of the law as it was given.

        Raises:
            SimulationError: the simulations of all starts diverge.
        """
        law = system if self._given is None else self._given
        law = with_missing(law, effects_of(system)).double()
        return self._likeliest(system, *self._by_regression(law))

    def _by_regression(self, system: System) -> list[System]:
        """A further start, see :meth:`regression_start`; none for networks, where a regression on
        60 parameters takes minutes."""
        assert isinstance(system, Crowd)
        return [] if system.law_formula is None else [self.regression_start(system)]

    def _likeliest(self, *starts: System) -> CrowdPopulation:
        """The estimate that is converged from the start that is likeliest after one alternation.

        Costs from different starts cannot be compared: a search is whitened by its first
        simulation, and where parameters make people collide, windows are left out that others
        explain.
        """
        populations = list[CrowdPopulation]()
        for start in starts:
            with suppress(SimulationError, np.linalg.LinAlgError):
                populations.append(self._first(start))
        if not populations:
            raise SimulationError("the paths of people diverge from all starts")
        return self._converged(max(populations, key=lambda population: population.criterion))

    def _first(self, system: System) -> CrowdPopulation:
        """The estimate after one alternation. It starts from usual variances: those of a model that
        lacks a strong effect would hide it."""
        engine = copy.copy(self)
        engine.population = None
        fitted = refine(engine, copy.deepcopy(system), tolerance=ROUGH_COST).system
        engine.fit_whitening(fitted, ParameterVector(fitted).row)
        assert engine.population is not None
        return engine.population

    def _converged(self, start: CrowdPopulation) -> CrowdPopulation:
        """The likeliest estimate of further alternations."""
        engine, best = copy.copy(self), start
        engine.set_population(start)
        for _ in range(ALTERNATIONS):
            assert engine.population is not None
            fitted = refine(engine, copy.deepcopy(engine.population.system)).system
            engine.fit_whitening(fitted, ParameterVector(fitted).row)
            risen = engine.population.criterion - best.criterion
            if risen > 0:
                best = engine.population
            if risen < ROUGH:
                break
        return best

    def variations(self) -> dict[str, dict[str, Any]]:
        """The variances over time and between people, see
        :func:`nnode.population.intervals.variation_rows`. They are not corrected for a bias."""
        assert self.population is not None
        return self._people.variations(self.population)

    def reselected(self, population: CrowdPopulation) -> CrowdPopulation:
        """The same: all quantities differ that may differ."""
        return population

    def with_usual_variances(self, system: System) -> CrowdEngine:
        """An engine with the variances where searches start. The variances of a model that lacks a
        strong effect attribute it to pushes, and would hide where it acts."""
        engine = copy.copy(self)
        engine.set_population(self._people.usual(system, self.population))
        return engine

    def regression_start(self, system: System) -> System:
        """A copy whose parameters are fitted to the accelerations of the smoothed paths by
        regression, which avoids distant local minima of calibrations."""
        fitted, batch = copy.deepcopy(system), self.windows.batch
        vector, around = ParameterVector(fitted), self._people.around(system, self._simulated)
        states = torch.cat([batch.x, batch.v], -1)[::2]
        moment = 2 * np.arange(len(states))
        measured = torch.gradient(batch.v[::2], spacing=self.windows.step, dim=0)[0]
        window, person = around.window, around.person

        def missed(row: np.ndarray) -> np.ndarray:
            rate = PersonAlone(around, fitted, vector.runs(row[None]))(moment, states)
            misfit: np.ndarray = (measured - rate)[:, window, person].numpy().ravel()
            return np.nan_to_num(misfit, nan=1e3, posinf=1e3, neginf=-1e3)

        low, high = vector.bounds
        start = np.clip(vector.row.numpy(), low, high)
        best = least_squares(missed, start, bounds=(low, high), loss="soft_l1", max_nfev=50)
        return vector.fill_(best.x)

    def log_likelihoods(self, *starts: System) -> tuple[np.ndarray, System]:
        """``(G,)`` log marginal likelihoods of the clusters under a law with parameters, desired
        velocities and variances of its own, minus their share of the number of parameters times
        half the logarithm of the number of people (BIC); and the calibrated law.

        Args:
            starts: the law with different parameters, from each of which it is calibrated, and
                from a regression if it is a formula.

        Raises:
            SimulationError: the simulations of all starts diverge.
        """
        laws = [start.double() for start in starts]
        best = self._likeliest(*laws, *self._by_regression(laws[0]))
        of_people = self._label[[b for b, _ in self._people.pairs]]
        cluster = np.unique(of_people, return_inverse=True)[1].reshape(-1)
        values = np.bincount(cluster, best.each)
        return values - best.price / len(values), best.system

    def simulated_engines(self, system: System, row: Tensor, seed: int) -> list[CrowdEngine]:
        """Engines of crowds that a model simulates, with the variances of this one: an antithetic
        pair of draws.

        Args:
            seed: of the draws.

        Raises:
            SimulationError: the simulation diverges.
        """
        model, used = with_parameters(system, row), self.windows.used
        variances = self._fitted(system, row).variances
        preferred = {i: self.windows.preferred[i].copy() for i in used}
        people = self._simulated
        for (b, i), speed in zip(self._people.pairs, people.speed, strict=True):
            preferred[b][i] *= speed / max(float(np.hypot(*preferred[b][i])), 1e-9)
        measured = [replace(self.sequences[i], preferred=preferred[i]) for i in used]
        engines = []
        for crowd in simulated_pair(model, measured, people, seed):
            if not all(np.isfinite(s.x).all() for s in crowd):
                raise SimulationError("the simulated crowd diverges")
            sequences = list(self.sequences)
            for i, s in zip(used, crowd, strict=True):
                sequences[i] = s
            engine = CrowdEngine(sequences, self._seconds, self._label, self._people.gait)
            engine.batch = self.batch  # effects are looked for at the same places
            engine.set_population(engine._people.estimated(model, None, variances))
            engines.append(engine)
        return engines

    def biases(self, system: System, row: Tensor, seed: int) -> np.ndarray:
        """``(R, K)`` biases of a model's parameters, of each antithetic pair: the Gauss-Newton step
        from the parameters that crowds were simulated with.

        Raises:
            SimulationError: the simulation diverges.
        """
        pairs = []
        for k in range(PAIRS):
            steps = []
            for engine in self.simulated_engines(system, row, seed + k):
                tangents = engine.tangents(system, row).numpy().T
                residual = engine.residuals(system, row[None])[0].numpy()
                steps.append(np.linalg.lstsq(tangents, -residual, rcond=1e-9)[0])
            pairs.append(np.mean(steps, 0))
        return np.array(pairs)

    # -- linear response ----------------------------------------------------------------------

    def tangents(self, system: System, row: Tensor) -> Tensor:
        """``(K, n)``: derivatives of the residuals with respect to the calibrated parameters, by
        linear response."""
        run = self._run_of(system, row)
        return self._responses(run, run.parameters(differences_of(system)))

    def response(
        self, system: System, row: Tensor, rates: Callable[[State], list[Tensor]]
    ) -> Tensor:
        """``(M, n)``: changes of the residuals by M weak additional accelerations, each a function
        of the states, ``(B, N, 2)`` m/s²."""
        run = self._run_of(system, row)
        with torch.no_grad():
            return self._responses(run, rates(run.state))

    def screen_columns(
        self, system: System, row: Tensor, effect: type[Effect], *probes: Probe
    ) -> Tensor:
        """``(S, n)``: derivatives of the residuals with respect to the strengths of one probe after
        the other, in the order of ``steps``; the change by the effect as a whole where it has no
        strength."""

        def rates(state: State) -> list[Tensor]:
            changes = []
            for probe in probes:
                base = effect(**probe.options)(state)
                for name, step in probe.steps.items():
                    changed = effect(**probe.options)
                    getattr(changed, name).add_(step)
                    changes.append((changed(state) - base) / step)
                if not probe.steps:
                    changes.append(base)
            return changes

        return self.response(system, row, rates)

    def individual(
        self, system: System, row: Tensor, effect: type[IndividualEffect], options: dict[str, Any]
    ) -> Tensor:
        """``(M, n)``: derivatives of every person's residuals by M agent-specific parameters,
        see :meth:`~nnode.model.effects.IndividualEffect.directions`.

        As people walk alone, the derivative with respect to one person's amount is the same
        column, restricted to the residuals of this unit.
        """
        names, n_agents = set(self.batch.names), self.windows.batch.x.shape[2]

        def rates(state: State) -> list[Tensor]:
            return [
                effect(people={name: [number] * n_agents for name in names}, **values)(state)
                for values, number in effect.directions(options)
            ]

        return self.response(system, row, rates)

    # -- parts -----------------------------------------------------------------------------

    @property
    def _simulated(self) -> Individuals:
        """The D simulated people."""
        return self._people.measured if self.population is None else self.population.people

    def _fitted(self, system: System, row: Tensor) -> CrowdPopulation:
        """The last estimate; at first that with usual variances. Those of a model that is not yet
        calibrated would attribute its errors to pushes, and no parameters would be better."""
        if self.population is None:
            self.set_population(self._people.usual(with_parameters(system, row)))
        assert self.population is not None
        return self.population

    def _states(self, system: System, rows: Tensor) -> Tensor:
        """``(F, R, W, N, 4)`` simulated states."""
        return self._people.states(system, rows, self._simulated)

    def _errors(self, system: System, row: Tensor) -> np.ndarray:
        """``(P, L, 2)`` m: measured minus simulated positions, with the most likely deviations."""
        people, population = self._people, self._fitted(system, row)
        difference = people.differences(self._states(system, row[None]))
        joined = people.continued(difference, population.continuation)[..., 0]
        residual = joined + population.by_own(population.data.fixed)
        data = replace(population.data, residual=residual)
        posterior = people.posterior(data, population.random, population.variances)
        # of windows by themselves; where paths are chaotic, nothing is known of the deviations
        by_deviation = np.where(data.observed[..., None], population.by_deviation, 0.0)
        deviations = (posterior.change + posterior.deviations)[:, None]
        explained = (by_deviation * deviations).sum(-1) - population.by_own(by_deviation)
        errors = people.parted(people.joined(difference.position)[..., 0] - explained)
        return errors.reshape(len(errors), -1, 2)

    def _whitened(self, columns: np.ndarray) -> Tensor:
        """``(C, n)`` of columns ``(D, K, C)``."""
        white = self._people.parted(self._whitening(columns))
        flat = white.reshape(-1, white.shape[-1])
        return torch.from_numpy(flat - self._common @ (self._common.T @ flat)).T

    def _run_of(self, system: System, row: Tensor) -> RunAlone:
        """A run of a model; the last one is cached."""
        self._fitted(system, row)
        if self._run is None or self._run[0] is not system or not torch.equal(self._run[1], row):
            states = self._states(system, row[None])[:, 0]
            around = self._people.around(system, self._simulated)
            self._run = system, row.clone(), RunAlone(around, with_parameters(system, row), states)
        return self._run[-1]

    def _responses(self, run: RunAlone, fields: list[Tensor]) -> Tensor:
        """``(C, n)`` changes of the residuals by accelerations of the people."""
        parts = []
        for first in range(0, len(fields), COLUMNS):
            moved = self._people.change(run.displacements(fields[first : first + COLUMNS]))
            assert self.population is not None
            joined = self._people.continued(moved, self.population.continuation)
            parts.append(self._whitened(-joined))
        return torch.cat(parts) if parts else torch.zeros(0, len(self.unit), dtype=torch.float64)
