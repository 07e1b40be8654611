"""A law that the package does not know, and what the fused solver has to be told about it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from nnode.models.traffic import FollowTheLeader
from nnode.solvers.fused._math import exp, real


class Saturation(FollowTheLeader):
    """W = v0 (1 - exp(-gap / reach))."""

    name = "saturation"
    formula = "v0 (1 - exp(-gap / reach))"
    source = "none"

    def __init__(self, v0: float = 20.0, reach: float = 12.0) -> None:
        super().__init__(v0)
        self.declare("reach", reach, unit="m")
        self.reach: Tensor

    def speed(self, gap: Tensor) -> Tensor:
        return self.v0 * (1 - torch.exp(-gap / self.reach))


def share(gap: Any, v0: Any, reach: Any) -> Any:
    return v0 * (real(1, gap) - exp(-gap / reach))


def pull(gap: Any, weight: Any, v0: Any, reach: Any) -> Any:
    left = exp(-gap / reach)
    slope = weight * v0 * left / reach
    return slope, weight * (real(1, gap) - left), -slope * gap / reach


def pack(parameters: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    v0 = parameters["v0"]
    return torch.zeros_like(v0), torch.stack([v0, parameters["reach"]], -1)[:, None]
