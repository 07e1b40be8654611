"""First-order follow-the-leader laws: speed as a function of the gap to the vehicle ahead."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nnode.model.expression import call, symbol
from nnode.model.formula import Law, parameters_of, rule_of
from nnode.model.lane_dynamics import LaneDynamics, Rule, base_dynamics, of_rule
from nnode.model.network import FeedForward
from nnode.model.tensors import Code
from nnode.model.term import Interval, State

#: Log is evaluated at this gap (m) where a simulated gap is smaller: its logarithm must exist.
SMALLEST_GAP = 1e-3


class FollowTheLeader(Law):
    """Speed W(gap) of every follower; the leader drives at v0.

    dx_i/dt = W(x_{i+1} - x_i) for followers, dx_N/dt = v0. Every law of this family owns
    ``v0`` (m/s), the speed of the leading vehicle.

    Source: Göttlich & Totzeck, equations (LWR) and (NNvelo).
    """

    def __init__(self, v0: float) -> None:
        super().__init__()
        self.declare("v0", v0, unit="m/s")
        self.v0: Tensor

    @property
    def has_formula(self) -> bool:
        own = type(self)
        coded = own.speed is not FollowTheLeader.speed and own.forward is FollowTheLeader.forward
        return rule_of(self) is not None or coded

    def code(self) -> dict[str, Code]:
        return {} if rule_of(self) is not None else {"speed": self.speed}

    def lane(self, owner: str) -> LaneDynamics:
        rule = rule_of(self)
        if rule is None:  # the speed is code: a formula can call it
            leader, rate = symbol(f"{owner}__v0"), call("speed", symbol("gap"))
            v0 = {f"{owner}__v0": ("terms.0.v0", 0, None)}
            return base_dynamics(owner, rate, 1, leader, v0, {f"{owner}__v0": "m/s"})
        parameters, owned, units = parameters_of(self, owner, 0)
        return of_rule(owner, rule, 1, parameters, symbol(f"{owner}__v0"), owned, units)

    def speed(self, gap: Tensor) -> Tensor:
        """W: gap in m to speed in m/s, elementwise."""
        return self.evaluated({"gap": gap})

    def forward(self, state: State) -> Tensor:
        x, scene = state.x[..., 0], state.scene
        speed = self.speed(x[:, 1:] - x[:, :-1])
        ahead = torch.cat([speed, speed.new_zeros(len(speed), 1)], 1)
        rate = torch.where(scene.follower, ahead, self.v0 * scene.leader)
        return rate[..., None]


class LighthillWhithamRichards(FollowTheLeader):
    """What the microscopic LWR laws share: the parameters v0 (m/s) and L >= L_min (m)."""

    def __init__(self, v0: float = 30.0, L: float = 5.0, L_min: float = 2.0) -> None:
        super().__init__(v0)
        self.declare("L", L, unit="m", bounds=Interval(low=L_min))
        self.L: Tensor


class Linear(LighthillWhithamRichards):
    """The LWR law with linear velocity, W = v0 (1 - L / gap)."""

    name = "lin"
    formula = "v0 (1 - L / gap)"
    rule = Rule(rate="v0 - v0*L/gap")
    source = "Göttlich & Totzeck, section 5.1.1"


class Logarithmic(LighthillWhithamRichards):
    """The LWR law with logarithmic velocity, W = v0 log(gap / L)."""

    name = "log"
    formula = "v0 log(gap / L)"
    rule = Rule(
        rate="v0*log(max(gap, least)/L)",
        constants={"least": (SMALLEST_GAP, "m")},
    )
    source = "Göttlich & Totzeck, section 5.1.1"


class NetworkSpeed(FollowTheLeader):
    """Speed as a network of the gap (in m, not rescaled), one hidden layer.

    Args:
        hidden: neurons in the hidden layer: 2, 4, 10 for the paper's N2, N4, N10.
        v0: speed of the leading vehicle at the start, m/s.
        box: b keeps every weight in [-b, b]; None leaves them free.
    """

    name = "network_speed"
    formula = "NN(gap)"
    source = "Göttlich & Totzeck, section 5.1.2 and Definition 2"
    rule = Rule(rate="NN(gap)")  # written out by its lane()

    def __init__(
        self,
        hidden: int = 4,
        v0: float = 30.0,
        box: float | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(v0)
        self.network = FeedForward((1, hidden, 1), generator)
        if box is not None:
            self.bound_all("network.", Interval(-box, box))

    @property
    def shape(self) -> tuple[Any, ...]:
        return (*super().shape, self.network.sizes)

    def lane(self, owner: str) -> LaneDynamics:
        """A sum of softplus neurons of the gap."""
        (total,), owned = self.network.written([symbol("gap")], f"{owner}__n", "terms.0.network.")
        units = {**dict.fromkeys(owned, "*"), f"{owner}__v0": "m/s"}
        owned[f"{owner}__v0"] = ("terms.0.v0", 0, None)
        return base_dynamics(owner, total, 1, symbol(f"{owner}__v0"), owned, units)

    def speed(self, gap: Tensor) -> Tensor:
        # layer by layer, not neuron by neuron
        out: Tensor = self.network(gap[..., None])[..., 0]
        return out
