"""Effects of places on people: walls, and obstacles or attractions that nobody told of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.model.crowd_dynamics import CrowdRule
from nnode.model.effects.base import CATALOGUE, Effect, Probe, Setting, Strength
from nnode.model.system import System
from nnode.model.term import Interval

#: Places are looked for this far apart, m, but in no more than this many cells.
SPACING, CELLS = 0.8, 170


@CATALOGUE.add
class WallRepulsion(Effect):
    """People keep away from walls, beyond what the base law has.

    d_w and n_w: distance and direction from the nearest point of wall w, r the radius.
    """

    name = "wall_repulsion"
    formula = "sum over walls w of A_w exp((r - d_w)/B_w) n_w"
    rule = CrowdRule(
        rate=("away_x", "away_y"),
        walls={"away_x": ("m/s²", "push*off_x"), "away_y": ("m/s²", "push*off_y")},
        where={
            "long": "max(along_x**2 + along_y**2, least**2)",
            "share": "clip((dx*along_x + dy*along_y)/long, 0, 1)",
            "off_x": "dx - share*along_x",
            "off_y": "dy - share*along_y",
            "far": "sqrt(off_x**2 + off_y**2 + small_m**2)",
            "push": "A_w*exp((r - far)/B_w)/far",
        },
        constants={"least": (1e-6, "m")},
    )
    source = "Helbing & Molnár 1995"
    domain = "crowd"
    strengths = {"A_w": Strength(0.0, 0.05, Interval(-0.5, 20.0), "m/s²", min_effect_size=0.2)}
    settings = {"B_w": Setting(0.4, Interval(0.05, 2.0), "m")}
    distinguishing_data = "people at different distances from walls on both sides"

    A_w: Tensor
    B_w: Tensor

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        if batch.walls.isnan().any(-1).all():
            return []
        return [Probe({"B_w": reach}, {"A_w": 0.05}) for reach in (0.2, 0.4, 0.8)]


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


_PLACE = CrowdRule(
    rate=("push*to_x", "push*to_y"),
    where={
        "to_x": "x - x_o",
        "to_y": "y - y_o",
        "far": "sqrt(to_x**2 + to_y**2 + small_m**2)",
        "push": "A_o*exp(-far/B_o)/far",
    },
)


class PlaceEffect(Effect):
    """A force from or towards an unknown place."""

    domain = "crowd"
    strengths = {"A_o": Strength(0.0, 0.05, Interval(0.0, 20.0), "m/s²", min_effect_size=0.2)}
    settings = {
        "B_o": Setting(0.8, Interval(0.1, 5.0), "m"),
        "x_o": Setting(0.0, Interval(), "m"),
        "y_o": Setting(0.0, Interval(), "m"),
    }
    confusable_group = "place"
    distinguishing_data = "people who pass the place on all sides"

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


@CATALOGUE.add
class Obstacle(PlaceEffect):
    """People keep away from an unknown place."""

    name = "obstacle"
    rule = _PLACE
    formula = "A_o exp(-d/B_o) n, d and n: distance and direction from (x_o, y_o)"
    source = "Helbing & Molnár 1995 (repulsion from obstacles)"


@CATALOGUE.add
class Attraction(PlaceEffect):
    """People are drawn to an unknown place."""

    name = "attraction"
    rule = replace(_PLACE, rate=("-push*to_x", "-push*to_y"))
    formula = "-A_o exp(-d/B_o) n, d and n: distance and direction from (x_o, y_o)"
    source = "Helbing & Molnár 1995 (attractive places)"
