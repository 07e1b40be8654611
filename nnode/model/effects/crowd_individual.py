"""Effects that differ from person to person: gait, and how strongly somebody is driven."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.model.crowd_dynamics import CrowdRule
from nnode.model.effects.base import CATALOGUE, IndividualEffect, Probe, Setting, Strength
from nnode.model.scene import Scene
from nnode.model.system import System
from nnode.model.term import Interval, State


@CATALOGUE.add
class WalkerHeterogeneity(IndividualEffect):
    """Some people steer to their destination more vigorously than others.

    ``people`` holds their eta_i.
    """

    name = "walker_heterogeneity"
    domain = "crowd"
    formula = "eta_i (v_des - v) / tau, eta_i ~ N(0, sigma²)"
    rule = CrowdRule(rate=("eta*drive_x", "eta*drive_y"), inputs={"eta": "1"})
    source = "Campanella, Hoogendoorn & Daamen 2009 (heterogeneous walkers)"
    strengths = {"sigma": Strength(0.0, 0.05, Interval(0.0, 2.0), "1", min_effect_size=0.2)}
    distinguishing_data = "people who are recorded for longer and turn more often"

    sigma: Tensor

    def __init__(self, people: dict[str, list[float]] | None = None, **values: float) -> None:
        super().__init__(people, **values)
        self.idle("sigma")  # it describes the people and is not in the equation

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        return super().probes(batch, system) if system.find_law("relaxation") else []

    @classmethod
    def person(cls, numbers: np.ndarray, options: dict[str, Any]) -> float:
        """At least -1: below it a person would run away from his own destination."""
        return max(float(numbers[0]), -1.0)

    def forward(self, state: State) -> Tensor:
        if state.system is None or state.system.find_law("relaxation") is None:
            raise ValueError(
                f"effect {self.name} changes the relaxation, but the model has none; add "
                "make_law('relaxation') to its terms"
            )
        return super().forward(state)

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        return {"eta": self.known(scene, self.sigma)[0]}


@CATALOGUE.add
class GaitSway(IndividualEffect):
    """People sway from side to side as they step.

    ``people`` holds their phases phase_i (rad) at the clock time 0.
    """

    name = "gait_sway"
    domain = "crowd"
    formula = "a sin(2 pi f t + phase_i) right_i"
    rule = CrowdRule(
        rate=("sway*e_y", "-sway*e_x"),
        where={"sway": f"a*sin({2 * math.pi!r}*f*clock + phase)*there"},
        inputs={"phase": "1", "there": "1"},
    )
    source = "Hoogendoorn & Daamen 2005; Liu, Song & Zhang 2009 (lateral sway)"
    strengths = {"a": Strength(0.0, 0.05, Interval(0.0, 5.0), "m/s²", min_effect_size=0.3)}
    settings = {"f": Setting(0.95, Interval(0.5, 1.6), "Hz")}
    distinguishing_data = "sampling of at least 5 Hz with a noise below the amplitude of the sway"

    a: Tensor
    f: Tensor

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        if batch.dt > 0.25:
            return []
        return [Probe({"f": 0.6 + 0.05 * i}, {"a": 0.05}) for i in range(17)]

    @classmethod
    def directions(cls, options: dict[str, Any]) -> list[tuple[dict[str, Any], float]]:
        """Sine and cosine of the clock, at 1 m/s²."""
        unit = {**options, "a": 1.0}
        return [(unit, 0.0), (unit, math.pi / 2)]

    @classmethod
    def person(cls, numbers: np.ndarray, options: dict[str, Any]) -> float:
        """The phase, from the amplitudes of the sine and the cosine of the clock."""
        return float(np.arctan2(numbers[1], numbers[0]))

    @classmethod
    def spread(cls, sigma: float) -> float:
        """The amplitude: sine and cosine share its square."""
        return math.sqrt(2) * sigma

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        phase, there = self.known(scene, self.a)
        return {"phase": phase, "there": there}
