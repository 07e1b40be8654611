"""Effects in a lane, which ``lane.yaml`` declares, and the code of some of them."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import PADDING_GAP, Batch
from nnode.model.effects.base import Effect, IndividualEffect, Probe, declare_effects
from nnode.model.scene import Scene
from nnode.model.system import System, Traffic

#: Number of the cells of a road or a time that are tested one by one.
CELLS = 32
#: Quantiles of the measured speeds that are tested as desired speeds.
SPEEDS = (0.3, 0.7)


def gaps(x: Tensor) -> Tensor:
    """``(B, N)`` gaps to the vehicle ahead, m, of positions ``(B, N, 1)``; the last is padding."""
    gap = torch.diff(x[..., 0])
    return torch.cat([gap, gap.new_full((len(gap), 1), PADDING_GAP)], 1)


class SpeedZone(Effect):
    """A factor on the desired speed in an interval, tested for neighbouring cells."""

    @classmethod
    def span(cls, batch: Batch) -> tuple[float, float]:
        """The interval that the data cover."""
        x = batch.x[..., 0][batch.valid]
        return float(x.min()), float(x.max())

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        low, high = cls.span(batch)
        width = (high - low) / CELLS
        ends = [low + width * i for i in range(CELLS + 1)]
        return [
            Probe({"a": a, "b": b}, {"alpha": size})
            for size in cls._sizes(batch, system)
            for a, b in pairwise(ends)
        ]

    @classmethod
    def _sizes(cls, batch: Batch, system: System) -> list[float]:
        """Amounts by which the factor is varied.

        An acceleration may depend only weakly on a desired speed far above the measured speeds.
        Therefore factors that bring the desired speed to measured speeds are tested as well.
        """
        factor = cls.strengths["alpha"]
        v0 = [value for name, (value, _) in system.physical().items() if name.endswith(".v0")]
        if system.order == 1 or not v0:
            return [factor.step]
        speeds = np.quantile(batch.v[..., 0][batch.valid].numpy(), SPEEDS)
        sizes = [factor.at(float(speed) / float(v0[0]) - 1) - 1 for speed in speeds]
        return [factor.step, *(size for size in sizes if size < 2 * factor.step)]


class SpeedPeriod(SpeedZone):
    """As a zone, with the clock time in place of the position."""

    @classmethod
    def span(cls, batch: Batch) -> tuple[float, float]:
        lasts = (batch.valid.any(-1).sum(0) - 1) * batch.dt
        return float(batch.start.min()), float((batch.start + lasts).max())


class VehicleClass(Effect):
    """An effect on the vehicles of one class.

    Args:
        kind: the class.
    """

    def __init__(self, kind: str = "truck", **values: float) -> None:
        super().__init__(**values)
        self.kind = kind

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        nobody = torch.zeros_like(scene.agent)
        return {"belongs": scene.kinds.get(self.kind, nobody).to(scene.length.dtype)}

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        counts = Counter(name for names in batch.kind for name in names or () if name)
        # the law describes the most frequent class
        return [Probe({"kind": kind}, {"phi": -0.1}) for kind, _ in counts.most_common()[1:]]

    def options(self) -> dict[str, Any]:
        return {"kind": self.kind, **super().options()}


class DriverHeterogeneity(IndividualEffect):
    """A factor on the drivers' paces."""


class LeaderLength(Effect):
    """An effect of the length of the vehicle ahead, less the mean length."""

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        length = scene.length
        longer = torch.where(torch.isfinite(length), length - scene.mean_length, 0.0)
        return {"longer": torch.cat([longer[:, 1:], torch.zeros_like(longer[:, :1])], 1)}

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        lengths = batch.length[torch.isfinite(batch.length)]
        different = lengths.numel() > 1 and float(lengths.std()) > 0.1
        return different and super().applies(batch, system)


class FreeFlowSpeed(Effect):
    """A desired speed, tested at quantiles of the measured speeds."""

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        speeds = batch.v[..., 0][batch.valid]
        levels = np.quantile(speeds.numpy(), [0.4, 0.55, 0.7, 0.8, 0.88, 0.94])
        return [Probe({"v_max": float(v)}, {}) for v in levels if v > 1.0]


class LeaderSpeed(Effect):
    """An effect on leaders that drive by the law."""

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        return isinstance(system, Traffic) and not system.leader_measured


class TimeGap(Effect):
    """An effect on the spacing of laws that have the parameter L."""

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        return system.find_law("lin", "log") is not None


declare_effects("traffic", "lane.yaml", globals())
