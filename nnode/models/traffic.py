"""First-order follow-the-leader laws: speed as a function of the gap to the vehicle ahead."""

from __future__ import annotations

import torch
from torch import Tensor

from nnode.models.network import FeedForward
from nnode.models.term import Interval, State, Term

#: Log is evaluated at this gap (m) where a simulated gap is smaller: its logarithm must exist.
SMALLEST_GAP = 1e-3


class FollowTheLeader(Term):
    """Speed W(gap) of every follower; the leader drives at v0.

    dx_i/dt = W(x_{i+1} - x_i) for followers, dx_N/dt = v0. Every law of this family owns
    ``v0`` (m/s), the speed of the leading vehicle.

    Source: Göttlich & Totzeck, equations (LWR) and (NNvelo).
    """

    def __init__(self, v0: float) -> None:
        super().__init__()
        self.declare("v0", v0, unit="m/s")
        self.v0: Tensor

    def speed(self, gap: Tensor) -> Tensor:
        """W: gap in m to speed in m/s, elementwise."""
        raise NotImplementedError  # pragma: no cover - every law defines its own

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
    source = "Göttlich & Totzeck, section 5.1.1"

    def speed(self, gap: Tensor) -> Tensor:
        return self.v0 - self.v0 * self.L / gap


class Logarithmic(LighthillWhithamRichards):
    """The LWR law with logarithmic velocity, W = v0 log(gap / L)."""

    name = "log"
    formula = "v0 log(gap / L)"
    source = "Göttlich & Totzeck, section 5.1.1"

    def speed(self, gap: Tensor) -> Tensor:
        return self.v0 * torch.log(gap.clamp(min=SMALLEST_GAP) / self.L)


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

    def speed(self, gap: Tensor) -> Tensor:
        out: Tensor = self.network(gap[..., None])[..., 0]
        return out
