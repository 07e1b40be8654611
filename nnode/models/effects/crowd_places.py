"""Effects of places on people: walls, and obstacles or attractions that nobody told of."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.models.crowd import dot, norm
from nnode.models.effects.base import CATALOGUE, Effect, Probe, Setting, Strength
from nnode.models.effects.crowd_pairs import radius
from nnode.models.system import System
from nnode.models.term import Interval, State

#: Places are looked for this far apart, m, but in no more than this many cells.
SPACING, CELLS = 0.8, 170
#: Distance at which an absent wall stands, m.
FAR = 1e4


def wall_distance(x: Tensor, segment: Tensor) -> tuple[Tensor, Tensor]:
    """Distance and direction to the nearest point of each wall.

    Args:
        x: ``(B, N, 2)`` m.
        segment: ``(B, W, 4)`` m, NaN where a sequence has fewer walls.

    Returns:
        ``(B, N, W)`` m, ``FAR`` for absent walls; unit vectors from the wall ``(B, N, W, 2)``.
    """
    real = ~segment.isnan().any(-1)
    ends = torch.where(real[..., None], segment, 0.0)[:, None]
    start, along = ends[..., :2], ends[..., 2:] - ends[..., :2]
    offset = x[:, :, None] - start
    length2 = dot(along, along).clamp(min=1e-12)
    share = (dot(offset, along) / length2).clamp(0, 1)
    away = offset - share[..., None] * along
    d = norm(away)
    absent = ~real[:, None]
    return torch.where(absent, FAR, d), away / d[..., None]


@CATALOGUE.add
class WallRepulsion(Effect):
    """People keep away from walls, beyond what the base law has.

    d_w and n_w: distance and direction from the nearest point of wall w, r the radius.
    """

    name = "wall_repulsion"
    formula = "sum over walls w of A_w exp((r - d_w)/B_w) n_w"
    source = "Helbing & Molnár 1995"
    domain = "crowd"
    strengths = {"A_w": Strength(0.0, 0.05, Interval(-0.5, 20.0), "m/s²", usual=0.2)}
    settings = {"B_w": Setting(0.4, Interval(0.05, 2.0), "m")}
    separated_by = "people at different distances from walls on both sides"

    A_w: Tensor
    B_w: Tensor

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        if batch.walls.isnan().any(-1).all():
            return []
        return [Probe({"B_w": reach}, {"A_w": 0.05}) for reach in (0.2, 0.4, 0.8)]

    def forward(self, state: State) -> Tensor:
        if not state.scene.segment.shape[1]:
            return torch.zeros_like(state.x)
        d, n = wall_distance(state.x, state.scene.segment)
        push = self.A_w * torch.exp((radius(state.system) - d) / self.B_w)
        return (push[..., None] * n).sum(2)


def places(batch: Batch) -> list[tuple[float, float]]:
    """Middles of the cells of a coarse grid in which somebody walks, or that touch one."""
    real = batch.valid & batch.agent
    walked = batch.x[real].reshape(-1, 2).cpu().numpy()
    spacing = SPACING
    while True:
        cells = np.unique(np.floor(walked / spacing).astype(int), axis=0)
        around = {(i + a, j + b) for i, j in cells for a in (-1, 0, 1) for b in (-1, 0, 1)}
        if len(around) <= CELLS:
            return [((i + 0.5) * spacing, (j + 0.5) * spacing) for i, j in sorted(around)]
        spacing *= 1.25


class PlaceEffect(Effect):
    """A force from or towards an unknown place."""

    domain = "crowd"
    strengths = {"A_o": Strength(0.0, 0.05, Interval(0.0, 20.0), "m/s²", usual=0.2)}
    settings = {
        "B_o": Setting(0.8, Interval(0.1, 5.0), "m"),
        "x_o": Setting(0.0, Interval(), "m"),
        "y_o": Setting(0.0, Interval(), "m"),
    }
    kin = "place"
    separated_by = "people who pass the place on all sides"

    #: +1 away from the place, -1 towards it
    sign = 1.0
    A_o: Tensor
    B_o: Tensor
    x_o: Tensor
    y_o: Tensor

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        return [
            Probe({"x_o": x, "y_o": y, "B_o": reach}, {"A_o": 0.05})
            for reach in (0.6, 1.5)
            for x, y in places(batch)
        ]

    def forward(self, state: State) -> Tensor:
        offset = state.x - torch.stack([self.x_o, self.y_o])
        d = norm(offset)
        push = self.sign * self.A_o * torch.exp(-d / self.B_o) / d
        return push[..., None] * offset


@CATALOGUE.add
class Obstacle(PlaceEffect):
    """People keep away from an unknown place."""

    name = "obstacle"
    formula = "A_o exp(-d/B_o) n, d and n: distance and direction from (x_o, y_o)"
    source = "Helbing & Molnár 1995 (repulsion from obstacles)"


@CATALOGUE.add
class Attraction(PlaceEffect):
    """People are drawn to an unknown place."""

    name = "attraction"
    formula = "-A_o exp(-d/B_o) n, d and n: distance and direction from (x_o, y_o)"
    source = "Helbing & Molnár 1995 (attractive places)"
    sign = -1.0
