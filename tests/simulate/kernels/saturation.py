"""A law that the package does not know, as a formula."""

from __future__ import annotations

from torch import Tensor

from nnode.model.lane_dynamics import Rule
from nnode.model.traffic import FollowTheLeader


class Saturation(FollowTheLeader):
    """W = v0 (1 - exp(-gap / reach))."""

    name = "saturation"
    formula = "v0 (1 - exp(-gap / reach))"
    rule = Rule(rate="v0*(1 - exp(-gap/reach))")
    source = "none"

    def __init__(self, v0: float = 20.0, reach: float = 12.0) -> None:
        super().__init__(v0)
        self.declare("reach", reach, unit="m")
        self.reach: Tensor
