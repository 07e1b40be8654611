"""What a diagnosis needs to know of a domain: how a model's residuals come about."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Batch, Sequence
from nnode.discover.outcome import Simulation
from nnode.model.effects import Effect, IndividualEffect, Probe
from nnode.model.system import System
from nnode.model.term import State

if TYPE_CHECKING:
    from nnode.discover.residuals.variables import Variable


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
        """``(S,)`` mean square error of each sequence; infinite where it blows up, NaN where
        nothing of it is compared."""
        total = np.bincount(self.sequence, np.nan_to_num(self.value, nan=np.inf))
        number = np.bincount(self.sequence)
        return np.divide(total, number, out=np.full(len(total), np.nan), where=number > 0)


class Engine(Protocol):
    """The residuals of models on some sequences.

    A residual is a number that is zero where simulation and measurement agree: positions that
    differ, in m, without what unknown start states explain, and whitened as far as a filter of
    the residuals allows it. All models of a diagnosis are compared in the same residuals.

    Attributes:
        batch: the sequences, or windows of them that bear their names.
        names: of the sequences.
        sequences: as they were given.
        sequence: ``(n,)`` position of each residual's sequence in ``names``.
        cluster: ``(n,)`` number of its cluster: see :mod:`nnode.data.clusters`.
        clock: ``(n,)`` its time in the recording, s.
        component: ``(n,)`` residuals of one time and agent that have different numbers mean
            different things.
        unit: ``(n,)`` number of the agents whose own numbers are estimated together.
        people: of each unit, per direction the sequence and the place of the agent it belongs
            to; one entry where all directions belong to one agent.
        least: share of the squared errors below which nothing is worth a name; none where tests
            themselves ask for more than the least size that is of interest.
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
    least: float

    def residuals(self, system: System, rows: Tensor) -> Tensor:
        """``(R, n)`` residuals of R runs of one model; NaN where a run blows up.

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
        self, system: System, row: Tensor, effect: type[Effect], probe: Probe
    ) -> Tensor:
        """``(S, n)`` derivatives of the residuals with respect to the strengths of a probe; one
        row for the effect as a whole where the probe varies none."""
        ...

    def response(
        self, system: System, row: Tensor, rates: Callable[[State], list[Tensor]]
    ) -> Tensor:
        """``(M, n)`` derivatives of the residuals with respect to factors of M further rates
        ``(B, N, D)``, m/s or m/s², that are functions of the state; it may be of many times, each
        as a simulation."""
        ...

    def individual(
        self, system: System, row: Tensor, effect: type[IndividualEffect], options: dict[str, Any]
    ) -> Tensor:
        """``(M, n)`` derivatives of the residuals with respect to M amounts of every unit."""
        ...

    def fit_whitening(self, system: System, row: Tensor) -> None:
        """Fit what the residuals are whitened and weighted with to what a model leaves."""
        ...

    def noise_floor(self) -> float:
        """Mean square error of positions that is noise of the measurement, m²."""
        ...

    def squares(self, system: System, row: Tensor) -> Squares:
        """Squared errors of positions as they are, for the costs that are reported."""
        ...

    def simulated(self, system: System, row: Tensor) -> list[Simulation | None]:
        """The simulations whose errors are :meth:`squares`, of each sequence; None where nothing
        of it is compared. Of engines that compare whole sequences, and of those of people."""
        ...

    def variables(self) -> list[Variable]:
        """What deviations may depend on."""
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
    """Mean square error of positions, m², every sequence alike."""
    return float(engine.squares(system, ParameterVector(system).row).means().mean())
