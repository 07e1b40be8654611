"""The interface between a diagnosis and a domain: the residuals of models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Batch, Sequence
from nnode.diagnosis.outcome import Simulation
from nnode.model.effects import Effect, IndividualEffect, Probe
from nnode.model.system import System
from nnode.model.term import State

if TYPE_CHECKING:
    from nnode.diagnosis.residuals.variables import Variable


@dataclass
class Squares:
    """Squared errors of positions.

    Attributes:
        value: ``(m,)`` m².
        sequence: ``(m,)`` as in :class:`Engine`, of each error.
    """

    value: np.ndarray
    sequence: np.ndarray

    def means(self) -> np.ndarray:
        """``(S,)`` mean square error of each sequence; infinite if its simulation diverges, NaN if
        nothing of it is compared."""
        total = np.bincount(self.sequence, np.nan_to_num(self.value, nan=np.inf))
        number = np.bincount(self.sequence)
        return np.divide(total, number, out=np.full(len(total), np.nan), where=number > 0)


class Engine(Protocol):
    """The residuals of models on some sequences.

    Residuals are whitened differences between measured and simulated positions; the part that
    unknown start states explain is projected out. All models of a diagnosis are compared with the
    same whitening.

    Attributes:
        batch: the sequences, or windows of them with the same names.
        names: of the sequences.
        sequences: as they were given.
        sequence: ``(n,)`` position of each residual's sequence in ``names``.
        cluster: ``(n,)`` number of its cluster: see :mod:`nnode.data.clusters`.
        clock: ``(n,)`` its time in the recording, s.
        component: ``(n,)`` number of the component among the residuals of one time and agent.
        unit: ``(n,)`` number of the unit: agents whose parameters are estimated jointly.
        people: of each unit, per direction the sequence and the place of its agent; one entry if
            all directions belong to one agent.
    """

    batch: Batch
    names: list[str]
    sequences: list[Sequence]
    sequence: np.ndarray
    cluster: np.ndarray
    clock: np.ndarray
    component: np.ndarray
    unit: np.ndarray
    people: list[list[tuple[int, int]]]

    def residuals(self, system: System, rows: Tensor) -> Tensor:
        """``(R, n)`` residuals of R runs of one model; NaN if a run diverges.

        Args:
            system: the model.
            rows: ``(R, K)`` its parameters that are calibrated, see
                :class:`~nnode.calibrate.parameters.ParameterVector`.
        """
        ...

    def tangents(self, system: System, row: Tensor) -> Tensor:
        """``(K, n)`` derivatives of the residuals with respect to the calibrated parameters."""
        ...

    def screen_columns(
        self, system: System, row: Tensor, effect: type[Effect], *probes: Probe
    ) -> Tensor:
        """``(S, n)`` derivatives of the residuals with respect to the strengths of one probe after
        the other; for a probe that varies none, one row with the change by the whole effect."""
        ...

    def response(
        self, system: System, row: Tensor, rates: Callable[[State], list[Tensor]]
    ) -> Tensor:
        """``(M, n)`` derivatives of the residuals with respect to factors of M additional rates
        ``(B, N, D)``, m/s or m/s². The rates are functions of the state, which may stack many
        times like simulations."""
        ...

    def individual(
        self, system: System, row: Tensor, effect: type[IndividualEffect], options: dict[str, Any]
    ) -> Tensor:
        """``(M, n)`` derivatives of the residuals with respect to M amounts of every unit."""
        ...

    def fit_whitening(self, system: System, row: Tensor) -> None:
        """Fit the whitening and the weights to the residuals of a model."""
        ...

    def noise_floor(self) -> float:
        """Mean square error of positions due to measurement noise, m²."""
        ...

    def squares(self, system: System, row: Tensor) -> Squares:
        """Squared errors of positions without whitening, for reports."""
        ...

    def relevant(self, before: System, after: System, square: float) -> bool:
        """Whether an effect changes the simulated paths enough to be named.

        Args:
            before, after: the calibrated models without and with it.
            square: mean square error of positions of the model without any effect, m².
        """
        ...

    def simulated(self, system: System, row: Tensor) -> list[Simulation | None]:
        """The simulations whose errors are :meth:`squares`, of each sequence; None if nothing of it
        is compared. Not for engines with windows in lanes."""
        ...

    def variables(self) -> list[Variable]:
        """The variables on which deviations may depend."""
        ...


@runtime_checkable
class AgentsEngine(Engine, Protocol):
    """An engine whose residuals are whitened by a statistical model of agents who differ.

    Attributes:
        population: the last estimate of this model; None before.
    """

    population: Any

    def population_of(self, system: System) -> Any:
        """The estimate with a model, whose parameters are calibrated with it; the engine keeps its
        own."""
        ...

    def set_population(self, population: Any) -> None:
        """Whiten residuals by an estimate."""
        ...

    def reselected(self, population: Any) -> Any:
        """The estimate after a new selection of what differs between agents."""
        ...

    def with_usual_variances(self, system: System) -> AgentsEngine:
        """An engine with the variances where searches start. The variances of a model that lacks a
        strong effect attribute it to pushes, and would hide where it acts."""
        ...

    def regression_start(self, system: System) -> System:
        """A copy whose law is fitted to the smoothed rates by regression. Calibrations that start
        there avoid distant local minima."""
        ...

    def log_likelihoods(self, *starts: System) -> tuple[np.ndarray, System]:
        """``(G,)`` log marginal likelihoods of the clusters under a law with agents, pushes and
        parameters of its own, minus their share of a price of parameters (BIC); and the calibrated
        law.

        Args:
            starts: the law with different parameters.

        Raises:
            SimulationError: the simulations of all starts diverge.
        """
        ...

    def simulated_engines(self, system: System, row: Tensor, seed: int) -> list[Any]:
        """Engines of paths that a model simulates, with the variances of this one: an antithetic
        pair of draws.

        Raises:
            SimulationError: the simulation diverges.
        """
        ...

    def biases(self, system: System, row: Tensor, seed: int) -> np.ndarray:
        """``(R, K)`` biases of a model's parameters in R antithetic pairs of simulations.

        Raises:
            SimulationError: the simulation diverges.
        """
        ...


def of_residuals(label: np.ndarray | None, sequence: np.ndarray) -> np.ndarray:
    """``(n,)`` labels of the residuals' clusters, counted from 0 without gaps.

    Args:
        label: ``(S,)`` of the sequences; None: every sequence is a cluster.
        sequence: ``(n,)`` of the residuals.
    """
    clusters = sequence if label is None else np.asarray(label)[sequence]
    numbered: np.ndarray = np.unique(clusters, return_inverse=True)[1].reshape(-1)
    return numbered


def square_of(engine: Engine, system: System) -> float:
    """Mean square error of positions, m², with equal weights of sequences."""
    return float(engine.squares(system, ParameterVector(system).row).means().mean())
