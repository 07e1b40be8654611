"""Effects in a lane that tie a vehicle to the speed ahead, or to its own past."""

from __future__ import annotations

import torch
from torch import Tensor

from nnode.data.sequence import PADDING_GAP, Batch
from nnode.model.effects.base import CATALOGUE, Effect, Probe, Setting, Strength
from nnode.model.effects.traffic import gaps, has_law, law_in
from nnode.model.lane_dynamics import Rule
from nnode.model.system import System
from nnode.model.term import Interval

_KIN = "reaction to the vehicle ahead"
#: Of an acceleration, kappa is a rate, per second.
_PER = {"per": (1.0, "s")}
_EXCITATION = "leaders that brake and accelerate strongly, measured often and precisely"


def speeds_of_law(x: Tensor, v: Tensor, system: System) -> Tensor:
    """``(B, N)`` speeds at the start as the law says, m/s; a leader's is measured.

    Measured speeds of followers would tell of disturbances that go on for a while, and a memory
    that starts with them would be taken for inertia.
    """
    law, gap = law_in(system), gaps(x)
    # nobody, or a vehicle of the padding, is ahead of a leader
    return torch.where(gap > PADDING_GAP / 2, v[..., 0], law.speed(gap))


@CATALOGUE.add
class RelativeSpeed(Effect):
    """Drivers react to the difference of speeds."""

    kappa: Tensor
    name = "relative_speed"
    domain = "traffic"
    formula = "W + kappa (ẋ_{i+1} - W)"
    rule = Rule(rate="W + kappa*(dx_1 - W)")
    second = Rule(rate="W - kappa*dv/per", constants=_PER)
    source = "first-order analogue of the full velocity difference of Jiang, Wu & Zhu 2001"
    built_into_laws = True
    strengths = {"kappa": Strength(0.0, 0.05, Interval(-0.9, 0.95), "1", min_effect_size=0.2)}
    rank = 50
    confusable_group = _KIN
    distinguishing_data = _EXCITATION


@CATALOGUE.add
class AsymmetricResponse(Effect):
    """Drivers react differently when the gap opens and when it closes."""

    kappa_open: Tensor
    kappa_close: Tensor
    name = "asymmetric_response"
    domain = "traffic"
    formula = "W + kappa_open (ẋ_{i+1} - W)+ - kappa_close (W - ẋ_{i+1})+"
    rule = Rule(rate="W + kappa_open*max(dx_1 - W, 0) + kappa_close*min(dx_1 - W, 0)")
    second = Rule(rate="W + (kappa_open*max(-dv, 0) + kappa_close*min(-dv, 0))/per", constants=_PER)
    source = "first-order analogue of Gong, Liu & Wang 2008"
    built_into_laws = True
    strengths = {
        "kappa_open": Strength(0.0, 0.05, Interval(-0.9, 0.95), "1", min_effect_size=0.2),
        "kappa_close": Strength(0.0, 0.05, Interval(-0.9, 0.95), "1", min_effect_size=0.2),
    }
    rank = 51
    contains = ("relative_speed",)
    confusable_group = _KIN
    distinguishing_data = _EXCITATION


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
    # near zero a law may be steep; half the gap is the least that is remembered
    rule = Rule(
        rate="W + law(gap=max(gap - slope, gap/2)) - law()",
        states={"z": ("m", "slope/T"), "slope": ("m", "(12*(gap - z) - 6*slope)/T")},
    )
    # of an acceleration all that it was made of is delayed
    second = Rule(
        rate="W - slope",
        states={
            "z": ("m/s^2", "slope/T", "W"),
            "slope": ("m/s^2", "(12*(W - z) - 6*slope)/T", "0*W"),
        },
    )
    source = "Newell 1961; Padé's approximation of the delay"
    built_into_laws = True
    strengths = {"T": Strength(0.0, 0.3, Interval(0.2, 3.0), "s", min_effect_size=0.3)}
    rank = 35
    memory = 2
    fast = {"T": 0.29}  # the filter's poles lie at 3.46 / T
    confusable_group = _KIN
    distinguishing_data = _EXCITATION

    def remember(self, x: Tensor, v: Tensor, system: System) -> Tensor:
        gap, speed = gaps(x), speeds_of_law(x, v, system)
        opening = torch.cat([torch.diff(speed), torch.zeros_like(speed[:, :1])], 1)
        return torch.stack([gap - self.T / 2 * opening, self.T * opening], -1)

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
    rule = Rule(rate="u", states={"u": ("m/s", "(W - u)/tau_v")})
    second = Rule(rate="u", states={"u": ("m/s^2", "(W - u)/tau_v", "W")})
    source = "optimal velocity: Bando et al. 1995"
    built_into_laws = True
    strengths = {"tau_v": Strength(0.0, 0.3, Interval(0.2, 10.0), "s", min_effect_size=0.3)}
    rank = 60
    memory = 1
    fast = {"tau_v": 1.0}
    confusable_group = _KIN
    distinguishing_data = _EXCITATION

    def remember(self, x: Tensor, v: Tensor, system: System) -> Tensor:
        return speeds_of_law(x, v, system)[..., None]

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        return [Probe({}, {"tau_v": tau}) for tau in (0.3, 0.8, 2.0) if has_law(system)]


@CATALOGUE.add
class PureDelay(Effect):
    """Drivers react exactly as they would have some time ago, at most 15 steps.

    Every step hands the acceleration on to the next of 15 states. The acceleration's slope by T
    jumps where T is a whole number of steps.
    """

    T: Tensor
    name = "pure_delay"
    domain = "traffic"
    formula = "W(t - T)"
    second = Rule(rate="late", delayed={"late": ("W", "m/s^2", "T")}, remembered=15)
    source = "Treiber, Kesting & Helbing 2006 (reaction time)"
    strengths = {}
    settings = {"T": Setting(0.5, Interval(0.0, 1.5), "s")}
    rank = 36
    memory = 15
    searched_orders = ()  # a map from step to step; reaction_delay is looked for


#: The time gap that a driver is seen to have in the first state.
_SEEN_GAP = "clip((gap - length_1 - s0)/max(v, slowest), shortest, longest)"
_SEEN = {"slowest": (2.0, "m/s"), "shortest": (0.1, "s"), "longest": (5.0, "s")}


@CATALOGUE.add
class Memory(Effect):
    """A driver starts with the time gap that he is seen to have, and relaxes to the common one.

    Seen is (gap - s0)/v in the first state; below 2 m/s it is that of 2 m/s, and it lies between
    0.1 and 5 s.
    """

    tau_m: Tensor
    name = "memory"
    domain = "traffic"
    formula = "law with time gap q in place of T; tau_m dq/dt = T - q"
    second = Rule(
        rate="W + law(T=q) - law()",
        states={"q": ("s", "(T - q)/tau_m", _SEEN_GAP)},
        constants=_SEEN,
    )
    source = "after the memory effects of Treiber & Helbing 2003"
    strengths = {}
    settings = {"tau_m": Setting(30.0, Interval(1.0, 2000.0), "s")}
    rank = 14
    memory = 1
    searched_orders = (2,)
    confusable_group = "who"
    distinguishing_data = "the same drivers for a longer time"

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        return [Probe({"tau_m": tau}, {}) for tau in (5.0, 20.0, 80.0)]


@CATALOGUE.add
class LastingTimeGap(Effect):
    """Every driver has a time gap of his own and keeps it; what is seen of it in the first state,
    as for ``memory``, counts with a share, since that state tells of passing things too."""

    share: Tensor
    name = "lasting_time_gap"
    domain = "traffic"
    formula = "law with time gap T + share (q - T), q as seen at first"
    second = Rule(
        rate="W + law(T=T + share*(q - T)) - law()",
        states={"q": ("s", "0*T/per", _SEEN_GAP)},
        constants={**_SEEN, **_PER},
    )
    source = "Ossen & Hoogendoorn 2011 (drivers differ)"
    strengths = {"share": Strength(0.0, 0.1, Interval(-0.5, 1.5), "1", min_effect_size=0.2)}
    rank = 15
    memory = 1
    searched_orders = (2,)
    confusable_group = "who"
    distinguishing_data = "the same drivers for a longer time"
