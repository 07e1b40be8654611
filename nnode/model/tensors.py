"""The right-hand side of a lane, from its formula, with PyTorch."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from nnode.model.arrays import Code, computed
from nnode.model.expression import Expr, topological
from nnode.model.lane_dynamics import LaneDynamics

#: Gap that stands in for that of vehicles behind nobody, m.
SAFE = 20.0


class LaneRates:
    """The right-hand side of a lane, from its formula.

    Args:
        lane: flat.
    """

    def __init__(self, lane: LaneDynamics) -> None:
        self.lane, self.states = lane, list(lane.rates)
        self.outputs = list(lane.rates.values())
        parts = topological(self.outputs)
        #: nodes that depend on the speed of the vehicle ahead, each after what it is made of
        chain: dict[Expr, None] = {}
        for part in parts:
            if part.value in lane.chained.values() or any(a in chain for a in part.args):
                chain[part] = None
        outside = {a for part in chain for a in part.args if a not in chain}
        #: and those that they need, which are computed for all vehicles at once
        self.ready = [*topological(outside), *(o for o in self.outputs if o not in chain)]
        self.chain = bool(chain)

    def __call__(
        self,
        y: Tensor,
        values: Mapping[str, Tensor],
        follower: Tensor,
        leader: Tensor,
        lead: Tensor | None,
        code: Mapping[str, Code] | None = None,
    ) -> Tensor:
        """``(B, N, M)`` rates of the states.

        Args:
            y: ``(B, N, M)`` states.
            values: parameters as scalars, ``t``, and inputs ``(B, N)`` by their symbols.
            follower: ``(B, N)`` True for vehicles behind another one.
            leader: ``(B, N)`` True for those in front.
            lead: ``(B, N)`` measured speeds of leaders; None: the formula tells them.
            code: what calls stand for.
        """
        own = {s: y[..., i] for i, s in enumerate(self.states)}
        second = follower & torch.cat([follower[:, 1:], torch.zeros_like(follower[:, :1])], 1)
        given = {**values, **own, "second": second.to(y.dtype)}
        for s, j in self.lane.ahead:
            before, here = own[s] if j == 1 else given[f"{s}_1"], follower if j == 1 else second
            away = own[s] + (SAFE if s == "x" else 0.0) if j == 1 else before
            if j == 2 and s == "x":
                away = before + SAFE
            shifted = torch.cat([own[s][:, j:], own[s][:, -1:].expand(-1, j)], 1)
            given[f"{s}_{j}"] = torch.where(here, shifted, away)
        speed = lead
        if speed is None:
            speed = computed([self.lane.leader], given, code=code)[0].expand_as(y[..., 0])
        speed = torch.where(leader, speed, 0.0)
        if self.chain:
            found = self._behind_each_other(given, follower, speed, code)
        else:
            found = [
                torch.where(follower, r, 0.0) for r in computed(self.outputs, given, code=code)
            ]
            found[0] = torch.where(follower, found[0], speed)
        return torch.stack(found, -1)

    def _behind_each_other(
        self,
        given: dict[str, Tensor],
        follower: Tensor,
        speed: Tensor,
        code: Mapping[str, Code] | None,
    ) -> list[Tensor]:
        """Rates where each one's depends on that of the vehicle ahead."""
        known = zip(self.ready, computed(self.ready, given, code=code), strict=True)
        wide = {part: value.expand_as(follower) for part, value in known}
        ahead = speed[:, -1]
        rows: list[list[Tensor]] = []
        for i in range(follower.shape[1] - 1, -1, -1):
            here = {part: value[:, i] for part, value in wide.items()}
            out = computed(self.outputs, {"dx_1": ahead}, here, code)
            follows = follower[:, i]
            row = [torch.where(follows, r, 0.0) for r in out]
            row[0] = ahead = torch.where(follows, row[0], speed[:, i])
            rows.append(row)
        return [torch.stack([row[c] for row in rows[::-1]], 1) for c in range(len(self.states))]
