"""Effects in a lane: places, times, classes, gaps, the speed ahead, delays and memory."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import PADDING_GAP, Batch
from nnode.model.effects.base import (
    CATALOGUE,
    Effect,
    IndividualEffect,
    Probe,
    Setting,
    Strength,
)
from nnode.model.laws import Law
from nnode.model.scene import Scene
from nnode.model.system import System, Traffic
from nnode.model.term import Interval
from nnode.model.terms import Rule

#: Widths of the edges of a zone, m, and of a period, s. They make errors differentiable in the
#: ends. At a zone's edge the time per metre changes linearly, so that passing it takes as long as
#: passing a sharp edge. Wider edges bias the factor of a sharp zone, see the table in
#: docs/discovery.md.
EDGE = {"m": 2.0, "s": 1.0}
#: Number of the cells of a road or a time that are tested one by one.
CELLS = 32
#: Quantiles of the measured speeds that are tested as desired speeds.
SPEEDS = (0.3, 0.7)
_AHEAD = "reaction to the vehicle ahead"
_EXCITATION = "leaders that brake and accelerate strongly, measured often and precisely"
_LONGER = "the same drivers for a longer time"
_FACTOR = Strength(1.0, -0.1, Interval(0.05, 3.0), "1", min_effect_size=0.1)
_KAPPA = Strength(0.0, 0.05, Interval(-0.9, 0.95), "1", min_effect_size=0.2)
#: Unit of time: in laws of second order kappa/per is a rate.
_PER = {"per": (1.0, "s")}


def gaps(x: Tensor) -> Tensor:
    """``(B, N)`` gaps to the vehicle ahead, m, of positions ``(B, N, 1)``; the last is padding."""
    gap = torch.diff(x[..., 0])
    return torch.cat([gap, gap.new_full((len(gap), 1), PADDING_GAP)], 1)


class LaneEffect(Effect):
    """An effect in a lane."""

    domain = "traffic"


class LawEffect(LaneEffect):
    """An effect on a law of the gap."""

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        law = system.find(Law)
        return law is not None and (law.of_gap or system.order > 1)


def _inside(
    at: str, unit: str, factor: str, setting: float
) -> tuple[dict[int, Rule], dict[str, Setting]]:
    """Rules and settings of a factor on the desired speed where ``at`` lies in [a, b].

    The share is 1 inside, 0 outside, and linear over the edges.
    """
    share = f"clip(({at} - a)/edge + 0.5, 0, 1)*clip((b - {at})/edge + 0.5, 0, 1)"
    first = Rule(
        rate="W*factor",
        where={"share": share, "factor": factor},
        constants={"edge": (EDGE[unit], unit)},
    )
    second = replace(first, rate="W + law(v0=v0*factor) - law()")
    ends = {"a": Setting(0.0, Interval(), unit), "b": Setting(setting, Interval(), unit)}
    return {1: first, 2: second}, ends


class _Cells(LaneEffect):
    """A factor on the desired speed in an interval, tested for neighbouring cells."""

    strengths = {"alpha": _FACTOR}
    consecutive = True
    confusable_group = "where or when"

    @classmethod
    def span(cls, batch: Batch) -> tuple[float, float]:
        """The interval that the data cover."""
        raise NotImplementedError  # pragma: no cover - both define their own

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        low, high = cls.span(batch)
        width = (high - low) / CELLS
        ends = [low + width * i for i in range(CELLS + 1)]
        return [
            Probe({"a": a, "b": b}, {"alpha": size})
            for size in _sizes(batch, system)
            for a, b in pairwise(ends)
        ]


def _sizes(batch: Batch, system: System) -> list[float]:
    """Amounts by which the factor on a desired speed is varied.

    An acceleration may depend only weakly on a desired speed far above the measured speeds.
    Therefore factors that bring the desired speed to measured speeds are tested as well.
    """
    v0 = [float(value.detach()) for k, (value, _) in system.physical().items() if k.endswith(".v0")]
    if system.order == 1 or not v0:
        return [_FACTOR.step]
    speeds = np.quantile(batch.v[..., 0][batch.valid].numpy(), SPEEDS)
    factors = [_FACTOR.at(float(speed) / v0[0] - 1) - 1 for speed in speeds]
    return [_FACTOR.step, *(size for size in factors if size < 2 * _FACTOR.step)]


@CATALOGUE.add
class SpeedZone(_Cells):
    """A section of the road where all vehicles drive slower or faster than by the law."""

    name = "speed_zone"
    overlapping = True  # not a period: records often begin together, and so do their errors
    rules, settings = _inside("x", "m", "alpha/(alpha + (1 - alpha)*share)", 100.0)
    source = "a factor on all speeds; limits, which cap them: Hegyi, De Schutter & Hellendoorn 2005"
    rank = 10
    distinguishing_data = "platoons that pass the place at other times"

    @classmethod
    def span(cls, batch: Batch) -> tuple[float, float]:
        x = batch.x[..., 0][batch.valid]
        return float(x.min()), float(x.max())


@CATALOGUE.add
class SpeedPeriod(_Cells):
    """A period of the day in which all vehicles drive slower or faster than by the law."""

    name = "speed_period"
    rules, settings = _inside("clock", "s", "1 + (alpha - 1)*share", 60.0)
    source = "weather and light: Hranac et al. 2006 (FHWA-HOP-07-073)"
    rank = 11
    distinguishing_data = "platoons at the same time in other places"

    @classmethod
    def span(cls, batch: Batch) -> tuple[float, float]:
        lasts = (batch.valid.any(-1).sum(0) - 1) * batch.dt
        return float(batch.start.min()), float((batch.start + lasts).max())


@CATALOGUE.add
class Slope(LaneEffect):
    """A section of the road that rises or falls, so that gravity pulls along it."""

    name = "slope"
    rules = {
        2: Rule(
            rate="W - gravity*grade*share",
            where={"share": SpeedZone.rules[1].where["share"]},
            constants={**SpeedZone.rules[1].constants, "gravity": (9.81, "m/s^2")},
        )
    }
    source = "mechanics: the part of gravity along the road, grades being small"
    strengths = {"grade": Strength(0.0, 0.01, Interval(-0.3, 0.3), "1", min_effect_size=0.02)}
    settings = SpeedZone.settings
    rank = 65  # after the delays of drivers
    searched_orders = ()  # drivers compensate for it, which gives a speed_zone


@CATALOGUE.add
class VehicleClass(LaneEffect):
    """Vehicles of one class drive slower or faster than by the law.

    Args:
        kind: the class.
    """

    name = "vehicle_class"
    covariate = "kind"
    rules = {
        1: Rule(rate="W + (phi - 1)*belongs*W", inputs={"belongs": "1"}),
        2: Rule(
            rate="W + law(T=T*(1 + (phi - 1)*belongs)) - law()",
            inputs={"belongs": "1"},
        ),
    }
    source = "Ossen & Hoogendoorn 2011"
    strengths = {"phi": _FACTOR}
    rank = 12
    confusable_group = "who"
    distinguishing_data = "more vehicles of the class"

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


@CATALOGUE.add
class DriverHeterogeneity(LaneEffect, IndividualEffect):
    """Drivers differ in their pace, with mean zero over the drivers.

    ``people`` holds their eta_i.
    """

    name = "driver_heterogeneity"
    of_drivers = True
    rules = {
        1: Rule(rate="W + eta*W", inputs={"eta": "1"}),
        2: Rule(rate="W + law(T=T*(1 + eta)) - law()", inputs={"eta": "1"}),
    }
    source = "Ossen & Hoogendoorn 2011"
    strengths = {"sigma": Strength(0.0, 0.05, Interval(0.0, 1.0), "1", min_effect_size=0.1)}
    in_equation = False
    rank = 13
    confusable_group = "who"
    distinguishing_data = _LONGER


@CATALOGUE.add
class LeaderLength(LawEffect):
    """The spacing grows with the length of the vehicle ahead."""

    name = "leader_length"
    covariate = "length"
    rules = dict.fromkeys(
        (1, 2),
        Rule(rate="W + law(gap=gap - beta*longer) - law()", inputs={"longer": "m"}),
    )
    source = "Ossen & Hoogendoorn 2011"
    strengths = {"beta": Strength(0.0, 0.1, Interval(-2.0, 3.0), "1", min_effect_size=0.5)}
    rank = 33
    confusable_group = "who"
    distinguishing_data = "vehicles of more different lengths"

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        length = scene.length
        longer = torch.where(torch.isfinite(length), length - scene.mean_length, 0.0)
        return {"longer": torch.cat([longer[:, 1:], torch.zeros_like(longer[:, :1])], 1)}

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        lengths = batch.length[torch.isfinite(batch.length)]
        different = lengths.numel() > 1 and float(lengths.std()) > 0.1
        return different and super().applies(batch, system)


@CATALOGUE.add
class FreeFlowSpeed(LaneEffect):
    """No vehicle drives faster than a desired speed, even for long gaps."""

    name = "free_flow_speed"
    rules = {1: Rule(rate="W - max(W - v_max, 0)")}
    source = "Newell 2002"
    built_into_laws = True
    settings = {"v_max": Setting(30.0, Interval(1.0, 60.0), "m/s")}
    rank = 20

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        speeds = batch.v[..., 0][batch.valid]
        levels = np.quantile(speeds.numpy(), [0.4, 0.55, 0.7, 0.8, 0.88, 0.94])
        return [Probe({"v_max": float(v)}, {}) for v in levels if v > 1.0]


@CATALOGUE.add
class LeaderSpeed(LaneEffect):
    """The leader does not drive at a constant speed, but as it was measured."""

    name = "leader_speed"
    rules = {1: Rule(leader="W + weight*(measured - W)")}
    source = "the model option leader=measured"
    strengths = {"weight": Strength(0.0, 0.1, Interval(-0.5, 1.5), "1", min_effect_size=0.5)}
    rank = 5

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        return isinstance(system, Traffic) and not system.leader_measured


@CATALOGUE.add
class MultiAnticipation(LawEffect):
    """Drivers look two vehicles ahead.

    In laws of second order they react to half the distance to the second one, and to its speed.
    """

    name = "multi_anticipation"
    rules = {
        1: Rule(rate="choose(second, W + c*(law(gap=gap_1) - law()), W)"),
        2: Rule(
            rate="choose(second, W + c*(law(gap=(gap + gap_1)/2, dv=v - v_2, v_1=v_2) - law()), W)"
        ),
    }
    source = (
        "after Lenz, Wagner & Sollacher 1999, whose drivers react to mean gaps of j vehicles ahead"
    )
    strengths = {"c": Strength(0.0, 0.05, Interval(-1.0, 1.0), "1", min_effect_size=0.2)}
    rank = 30
    confusable_group = _AHEAD
    distinguishing_data = (
        "leaders that brake and accelerate strongly, cameras that see longer platoons"
    )

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        return int(batch.agent.sum(1).max()) > 2 and super().applies(batch, system)


@CATALOGUE.add
class TimeGap(LaneEffect):
    """The spacing grows with speed."""

    name = "time_gap"
    rules = {
        1: Rule(
            rate="W + law(gap=gap*L/max(L + h*dx_1, least)) - law()",
            constants={"least": (0.1, "m")},
        )
    }
    source = (
        "by the speed ahead, where Pipes 1953 and Treiber, Hennecke & Helbing 2000 have one's own"
    )
    built_into_laws = True
    strengths = {"h": Strength(0.0, 0.02, Interval(-0.3, 2.0), "s", min_effect_size=0.2)}
    rank = 40
    confusable_group = _AHEAD
    distinguishing_data = "a wider range of speeds"

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        return system.find_law("lin", "log") is not None


@CATALOGUE.add
class RelativeSpeed(LaneEffect):
    """Drivers react to the difference of speeds."""

    name = "relative_speed"
    rules = {
        1: Rule(rate="W + kappa*(dx_1 - W)"),
        2: Rule(rate="W - kappa*dv/per", constants=_PER),
    }
    source = "first-order analogue of the full velocity difference of Jiang, Wu & Zhu 2001"
    built_into_laws = True
    strengths = {"kappa": _KAPPA}
    rank = 50
    confusable_group = _AHEAD
    distinguishing_data = _EXCITATION


@CATALOGUE.add
class AsymmetricResponse(LaneEffect):
    """Drivers react differently when the gap opens and when it closes."""

    name = "asymmetric_response"
    rules = {
        1: Rule(rate="W + kappa_open*max(dx_1 - W, 0) + kappa_close*min(dx_1 - W, 0)"),
        2: Rule(rate="W + (kappa_open*max(-dv, 0) + kappa_close*min(-dv, 0))/per", constants=_PER),
    }
    source = "first-order analogue of Gong, Liu & Wang 2008"
    built_into_laws = True
    strengths = {"kappa_open": _KAPPA, "kappa_close": _KAPPA}
    rank = 51
    contains = ("relative_speed",)
    confusable_group = _AHEAD
    distinguishing_data = _EXCITATION


#: Rate of change of the gap at the start: the speed of the vehicle ahead, by its law or measured
#: for a leader, less the speed by the law. Measured speeds of followers contain autocorrelated
#: disturbances, and a state that starts with them would be mistaken for inertia.
_OPENING = "(choose(second, law(gap=gap_1), v_1) - law())"


@CATALOGUE.add
class ReactionDelay(LawEffect):
    """Drivers react to the gap as it was some time ago.

    In laws of second order all reactions have this delay.
    The delay is a second-order all-pass filter of the gap u (Padé's approximation): with
    z'' T²/12 + z' T/2 + z = u the delayed gap is u - T z'. It is exact to a thousandth of a
    period for oscillations slower than 2 pi T.
    """

    name = "reaction_delay"
    rules = {
        # near zero a law may be steep, so the delayed gap is at least half the gap
        1: Rule(
            rate="W + law(gap=max(gap - slope, gap/2)) - law()",
            states={
                "z": ("m", "slope/T", f"gap - T/2*{_OPENING}"),
                "slope": ("m", "(12*(gap - z) - 6*slope)/T", f"T*{_OPENING}"),
            },
        ),
        2: Rule(
            rate="W - slope",
            states={
                "z": ("m/s^2", "slope/T", "W"),
                "slope": ("m/s^2", "(12*(W - z) - 6*slope)/T", "0*W"),
            },
        ),
    }
    source = "Newell 1961; Padé's approximation of the delay"
    built_into_laws = True
    strengths = {"T": Strength(0.0, 0.3, Interval(0.2, 3.0), "s", min_effect_size=0.3)}
    tried = {"T": (0.3, 0.8, 1.5)}
    rank = 35
    fast = {"T": 0.29}  # the filter's poles lie at 3.46 / T
    confusable_group = _AHEAD
    distinguishing_data = _EXCITATION


@CATALOGUE.add
class Inertia(LawEffect):
    """A vehicle reaches the speed, or acceleration, of the law with a time lag."""

    name = "inertia"
    rules = {
        1: Rule(rate="u", states={"u": ("m/s", "(W - u)/tau_v", "law()")}),
        2: Rule(rate="u", states={"u": ("m/s^2", "(W - u)/tau_v", "W")}),
    }
    source = "optimal velocity: Bando et al. 1995"
    built_into_laws = True
    strengths = {"tau_v": Strength(0.0, 0.3, Interval(0.2, 10.0), "s", min_effect_size=0.3)}
    tried = {"tau_v": (0.3, 0.8, 2.0)}
    rank = 60
    fast = {"tau_v": 1.0}
    confusable_group = _AHEAD
    distinguishing_data = _EXCITATION


@CATALOGUE.add
class PureDelay(LaneEffect):
    """Drivers react exactly as they would have some time ago, at most 15 steps.

    Every step moves the acceleration to the next of 15 states. The acceleration's derivative by T
    jumps where T is a whole number of steps.
    """

    name = "pure_delay"
    rules = {2: Rule(rate="late", delayed={"late": ("W", "m/s^2", "T")}, remembered=15)}
    source = "Treiber, Kesting & Helbing 2006 (reaction time)"
    settings = {"T": Setting(0.5, Interval(0.0, 1.5), "s")}
    rank = 36
    searched_orders = ()  # a diagnosis tests reaction_delay instead


#: A driver's time gap in the first state.
_FIRST_GAP = "clip((gap - length_1 - s0)/max(v, slowest), shortest, longest)"
_GAPS = {"slowest": (2.0, "m/s"), "shortest": (0.1, "s"), "longest": (5.0, "s")}


@CATALOGUE.add
class Memory(LaneEffect):
    """A driver starts with the time gap of the first state, and relaxes to the common one.

    The first time gap is (gap - s0)/v; below 2 m/s it is that of 2 m/s, and it lies between
    0.1 and 5 s.
    """

    name = "memory"
    of_drivers = True
    rules = {
        2: Rule(
            rate="W + law(T=q) - law()",
            states={"q": ("s", "(T - q)/tau_m", _FIRST_GAP)},
            constants=_GAPS,
        )
    }
    source = "after the memory effects of Treiber & Helbing 2003"
    settings = {"tau_m": Setting(30.0, Interval(1.0, 2000.0), "s")}
    tried = {"tau_m": (5.0, 20.0, 80.0)}
    rank = 14
    searched_orders = (2,)
    confusable_group = "who"
    distinguishing_data = _LONGER


@CATALOGUE.add
class LastingTimeGap(LaneEffect):
    """Drivers differ permanently in their time gaps.

    It is estimated from the time gap of the first state, as ``memory`` defines it. The first state
    depends on temporary deviations as well, so a share of the difference is kept.
    """

    name = "lasting_time_gap"
    of_drivers = True
    rules = {
        2: Rule(
            rate="W + law(T=T + share*(q - T)) - law()",
            states={"q": ("s", "0*T/per", _FIRST_GAP)},
            constants={**_GAPS, **_PER},
        )
    }
    source = "Ossen & Hoogendoorn 2011 (drivers differ)"
    strengths = {"share": Strength(0.0, 0.1, Interval(-0.5, 1.5), "1", min_effect_size=0.2)}
    rank = 15
    searched_orders = (2,)
    confusable_group = "who"
    distinguishing_data = _LONGER
