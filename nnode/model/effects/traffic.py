"""Effects in a lane that change the speed at once: places, times, classes, gaps ahead."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import PADDING_GAP, Batch
from nnode.errors import ConfigError
from nnode.model.effects.base import (
    CATALOGUE,
    Effect,
    IndividualEffect,
    Probe,
    Setting,
    Strength,
)
from nnode.model.lane_dynamics import Rule
from nnode.model.laws import Law
from nnode.model.scene import Scene
from nnode.model.system import System, Traffic
from nnode.model.term import Interval, State

#: A zone begins and ends over this distance, m, and a period over this time, s: their edges
#: can then be calibrated.
EDGE = {"m": 12.0, "s": 1.0}
#: 1 inside [a, b], 0 outside, linear over the edge in between.
_INSIDE = "clip(({at} - a)/edge + 0.5, 0, 1)*clip((b - {at})/edge + 0.5, 0, 1)"
#: Of an acceleration the desired speed is changed.
_SLOWER = "W + law(v0=v0*(1 + (alpha - 1)*share)) - law()"
#: So many cells of a road or a time are looked at one by one.
CELLS = 32
#: Quantiles of the speeds that are driven, to which a desired speed is brought.
SPEEDS = (0.3, 0.7)


def law_in(system: System | None) -> Law:
    """A model's law of the gap.

    Raises:
        ConfigError: the model has none.
    """
    found = None if system is None else system.find(Law)
    if found is None or not found.of_gap:
        raise ConfigError(
            "an effect that modifies the law of the gap needs a model with one; derive the "
            "model's own term from FollowTheLeader, or leave the effect out"
        )
    return found


def has_law(system: System) -> bool:
    """Whether a model has a law of the gap; without one, an effect on it cannot be looked for."""
    law = system.find(Law)
    return law is not None and (law.of_gap or system.order > 1)


def gaps(x: Tensor) -> Tensor:
    """``(B, N)`` gaps to the vehicle ahead, m, of positions ``(B, N, 1)``; the last has none."""
    gap = torch.diff(x[..., 0])
    return torch.cat([gap, gap.new_full((len(gap), 1), PADDING_GAP)], 1)


def rate_of(state: State) -> Tensor:
    """``(B, N)`` the sum of the terms before, m/s."""
    assert state.rate is not None
    return state.rate[..., 0]


def for_followers(state: State, change: Tensor) -> Tensor:
    """``(B, N, 1)`` a change of the speed ``(B, N)``, for followers only."""
    return torch.where(state.scene.follower, change, 0.0)[..., None]


def _cells(low: float, high: float, batch: Batch, system: System) -> list[Probe]:
    """Probes of neighbouring cells of [low, high], for each size of the factor."""
    width = (high - low) / CELLS
    ends = [low + width * i for i in range(CELLS + 1)]
    return [
        Probe({"a": a, "b": b}, {"alpha": size})
        for size in _sizes(batch, system)
        for a, b in pairwise(ends)
    ]


def _sizes(batch: Batch, system: System) -> list[float]:
    """Amounts by which the factor on a desired speed is varied.

    An acceleration may not feel its desired speed before that comes near to the speeds that are
    driven, such as with a power of the one over the other; so factors that bring it there are tried
    as well.
    """
    v0 = [float(value.detach()) for k, (value, _) in system.physical().items() if k.endswith(".v0")]
    if system.order == 1 or not v0:
        return [_FACTOR.step]
    speeds = np.quantile(batch.v[..., 0][batch.valid].numpy(), SPEEDS)
    found = [_FACTOR.at(float(speed) / v0[0] - 1) - 1 for speed in speeds]
    return [_FACTOR.step, *(size for size in found if size < 2 * _FACTOR.step)]


_FACTOR = Strength(1.0, -0.1, Interval(0.05, 3.0), "1", min_effect_size=0.1)


@CATALOGUE.add
class SpeedZone(Effect):
    """A section of the road where everyone drives slower or faster than the law says."""

    alpha: Tensor
    a: Tensor
    b: Tensor
    name = "speed_zone"
    domain = "traffic"
    formula = "W alpha for x in [a, b]"
    rule = Rule(
        rate="W + (alpha - 1)*share*W",
        where={"share": _INSIDE.format(at="x")},
        constants={"edge": (EDGE["m"], "m")},
    )
    second = replace(rule, rate=_SLOWER)
    source = "a factor on all speeds; limits, which cap them: Hegyi, De Schutter & Hellendoorn 2005"
    strengths = {"alpha": _FACTOR}
    settings = {"a": Setting(0.0, Interval(), "m"), "b": Setting(100.0, Interval(), "m")}
    rank = 10
    consecutive = True
    confusable_group = "where or when"
    distinguishing_data = "platoons that pass the place at other times"

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        x = batch.x[..., 0][batch.valid]
        return _cells(float(x.min()), float(x.max()), batch, system)


@CATALOGUE.add
class Slope(Effect):
    """A section of the road that rises or falls, so that gravity pulls along it."""

    grade: Tensor
    a: Tensor
    b: Tensor
    name = "slope"
    domain = "traffic"
    formula = "dv/dt - g grade for x in [a, b]"
    second = Rule(
        rate="W - gravity*grade*share",
        where=SpeedZone.rule.where,
        constants={**SpeedZone.rule.constants, "gravity": (9.81, "m/s^2")},
    )
    source = "mechanics: the part of gravity along the road, grades being small"
    strengths = {"grade": Strength(0.0, 0.01, Interval(-0.3, 0.3), "1", min_effect_size=0.02)}
    settings = SpeedZone.settings
    rank = 65  # behind what drivers feel late
    searched_orders = ()  # a driver makes up for it, and then it is a speed_zone


@CATALOGUE.add
class SpeedPeriod(Effect):
    """A time of the clock when everyone drives slower or faster than the law says."""

    alpha: Tensor
    a: Tensor
    b: Tensor
    name = "speed_period"
    domain = "traffic"
    formula = "W alpha for t in [a, b]"
    rule = Rule(
        rate="W + (alpha - 1)*share*W",
        where={"share": _INSIDE.format(at="clock")},
        constants={"edge": (EDGE["s"], "s")},
    )
    second = replace(rule, rate=_SLOWER)
    source = "weather and light: Hranac et al. 2006 (FHWA-HOP-07-073)"
    strengths = {"alpha": _FACTOR}
    settings = {"a": Setting(0.0, Interval(), "s"), "b": Setting(60.0, Interval(), "s")}
    rank = 11
    consecutive = True
    confusable_group = "where or when"
    distinguishing_data = "platoons at the same time in other places"

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        lasts = (batch.valid.any(-1).sum(0) - 1) * batch.dt
        end = float((batch.start + lasts).max())
        return _cells(float(batch.start.min()), end, batch, system)


@CATALOGUE.add
class VehicleClass(Effect):
    """Vehicles of one class drive slower or faster than the law says.

    Args:
        kind: the class.
    """

    phi: Tensor
    name = "vehicle_class"
    covariate = "kind"
    domain = "traffic"
    formula = "W phi for vehicles of one class"
    rule = Rule(rate="W + (phi - 1)*belongs*W", inputs={"belongs": "1"})
    # of an acceleration the time gap
    second = replace(rule, rate="W + law(T=T*(1 + (phi - 1)*belongs)) - law()")
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
        counts: dict[str, int] = {}
        for names in batch.kind:
            for name in names or ():
                counts[name] = counts.get(name, 0) + bool(name)
        # the most frequent class is what the law describes
        others = sorted((kind for kind in counts if kind), key=lambda kind: -counts[kind])[1:]
        return [Probe({"kind": kind}, {"phi": -0.1}) for kind in others]

    def options(self) -> dict[str, Any]:
        return {"kind": self.kind, **super().options()}


@CATALOGUE.add
class LeaderLength(Effect):
    """The spacing grows with the length of the vehicle ahead."""

    beta: Tensor
    name = "leader_length"
    covariate = "length"
    domain = "traffic"
    formula = "W(gap - beta (l_{i+1} - mean l))"
    rule = Rule(
        rate="W + law(gap=gap - beta*longer) - law()",
        inputs={"longer": "m"},
    )
    second = rule
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
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        lengths = batch.length[torch.isfinite(batch.length)]
        different = lengths.numel() > 1 and float(lengths.std()) > 0.1
        return [Probe({}, {"beta": 0.1})] if different and has_law(system) else []


@CATALOGUE.add
class FreeFlowSpeed(Effect):
    """Nobody drives faster than a desired speed, however long the gap."""

    v_max: Tensor
    name = "free_flow_speed"
    domain = "traffic"
    formula = "min(W, v_max)"
    rule = Rule(rate="W - max(W - v_max, 0)")
    source = "Newell 2002"
    built_into_laws = True
    strengths = {}
    settings = {"v_max": Setting(30.0, Interval(1.0, 60.0), "m/s")}
    rank = 20

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        speeds = batch.v[..., 0][batch.valid]
        levels = np.quantile(speeds.numpy(), [0.4, 0.55, 0.7, 0.8, 0.88, 0.94])
        return [Probe({"v_max": float(v)}, {}) for v in levels if v > 1.0]


@CATALOGUE.add
class MultiAnticipation(Effect):
    """Drivers look two vehicles ahead."""

    c: Tensor
    name = "multi_anticipation"
    domain = "traffic"
    formula = "W + c (W(gap_{i+1}) - W(gap_i))"
    rule = Rule(rate="choose(second, W + c*(law(gap=gap_1) - law()), W)")
    # half the way to the second vehicle ahead, and its speed
    second = Rule(
        rate="choose(second, W + c*(law(gap=(gap + gap_1)/2, dv=v - v_2, v_1=v_2) - law()), W)"
    )
    source = (
        "after Lenz, Wagner & Sollacher 1999, whose drivers react to mean gaps of j vehicles ahead"
    )
    strengths = {"c": Strength(0.0, 0.05, Interval(-1.0, 1.0), "1", min_effect_size=0.2)}
    rank = 30
    confusable_group = "reaction to the vehicle ahead"
    distinguishing_data = (
        "leaders that brake and accelerate strongly, cameras that see longer platoons"
    )

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        second = int(batch.agent.sum(1).max()) > 2
        return super().probes(batch, system) if second and has_law(system) else []


@CATALOGUE.add
class LeaderSpeed(Effect):
    """The leader does not drive at a constant speed, but as it was measured."""

    weight: Tensor
    name = "leader_speed"
    domain = "traffic"
    formula = "v0 + weight (measured speed - v0) for the leader"
    rule = Rule(leader="W + weight*(measured - W)")
    source = "the model option leader=measured"
    strengths = {"weight": Strength(0.0, 0.1, Interval(-0.5, 1.5), "1", min_effect_size=0.5)}
    rank = 5

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        constant = isinstance(system, Traffic) and system.leader == "constant"
        return [Probe({}, {"weight": 0.1})] if constant else []


@CATALOGUE.add
class DriverHeterogeneity(IndividualEffect):
    """Every driver has a pace of his own, with mean zero over the drivers.

    ``people`` holds their eta_i.
    """

    sigma: Tensor
    name = "driver_heterogeneity"
    domain = "traffic"
    formula = "W (1 + eta_i), eta_i ~ N(0, sigma²)"
    rule = Rule(rate="W + eta*W", inputs={"eta": "1"})
    second = replace(rule, rate="W + law(T=T*(1 + eta)) - law()")
    source = "Ossen & Hoogendoorn 2011"
    strengths = {"sigma": Strength(0.0, 0.05, Interval(0.0, 1.0), "1", min_effect_size=0.1)}
    rank = 13
    confusable_group = "who"
    distinguishing_data = "the same drivers for a longer time"

    def __init__(self, people: dict[str, list[float]] | None = None, **values: float) -> None:
        super().__init__(people, **values)
        self.idle("sigma")  # it describes the drivers and is not in the equation

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        return {"eta": self.known(scene, scene.length)[0]}


@CATALOGUE.add
class TimeGap(Effect):
    """The spacing grows with speed."""

    h: Tensor
    name = "time_gap"
    domain = "traffic"
    formula = "W with L + h ẋ_{i+1} in place of L"
    rule = Rule(
        rate="W + law(gap=gap*L/max(L + h*dx_1, least)) - law()",
        constants={"least": (0.1, "m")},
    )
    source = (
        "by the speed ahead, where Pipes 1953 and Treiber, Hennecke & Helbing 2000 have one's own"
    )
    built_into_laws = True
    strengths = {"h": Strength(0.0, 0.02, Interval(-0.3, 2.0), "s", min_effect_size=0.2)}
    rank = 40
    confusable_group = "reaction to the vehicle ahead"
    distinguishing_data = "a wider range of speeds"

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        known = system.find_law("lin", "log") is not None
        return super().probes(batch, system) if known else []
