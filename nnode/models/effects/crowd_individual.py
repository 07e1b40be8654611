"""Effects that differ from person to person: gait, and how strongly somebody is driven."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.models.crowd import Relaxation, velocity
from nnode.models.effects.base import CATALOGUE, IndividualEffect, Probe, Setting, Strength
from nnode.models.effects.crowd_pairs import heading, right_of
from nnode.models.system import System
from nnode.models.term import Interval, State


@CATALOGUE.add
class WalkerHeterogeneity(IndividualEffect):
    """Some people steer to their destination more vigorously than others.

    ``people`` holds their eta_i.
    """

    name = "walker_heterogeneity"
    domain = "crowd"
    formula = "eta_i (v_des - v) / tau, eta_i ~ N(0, sigma²)"
    source = "Campanella, Hoogendoorn & Daamen 2009 (heterogeneous walkers)"
    strengths = {"sigma": Strength(0.0, 0.05, Interval(0.0, 2.0), "1", usual=0.2)}
    separated_by = "people who are recorded for longer and turn more often"

    sigma: Tensor

    def __init__(self, people: dict[str, list[float]] | None = None, **values: float) -> None:
        super().__init__(people, **values)
        self.idle("sigma")  # it describes the people and is not in the equation

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        return super().probes(batch, system) if system.find(Relaxation) is not None else []

    @classmethod
    def person(cls, numbers: np.ndarray, options: dict[str, Any]) -> float:
        """At least -1: below it a person would run away from his own destination."""
        return max(float(numbers[0]), -1.0)

    def forward(self, state: State) -> Tensor:
        relaxation = None if state.system is None else state.system.find(Relaxation)
        if relaxation is None:
            raise ValueError(
                f"effect {self.name} changes the relaxation, but the model has none; add "
                "Relaxation to its terms"
            )
        eta, _ = self.known(state.scene, state.x)
        out: Tensor = eta[..., None] * relaxation(state)
        return out


@CATALOGUE.add
class GaitSway(IndividualEffect):
    """People sway from side to side as they step.

    ``people`` holds their phases phase_i (rad) at the clock time 0.
    """

    name = "gait_sway"
    domain = "crowd"
    formula = "a sin(2 pi f t + phase_i) right_i"
    source = "Hoogendoorn & Daamen 2005; Liu, Song & Zhang 2009 (lateral sway)"
    strengths = {"a": Strength(0.0, 0.05, Interval(0.0, 5.0), "m/s²", usual=0.3)}
    settings = {"f": Setting(0.95, Interval(0.5, 1.6), "Hz")}
    separated_by = "sampling of at least 5 Hz with a noise below the amplitude of the sway"

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

    def forward(self, state: State) -> Tensor:
        phase, there = self.known(state.scene, state.x)
        clock = (state.scene.start.to(state.x.dtype) + state.t)[:, None]
        sway = self.a * torch.sin(2 * torch.pi * self.f * clock + phase) * there
        return sway[..., None] * right_of(heading(velocity(state)))
