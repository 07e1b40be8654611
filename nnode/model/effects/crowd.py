"""Effects on pedestrians, which ``crowd.yaml`` declares, and the code of some of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.model.crowd_formula import norm
from nnode.model.effects.base import Effect, IndividualEffect, Probe, declare_effects
from nnode.model.scene import Scene
from nnode.model.system import System

#: Spacing of the grid of tested places, m, and largest number of its cells.
SPACING, CELLS = 0.8, 170


def heading(v: Tensor) -> Tensor:
    """``(..., 2)``: the walking direction, a unit vector; 0 for a standing person."""
    return v / norm(v)[..., None]


class WalkerHeterogeneity(IndividualEffect):
    """An effect with numbers of at least -1."""

    @classmethod
    def person(cls, numbers: np.ndarray, options: dict[str, Any]) -> float:
        """The number, at least -1. Below -1 a person would move away from the destination."""
        return max(float(numbers[0]), -1.0)


class GroupCohesion(Effect):
    """An effect between the members of social groups."""

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        names = [[name for name in group or () if name] for group in batch.group]
        return any(len(set(group)) < len(group) for group in names)

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        return {"group": scene.companies}


class PreferredSpeed(Effect):
    """A preferred speed, tested at quantiles of the measured speeds."""

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        real = batch.valid[:-1] & batch.valid[1:]
        step = torch.linalg.vector_norm(batch.x[1:] - batch.x[:-1], dim=-1) / batch.dt
        levels = torch.quantile(step[real][:100_000], torch.tensor([0.15, 0.5, 0.85]).to(step))
        return [Probe({"v_pref": min(float(level), 3.0)}, {"c": 0.02}) for level in levels]


class WallRepulsion(Effect):
    """An effect of walls."""

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        return not batch.walls.isnan().any(-1).all()


def places(batch: Batch) -> list[tuple[float, float]]:
    """Centres of the cells of a coarse grid in which people walk, and of their neighbours."""
    real = batch.valid & batch.agent
    walked = batch.x[real].reshape(-1, 2).cpu().numpy()
    spacing = SPACING
    while True:
        cells = np.unique(np.floor(walked / spacing).astype(int), axis=0)
        around = {(i + a, j + b) for i, j in cells for a in (-1, 0, 1) for b in (-1, 0, 1)}
        if len(around) <= CELLS:
            return [((i + 0.5) * spacing, (j + 0.5) * spacing) for i, j in sorted(around)]
        spacing *= 1.25


class Obstacle(Effect):
    """A force from an unknown place."""

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        return [
            Probe({"x_o": x, "y_o": y, "B_o": reach}, {"A_o": 0.05})
            for reach in (0.6, 1.5)
            for x, y in places(batch)
        ]


class Attraction(Obstacle):
    """A force towards an unknown place."""


declare_effects("crowd", "crowd.yaml", globals())
