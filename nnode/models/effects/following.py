"""Effects in a lane that tie a vehicle to the speed ahead, or to its own past."""

from __future__ import annotations

import torch
from torch import Tensor

from nnode.data.sequence import PADDING_GAP, Batch
from nnode.models.effects.base import CATALOGUE, Effect, Probe, Strength
from nnode.models.effects.traffic import for_followers, gaps, has_law, law_in, law_of, rate_of
from nnode.models.system import System
from nnode.models.term import Interval, State

_KIN = "reaction to the vehicle ahead"
_EXCITATION = "leaders that brake and accelerate strongly, measured often and precisely"


def speeds_of_law(x: Tensor, v: Tensor, system: System) -> Tensor:
    """``(B, N)`` speeds at the start as the law says, m/s; a leader's is measured.

    Measured speeds of followers would tell of disturbances that go on for a while, and a memory
    that starts with them would be taken for inertia.
    """
    law, gap = law_in(system), gaps(x)
    # nobody, or a vehicle of the padding, is ahead of a leader
    return torch.where(gap > PADDING_GAP / 2, v[..., 0], law.speed(gap))


class _SpeedAhead(Effect):
    """Effects of the difference between the speed ahead and what the law says."""

    def _change(self, difference: Tensor) -> Tensor:
        raise NotImplementedError  # pragma: no cover - both define their own

    def forward(self, state: State) -> Tensor:
        rate, follower = rate_of(state), state.scene.follower
        speed, found = rate[:, -1], [rate[:, -1]]
        for i in range(rate.shape[1] - 2, -1, -1):
            own = rate[:, i] + self._change(speed - rate[:, i])
            speed = torch.where(follower[:, i], own, rate[:, i])
            found.append(speed)
        return for_followers(state, torch.stack(found[::-1], 1) - rate)


@CATALOGUE.add
class RelativeSpeed(_SpeedAhead):
    """Drivers react to the difference of speeds."""

    kappa: Tensor
    name = "relative_speed"
    domain = "traffic"
    formula = "W + kappa (ẋ_{i+1} - W)"
    source = "full velocity difference: Jiang, Wu & Zhu 2001"
    strengths = {"kappa": Strength(0.0, 0.05, Interval(-0.9, 0.95), "1", usual=0.2)}
    rank = 50
    kin = _KIN
    separated_by = _EXCITATION

    def _change(self, difference: Tensor) -> Tensor:
        return self.kappa * difference


@CATALOGUE.add
class AsymmetricResponse(_SpeedAhead):
    """Drivers react differently when the gap opens and when it closes."""

    kappa_open: Tensor
    kappa_close: Tensor
    name = "asymmetric_response"
    domain = "traffic"
    formula = "W + kappa_open (ẋ_{i+1} - W)+ - kappa_close (W - ẋ_{i+1})+"
    source = "Gong, Liu & Wang 2008"
    strengths = {
        "kappa_open": Strength(0.0, 0.05, Interval(-0.9, 0.95), "1", usual=0.2),
        "kappa_close": Strength(0.0, 0.05, Interval(-0.9, 0.95), "1", usual=0.2),
    }
    rank = 51
    contains = ("relative_speed",)
    kin = _KIN
    separated_by = _EXCITATION

    def _change(self, difference: Tensor) -> Tensor:
        opening, closing = difference.clamp(min=0), difference.clamp(max=0)
        return self.kappa_open * opening + self.kappa_close * closing


@CATALOGUE.add
class ReactionDelay(Effect):
    """Drivers react to the gap as it was some time ago.

    The delay is a second-order all-pass filter of the gap u (Padé's approximation): with
    z'' T²/12 + z' T/2 + z = u the delayed gap is u - T z'. It is exact to a thousandth of a
    period for oscillations slower than 2 pi T.
    """

    T: Tensor
    name = "reaction_delay"
    domain = "traffic"
    formula = "W(gap(t - T))"
    source = "Newell 1961; Padé's approximation of the delay"
    strengths = {"T": Strength(0.0, 0.3, Interval(0.2, 3.0), "s", usual=0.3)}
    rank = 35
    memory = 2
    fast = {"T": 0.29}  # the filter's poles lie at 3.46 / T
    kin = _KIN
    separated_by = _EXCITATION

    def remember(self, x: Tensor, v: Tensor, system: System) -> Tensor:
        gap, speed = gaps(x), speeds_of_law(x, v, system)
        opening = torch.cat([torch.diff(speed), torch.zeros_like(speed[:, :1])], 1)
        return torch.stack([gap - self.T / 2 * opening, self.T * opening], -1)

    def forward(self, state: State) -> Tensor:
        assert state.memory is not None
        gap, law = gaps(state.x), law_of(state)
        # near zero a law may be steep; half the gap is the least that is remembered
        past = torch.maximum(gap - state.memory[..., 1], gap / 2)
        return for_followers(state, law.speed(past) - law.speed(gap))

    def memory_rate(self, state: State) -> Tensor:
        assert state.memory is not None
        z, slope = state.memory[..., 0], state.memory[..., 1]
        pull = 12 * (gaps(state.x) - z) - 6 * slope
        rates = torch.stack([slope, pull], -1) / self.T
        return torch.where(state.scene.follower[..., None], rates, 0.0)

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        return [Probe({}, {"T": T}) for T in (0.3, 0.8, 1.5) if has_law(system)]


@CATALOGUE.add
class Inertia(Effect):
    """A vehicle needs time to reach the speed that the law says."""

    tau_v: Tensor
    name = "inertia"
    domain = "traffic"
    formula = "tau_v dv/dt = W - v"
    source = "optimal velocity: Bando et al. 1995"
    strengths = {"tau_v": Strength(0.0, 0.3, Interval(0.2, 10.0), "s", usual=0.3)}
    rank = 60
    memory = 1
    fast = {"tau_v": 1.0}
    kin = _KIN
    separated_by = _EXCITATION

    def remember(self, x: Tensor, v: Tensor, system: System) -> Tensor:
        return speeds_of_law(x, v, system)[..., None]

    def forward(self, state: State) -> Tensor:
        assert state.memory is not None
        return for_followers(state, state.memory[..., 0] - rate_of(state))

    def memory_rate(self, state: State) -> Tensor:
        assert state.memory is not None
        rate = (rate_of(state) - state.memory[..., 0]) / self.tau_v
        return torch.where(state.scene.follower, rate, 0.0)[..., None]

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        return [Probe({}, {"tau_v": tau}) for tau in (0.3, 0.8, 2.0) if has_law(system)]
