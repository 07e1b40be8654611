"""The outcome of a diagnosis: its result, the models and their simulations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nnode.data.sequence import Sequence
from nnode.diagnosis.result import Diagnosis
from nnode.model import System


@dataclass
class Simulation:
    """A sequence and the simulation that its mean square error is computed from.

    Attributes:
        sequence: at the times at which positions are compared.
        x: ``(K, N, D)`` simulated positions, m. NaN: inputs of the simulation, such as a leader.
        restart: number of samples after which the simulation restarts from the measurement; None:
            it never does.
        skip: number of samples at the start that are given and not compared.
    """

    sequence: Sequence
    x: np.ndarray
    restart: int | None = None
    skip: int = 0


@dataclass
class DiagnosisOutcome:
    """A diagnosis and its models.

    Attributes:
        diagnosis: in plain types.
        base: the model as it was given, calibrated on the exploration sequences.
        extended: the same with the confirmed effects, calibrated together; without any it may
            be ``base`` itself.
        searched: with all effects that were selected in the exploration clusters.
        exploration, confirmation: positions of the sequences.
        maps: ``before`` and ``after``: :class:`nnode.diagnosis.report.deviation.Deviation` of
            ``base`` and ``extended``; those that are missing are computed.
        simulated: for each entry of ``diagnosis.confirmation_errors``, the simulations with
            ``base`` and with ``extended`` that its errors are computed from; None if nothing was
            compared.
    """

    diagnosis: Diagnosis
    base: System
    extended: System
    searched: System
    exploration: list[int]
    confirmation: list[int]
    maps: dict[str, Any] = field(default_factory=dict)
    simulated: list[tuple[Simulation | None, Simulation | None]] = field(default_factory=list)
