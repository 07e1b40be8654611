"""Synthetic measured platoons in which an effect is hidden."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.synthetic_cases.case import Case, check_effects
from benchmarks.synthetic_cases.strength import Costs, Range, Subject, set_strength
from benchmarks.synthetic_cases.traffic import catalogue
from benchmarks.synthetic_cases.traffic.catalogue import (
    EFFECTS,
    NUISANCE,
    SMOOTH_EDGE,
    Coefficients,
)
from benchmarks.synthetic_cases.traffic.motion import LAWS, Hidden, simulate
from benchmarks.synthetic_cases.traffic.replay import Recording, cost_by_sequence
from benchmarks.synthetic_cases.traffic.road import BURN_IN, SUBSTEPS, Road, lay_out, surroundings

#: Standard deviation of drivers' velocities, m/s.
AMPLITUDES = Range(preferred=(0.02, 0.6), extreme=(0.005, 1.5), idle=(0.1, 0.4), probe=0.05)
#: Largest product of a delay and W' that may occur.
_STABLE = 0.4
#: Effects that make vehicles react late, and their coefficients in s.
_LATE = (("reaction_delay", "T"), ("inertia", "tau_v"))


@dataclass(frozen=True)
class Truth:
    """What acts in a case.

    Attributes:
        effects: coefficients by effect; nuisances are part of it.
        amplitude: standard deviation of the drivers' velocities, m/s.
        edge: width over which the edges of a zone or period are smeared, m or s.
    """

    effects: dict[str, Coefficients]
    amplitude: float = 0.0
    edge: float = 0.0

    @property
    def hidden(self) -> Hidden:
        """As the equations of motion take it."""
        fields: dict[str, float] = {}
        for name, values in self.effects.items():
            fields |= {field: values[key] for field, key in EFFECTS[name].fields.items()}
            if name == "speed_zone":
                fields["zone_ramp"] = self.edge
            if name == "speed_period":
                fields["period_ramp"] = self.edge
        return Hidden(**fields)


@dataclass(frozen=True)
class Motion:
    """Simulated platoons at the samples, and the steps before the recording.

    Attributes:
        x: ``(S, K + 1, N)`` m.
        past: ``(S, P + 1, N)`` positions (m) and velocities (m/s) until the first sample.
    """

    x: np.ndarray
    past: tuple[np.ndarray, np.ndarray]


class TrafficCase(Subject):
    """A case of traffic: draws what is hidden, sets its strength, and measures.

    Attributes:
        road: the vehicles and their leaders.

    Raises:
        ConfigError: an effect that traffic does not know.
    """

    def __init__(self, case: Case) -> None:
        check_effects(case, EFFECTS)
        self.case, self.catalogue, self.unit = case, catalogue, "m/s"
        rng = case.generator("effects")
        around = surroundings(case, late=0.0)
        effects = {name: EFFECTS[name].draw(rng, around) for name in case.effects}
        late = sum(effects.get(name, {}).get(key, 0.0) for name, key in _LATE)
        if late:
            around = surroundings(case, late)
        if case.variant == "heterogeneous":
            effects |= {name: nuisance.draw(rng, around) for name, nuisance in NUISANCE.items()}
        edge = 0.0
        if case.variant == "smooth":
            edge = float(rng.uniform(*SMOOTH_EDGE[case.effects[0]]))
        self.road: Road = lay_out(case, around)
        self.clocks, self.correlation = around.clocks, self.road.correlation
        self.truth = Truth(effects, edge=edge)
        self._keep_stable()
        self.amplitude = set_strength(self, rng, AMPLITUDES)

    def measured(self, truth: Truth) -> np.ndarray:
        """``(S, K + 1, N)`` positions with the error of their measurement, m."""
        return self.simulate(truth).x + self.case.sigma * self.road.error

    def columns(self, x: np.ndarray) -> dict[str, np.ndarray]:
        length, kind = np.round(self.road.length, 2), np.where(self.road.truck, "truck", "car")
        return {"x": np.round(x, 4), "length": length, "kind": kind}

    def base(self) -> dict[str, Any]:
        around = self.road.around
        model = {"name": around.law, "options": {}}
        base = {"v0": around.v0, "L": around.L}
        return {"model": model, "base": base, "edge": self.truth.edge}

    def own(self, truth: Truth) -> np.ndarray:
        """``(S, N)`` factor on W of each vehicle."""
        road, factor = self.road, np.ones(self.road.truck.shape)
        if "vehicle_class" in truth.effects:
            factor = np.where(road.truck, truth.effects["vehicle_class"]["phi"], factor)
        if "driver_heterogeneity" in truth.effects:
            factor = factor * (1 + truth.effects["driver_heterogeneity"]["sigma"] * road.eta)
        return factor

    def simulate(self, truth: Truth) -> Motion:
        """How vehicles really move, burnt in."""
        road, around = self.road, self.road.around
        burn = road.burn * SUBSTEPS
        if truth.amplitude:
            kick = truth.amplitude * road.kick
        else:
            kick = np.zeros((len(road.kick), 1, road.kick.shape[2]))
        x, v = simulate(
            LAWS[around.law],
            around.v0,
            around.L,
            truth.hidden,
            self.own(truth),
            road.lead_x,
            road.lead_v,
            road.start,
            road.speed,
            kick,
            around.clocks - BURN_IN,
            -BURN_IN,
            road.step,
            1,
        )
        # two seconds are more than any delay
        first = burn - round(2.0 / road.step)
        past = x[:, first : burn + 1], v[:, first : burn + 1]
        return Motion(x[:, burn::SUBSTEPS], past)

    def recording(self, x: np.ndarray) -> Recording:
        """Positions as a model is compared with them."""
        around = self.road.around
        return Recording(x, around.clocks, self.case.dt, around.law)

    def base_cost(self, x: np.ndarray) -> np.ndarray:
        """``(S,)`` cost (m²) of the recalibrated base law."""
        recording, around = self.recording(x), self.road.around
        return cost_by_sequence(recording.errors(*recording.recalibrated(around.v0, around.L)))

    def oracle_cost(self, x: np.ndarray, motion: Motion, truth: Truth) -> np.ndarray:
        """``(S,)`` cost (m²) of the truth without drivers' noise.

        It starts from the recorded places, behind the recorded leader; of the time before, which
        a delay or an inertia needs, it knows how vehicles really moved.
        """
        past_x, past_v = motion.past
        moved = past_x + (x[:, :1] - past_x[:, -1:])
        around = self.road.around
        error = self.recording(x).errors(
            around.v0, around.L, truth.hidden, self.own(truth), (moved, past_v), SUBSTEPS
        )
        return cost_by_sequence(error)

    def steepest(self) -> float:
        """The largest W' (1/s) that is exceeded in 1 % of the samples."""
        around = self.road.around
        gap = np.diff(self.simulate(self.truth).x, axis=2)
        slope = around.v0 / gap if around.law == "log" else around.v0 * around.L / gap**2
        return float(np.quantile(slope, 0.99))

    def _keep_stable(self) -> None:
        """Shorten a delay or an inertia that would let waves grow along the platoon."""
        effects = self.truth.effects
        late = [(name, key) for name, key in _LATE if name in effects]
        if not late:
            return
        total = sum(effects[name][key] for name, key in late)
        factor = _STABLE / (self.steepest() * total)
        if factor < 1:
            self.rescale({name: factor for name, _ in late})

    def rescaled(self, name: str, values: Coefficients, factor: float) -> Coefficients:
        rescaled = EFFECTS[name].rescaled
        if name in dict(_LATE):
            # it is as large as stability allows
            factor = min(factor, 1.0)
        if rescaled is None or factor == 1.0:
            return values
        return rescaled(values, factor, self.road.around)

    def misfit(self, names: list[str]) -> float:
        kept = {k: v for k, v in self.truth.effects.items() if k in names}
        motion = self.simulate(replace(self.truth, effects=kept, amplitude=0.0))
        return float(self.base_cost(motion.x).mean())

    def spread(self, probe: float) -> float:
        truth = replace(self.truth, amplitude=probe)
        motion = self.simulate(truth)
        return float(self.oracle_cost(motion.x, motion, truth).mean()) / probe**2

    def costs(self, truth: Truth) -> Costs:
        motion = self.simulate(truth)
        x = motion.x + self.case.sigma * self.road.error
        floor = float(np.mean((x - motion.x)[:, :, :-1] ** 2))
        return Costs(self.base_cost(x), self.oracle_cost(x, motion, truth), floor)
