"""What a diagnosis hands on to those who report it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nnode.data.sequence import Sequence
from nnode.discover.result import Diagnosis
from nnode.model import System


@dataclass
class Simulation:
    """A sequence and the simulation that its mean square error is computed from.

    Attributes:
        sequence: at the times at which positions are compared.
        x: ``(K, N, D)`` simulated positions, m. NaN: given to the simulation, as a leader is.
        restart: samples after which the simulation starts again from the measurement; None: it
            runs through.
        skip: samples at the start of the simulation that are given and not compared.
    """

    sequence: Sequence
    x: np.ndarray
    restart: int | None = None
    skip: int = 0


@dataclass
class Found:
    """A diagnosis and the models that it is about.

    Attributes:
        diagnosis: in plain types.
        base: the model as it was given, calibrated on the open sequences.
        extended: the same with the accepted effects, calibrated together; without any it may
            be ``base`` itself.
        searched: with all effects that the open clusters asked for, before the sealed ones were
            looked at.
        open, sealed: positions of the sequences that were used, and of those kept for the end.
        maps: ``before`` and ``after``: :class:`nnode.discover.report.deviation.Deviation` of
            ``base`` and ``extended``, where the diagnosis has them; they are computed where it has
            not.
        simulated: of each entry of ``diagnosis.sealed`` the simulations whose errors it holds,
            with ``base`` and with ``extended``; None where nothing of the sequence is compared.
    """

    diagnosis: Diagnosis
    base: System
    extended: System
    searched: System
    open: list[int]
    sealed: list[int]
    maps: dict[str, Any] = field(default_factory=dict)
    simulated: list[tuple[Simulation | None, Simulation | None]] = field(default_factory=list)
