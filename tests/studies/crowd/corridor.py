"""People in a corridor, simulated with known forces by another solver than the study's."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from nnode.data.sequence import Batch, Sequence, collate
from nnode.model.system import System
from nnode.simulation.ode import TorchdiffeqSolver
from tests.builders import straight

DT = 0.04


def sequence(rng: np.random.Generator, number: int, samples: int, people: int) -> Sequence:
    """People at random places on straight paths in both directions."""
    x = np.stack([rng.uniform(-2, 2, people), rng.uniform(0.4, 3.6, people)], -1)
    v = np.stack([rng.choice([-1.0, 1.0], people), rng.normal(0, 0.1, people)], -1)
    extra = {
        "start": number,
        "name": f"made/{number:03d}",
        "walls": np.array([[-5.0, 0.0, 5.0, 0.0], [5.0, 4.0, -5.0, 4.0]]),
        "agents": tuple(f"{number}-{i}" for i in range(people)),
        "destination": x + (DT * (samples - 1) + 2) * v,
    }
    return replace(straight(x, v, samples, DT, **extra), v=None)


def walkers(
    seed: int, *, system: System | None = None, samples: int = 16, people: int = 12, number: int = 3
) -> list[Sequence]:
    """Sequences of different numbers of people, on straight paths or simulated by ``system``."""
    rng = np.random.default_rng(seed)
    sequences = [sequence(rng, i, samples, people - i) for i in range(number)]
    if system is None:
        return sequences
    with torch.no_grad():
        run = TorchdiffeqSolver("euler", "discrete")(system, collate(sequences))
    assert run.v is not None
    return [
        replace(s, x=run.x[:, i, : s.n_agents].numpy(), v=run.v[:, i, : s.n_agents].numpy())
        for i, s in enumerate(sequences)
    ]


def corridor(seed: int, **options: Any) -> Batch:
    """The sequences of :func:`walkers` as a batch."""
    return collate(walkers(seed, **options))
