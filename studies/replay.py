"""A study's player: some of its sequences beside calibrated models."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch

from nnode.data.sequence import Sequence, collate
from nnode.errors import SimulationError
from nnode.model.system import System
from nnode.pages.replay import Scene
from nnode.simulation.fused import FusedSolver


def scenes(
    sequences: Iterable[Sequence], systems: Mapping[str, System], dt: float | None = None
) -> list[Scene]:
    """Sequences as measured and as models simulate them; nobody is there once a model blows up.

    Args:
        systems: models by title.
        dt: step, s; by default the domain's.
    """
    solver = FusedSolver(dt)
    return [
        Scene(s, {title: _simulated(system, s, solver) for title, system in systems.items()})
        for s in sequences
    ]


@torch.no_grad()
def _simulated(system: System, s: Sequence, solver: FusedSolver) -> np.ndarray:
    try:
        return solver(system.double(), collate([s])).x[:, 0].numpy()
    except SimulationError:
        return np.concatenate([s.x[:1], np.full_like(s.x[1:], np.nan)])
