"""Formulas computed with PyTorch: one operation a node, differentiable as PyTorch is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor
from torch.nn.functional import softplus

from nnode.model.expression import Expr, topological
from nnode.model.lane_dynamics import LaneDynamics

#: Gap that stands in for that of vehicles behind nobody, m.
SAFE = 20.0
Code = Callable[..., Tensor]
#: Functions of a node's arguments, by operation.
OPERATIONS: dict[str, Code] = {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
    "neg": torch.neg,
    "recip": torch.reciprocal,
    "sqrt": torch.sqrt,
    "exp": torch.exp,
    "log": torch.log,
    "tanh": torch.tanh,
    "sin": torch.sin,
    "cos": torch.cos,
    "softplus": softplus,
    "softplus_slope": lambda a: torch.where(a > 20, 1.0, torch.sigmoid(a)),
    "logistic": torch.sigmoid,
    "max": lambda a, b: torch.where((b > a) | (b != b), b, a),
    "min": lambda a, b: torch.where((b < a) | (b != b), b, a),
    "choose": lambda a, b, c: torch.where(a > 0, b, c),
}


def computed(
    outputs: Sequence[Expr],
    values: Mapping[str, Tensor],
    known: dict[Expr, Tensor] | None = None,
    code: Mapping[str, Code] | None = None,
) -> list[Tensor]:
    """Formulas from the values of their symbols.

    Args:
        known: nodes that are computed already; those that are computed now are added.
        code: what calls stand for.
    """
    found: dict[Expr, Tensor] = {} if known is None else known
    like = next(iter(values.values()))
    for node in topological(outputs, dict(found)):
        if node.op == "const":
            found[node] = torch.tensor(node.value, dtype=like.dtype, device=like.device)
        elif node.op == "symbol":
            found[node] = values[node.value]
        elif node.op == "call":
            assert code is not None
            found[node] = code[node.value](*(found[a] for a in node.args))
        else:
            found[node] = OPERATIONS[node.op](*(found[a] for a in node.args))
    return [found[node] for node in outputs]


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
        known: dict[Expr, Tensor] = {}
        computed(self.ready, given, known, code)
        wide = {part: known[part].expand_as(follower) for part in self.ready}
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
