"""Synthetic measured crowds in which an effect is hidden."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.synthetic_cases.case import Case, check_effects
from benchmarks.synthetic_cases.crowd import catalogue
from benchmarks.synthetic_cases.crowd.catalogue import EFFECTS, Coefficients
from benchmarks.synthetic_cases.crowd.motion import Hidden, simulate
from benchmarks.synthetic_cases.crowd.replay import Windows, cost_by_sequence
from benchmarks.synthetic_cases.crowd.scene import BURN_IN, SUBSTEPS, Scene, set_scene
from benchmarks.synthetic_cases.strength import Costs, Range, Subject, set_strength

#: Standard deviation of people's accelerations, m/s².
AMPLITUDES = Range(preferred=(0.02, 0.15), extreme=(0.005, 0.35), idle=(0.04, 0.15), probe=0.02)
#: Standard deviation of eta where people differ and that is a nuisance.
_NUISANCE = (0.15, 0.35)
#: So many crowds show how large a misfit or a displacement is about; all show the share.
_SOME = 8
#: Steps between two samples when the truth is replayed.
_FINE = 2


@dataclass(frozen=True)
class Truth:
    """What acts in a case.

    Attributes:
        effects: coefficients by effect; nuisances are part of it.
        amplitude: standard deviation of people's accelerations, m/s².
        bell: places act by a bell curve, not by an exponential.
    """

    effects: dict[str, Coefficients]
    amplitude: float = 0.0
    bell: bool = False

    @property
    def hidden(self) -> Hidden:
        """As the equations of motion take it."""
        fields: dict[str, float] = {"bell": float(self.bell)}
        for name, values in self.effects.items():
            fields |= EFFECTS[name].acting(values)
        return Hidden(**fields)

    @property
    def eta(self) -> float:
        """Standard deviation of how vigorously people steer."""
        return self.effects.get("walker_heterogeneity", {}).get("sigma", 0.0)


class CrowdCase(Subject):
    """A case of crowds: draws what is hidden, sets its strength, and measures.

    Attributes:
        scene: the people and the corridor.

    Raises:
        ConfigError: an effect that crowds do not know.
    """

    def __init__(self, case: Case) -> None:
        check_effects(case, EFFECTS)
        self.case, self.catalogue, self.unit = case, catalogue, "m/s²"
        self.scene: Scene = set_scene(case)
        self.clocks, self.correlation = self.scene.clocks, self.scene.correlation
        self.walls = self.scene.segments
        self._some = list(range(min(_SOME, case.n_sequences)))
        rng = case.generator("effects")
        effects = {name: EFFECTS[name].draw(rng, self.scene.width) for name in case.effects}
        if case.variant == "heterogeneous":
            effects["walker_heterogeneity"] = {"sigma": float(rng.uniform(*_NUISANCE))}
        self.truth = Truth(effects, bell=case.variant == "smooth")
        self.amplitude = set_strength(self, rng, AMPLITUDES)

    def simulate(self, truth: Truth, scene: Scene | None = None) -> tuple[np.ndarray, np.ndarray]:
        """``(S, K + 1, N, 2)`` positions (m) and velocities (m/s), burnt in."""
        scene = self.scene if scene is None else scene
        sequences, people = scene.group.shape
        burn = round(BURN_IN / self.case.dt)
        kick = np.zeros((sequences, 1, people, 2))
        if truth.amplitude:
            kick = truth.amplitude * scene.kick
        x, v = simulate(
            scene.base,
            truth.hidden,
            scene.x,
            scene.v,
            scene.goal,
            scene.group,
            truth.eta * scene.eta,
            scene.phase,
            scene.points,
            scene.segments,
            kick,
            scene.clocks - BURN_IN,
            np.full(sequences, -BURN_IN),
            scene.step,
            (burn + self.case.n_steps) * SUBSTEPS,
            SUBSTEPS,
        )
        return x[:, burn:], v[:, burn:]

    def measured(self, truth: Truth) -> np.ndarray:
        """``(S, K + 1, N, 2)`` positions with the error of their measurement, m."""
        return np.asarray(self.simulate(truth)[0] + self.case.sigma * self.scene.error)

    def columns(self, x: np.ndarray) -> dict[str, np.ndarray]:
        scene, runs = self.scene, np.array(self.case.runs)[:, None]
        group = np.char.add(runs, np.char.add("g", scene.group.astype(str)))
        return {
            "x": np.round(x[..., 0], 5),
            "y": np.round(x[..., 1], 5),
            "group": np.where(scene.group < 0, "", group),
            "dest_x": np.round(scene.goal[..., 0], 4),
            "dest_y": np.round(scene.goal[..., 1], 4),
        }

    def base(self) -> dict[str, Any]:
        base = self.scene.base
        options = {"B": base.B, "r": base.r, "tau": base.tau}
        parameters = {"A": base.A, "k": base.k, "kappa": base.kappa}
        return {"model": {"name": "sf", "options": options}, "base": parameters}

    def rescaled(self, name: str, values: Coefficients, factor: float) -> Coefficients:
        return EFFECTS[name].rescaled(values, factor)

    def misfit(self, names: list[str]) -> float:
        kept = {k: v for k, v in self.truth.effects.items() if k in names}
        some = self.scene.only(self._some)
        x, v = self.simulate(replace(self.truth, effects=kept, amplitude=0.0), some)
        windows = Windows(some, x, v, x, self.case.dt)
        error = windows.errors(windows.recalibrated(some.base))
        return float(cost_by_sequence(error).mean())

    def spread(self, probe: float) -> float:
        truth, some = replace(self.truth, amplitude=probe), self.scene.only(self._some)
        x, v = self.simulate(truth, some)
        windows = Windows(some, x, v, x, self.case.dt)
        return float(self._oracle(windows, truth).mean()) / probe**2

    def costs(self, truth: Truth) -> Costs:
        x, v = self.simulate(truth)
        measured = x + self.case.sigma * self.scene.error
        windows = Windows(self.scene, x, v, measured, self.case.dt)
        base = cost_by_sequence(windows.errors(windows.recalibrated(self.scene.base)))
        floor = float(((measured - x) ** 2).sum(-1).mean())
        return Costs(base, self._oracle(windows, truth), floor)

    def _oracle(self, windows: Windows, truth: Truth) -> np.ndarray:
        error = windows.errors(self.scene.base, truth.hidden, eta=truth.eta, substeps=_FINE)
        return cost_by_sequence(error)
