"""The laws that are compared, with and without effects, and where their calibrations start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nnode.calibrate.parameters import ParameterVector
from nnode.calibrate.pooling import random_starts
from nnode.calibrate.problem import ResidualProblem
from nnode.model.build import build_model
from nnode.model.laws import CAR_FOLLOWING_LAWS, NEURONS
from nnode.model.system import System
from studies.following import printed

#: Cost of a network's weight of 1, m: networks of so few pairs are kept flat.
DECAY = 1e-3

#: A network that is told the time gap that a driver keeps at first, and how it fades.
_REMEMBERING: dict[str, Any] = {
    "parameters": {
        "tau_m": {"value": "30 s", "low": "1 s", "high": "2000 s"},
        "T": {"value": "1.2 s", "low": "0.05 s", "high": "5 s"},
    },
    "constants": {"s0": "2 m", "slowest": "2 m/s", "shortest": "0.1 s", "longest": "5 s"},
    "states": {
        "q": [
            "s",
            "(T - q)/tau_m",
            "clip((gap - length_1 - s0)/max(v, slowest), shortest, longest)",
        ]
    },
    "where": {"net": "gap - length_1"},
    "rate": {"v": "NN(net/20, v/10, dv/2, q)"},
    "source": "acceleration as a network of gap, speed, speed difference and a fading time gap",
}


@dataclass(frozen=True)
class Candidate:
    """A law, and what is added to it.

    Attributes:
        law: its name.
        effects: of the catalogue.
        network: neurons of a network beside the law; None: none, or the law's own.
        description: of the law; None: that of :data:`nnode.model.laws.CAR_FOLLOWING_LAWS`.
    """

    law: str
    effects: tuple[str, ...] = ()
    network: int | None = None
    description: Mapping[str, Any] | None = None

    def system(self, seed: int = 0) -> System:
        """The model behind a measured leader; weights of a network depend on the seed.

        In place of Runge and Kutta's steps it has those of the published comparisons, ballistic
        ones of 0.1 s (Treiber & Kanagaraj 2015). Maps keep their own steps.
        """
        law = dict(self.description or CAR_FOLLOWING_LAWS[self.law])
        if law.get("step") == "rk4":
            law["step"] = "ballistic"
        return build_model(
            {
                "term": "formula",
                "name": self.law,
                "leader": "measured",
                "law": law,
                "network": NEURONS.get(self.law, self.network),
                "effects": [{"name": effect} for effect in self.effects],
            },
            seed=seed,
        )


def candidate(name: str) -> Candidate:
    """The law and the effects of a name such as ``idm + reaction delay + network 4``."""
    law, *added = name.replace(" ", "_").split("_+_")
    neurons = [int(part.removeprefix("network_")) for part in added if "network" in part]
    effects = tuple(part for part in added if "network" not in part)
    return Candidate(law, effects, *neurons)


def published_law(name: str, values: dict[str, float]) -> dict[str, Any]:
    """A law of :data:`nnode.model.laws.CAR_FOLLOWING_LAWS` with published parameters, its
    acceleration clipped, in the published steps, ballistic ones.

    Args:
        values: by parameter, SI units.
    """
    law, (low, high) = CAR_FOLLOWING_LAWS[name], printed.clipped[name]
    ends = {"least_rate": f"{low} m/s²", "most_rate": f"{high} m/s²"}
    return {
        **law,
        "parameters": {name: f"{value!r} {printed.units[name]}" for name, value in values.items()},
        "constants": {**law.get("constants", {}), **ends},
        "rate": {"v": f"clip({law['rate']['v']}, least_rate, most_rate)"},
        "step": "ballistic",
    }


def key(name: str) -> str:
    """A candidate's name as a file name."""
    return name.replace(" + ", "-").replace(" ", "_")


#: Names to candidates. More than one leader is no candidate, because a pair has one.
EVERY: dict[str, Candidate] = {
    **{
        name: candidate(name)
        for name in (
            *CAR_FOLLOWING_LAWS,
            "idm + memory",
            "idm + inertia",
            "idm + reaction delay",
            "helly + memory",
            "helly + inertia",
            "helly + reaction delay",
            "gipps + memory",
            "krauss + memory",
            "fvdm + reaction delay",
            "idm + memory + inertia",
            "idm + memory + reaction delay",
            "helly + memory + inertia",
            "helly + memory + reaction delay",
            "idm + network 4",
            "idm + memory + network 4",
            "helly + memory + network 4",
        )
    },
    "remembering network": Candidate("remembering_network", network=4, description=_REMEMBERING),
}

#: What others are compared with.
REFERENCE = "idm"


def starts(model: Candidate, cost: ResidualProblem, number: int, seed: int) -> np.ndarray:
    """``(number, P)`` rows: the shelf's own values, then random ones within the limits.

    Weights of networks are drawn as models draw them, those beside a law start at 0 in their
    last layer.
    """
    systems = (model.system(seed + i) for i in range(number))
    rows = (ParameterVector(system, cost.vector.places).row.numpy() for system in systems)
    return random_starts(cost, rows, seed)


def decay(cost: ResidualProblem) -> tuple[np.ndarray, np.ndarray] | None:
    """Centre and weights of the penalty on a network's weights; None where there is none."""
    free = ~(np.isfinite(cost.low) & np.isfinite(cost.high))
    return (np.zeros(len(free)), DECAY * free) if free.any() else None
