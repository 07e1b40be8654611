"""What can be hidden in a crowd: the effects of the catalogue, and some that it lacks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Coefficients = dict[str, float]


@dataclass(frozen=True)
class Effect:
    """One hidden effect.

    Attributes:
        formula: the acceleration that it adds; symbols as in
            :class:`benchmarks.synthetic_cases.crowd.motion.Hidden`.
        units: of the coefficients.
        limits: from which each is drawn evenly.
        size: the coefficients that are rescaled where strength asks for it, and the range of
            their absolute value; None where the size is left as it was drawn.
        fields: names in :class:`~benchmarks.synthetic_cases.crowd.motion.Hidden` and the
            coefficients that go there.
        signed: coefficients that are negative half of the time.
        factor: of a place's force; -1 turns a repulsion into an attraction.
    """

    formula: str
    units: dict[str, str]
    limits: dict[str, tuple[float, float]]
    size: tuple[tuple[str, ...], float, float] | None
    fields: dict[str, str]
    signed: tuple[str, ...] = ()
    factor: float = 1.0

    def draw(self, rng: np.random.Generator, width: float) -> Coefficients:
        """Random coefficients; ``width`` is the corridor's, m."""
        found = {}
        for name, (low, high) in self.limits.items():
            value = float(rng.uniform(low, high))
            # places lie at a share of the width
            found[name] = value * width if name in ("y_o", "y_v") else value
            if name in self.signed:
                found[name] *= float(rng.choice([-1, 1]))
        return found

    def rescaled(self, values: Coefficients, factor: float) -> Coefficients:
        """The coefficients with the effect's size times ``factor``, as far as its range goes."""
        if self.size is None:
            return values
        names, low, high = self.size
        found = dict(values)
        for name in names:
            size = float(np.clip(abs(factor * values[name]), low, high))
            found[name] = float(np.copysign(size, values[name]))
        return found

    def acting(self, values: Coefficients) -> dict[str, float]:
        """Values of the fields of the equation of motion."""
        return {
            field: values[name] * (self.factor if field == "A_o" else 1.0)
            for field, name in self.fields.items()
        }


def _drawn(*fields: str) -> dict[str, str]:
    return {name: name for name in fields}


_PLACE = {"A_o": "m/s²", "B_o": "m", "x_o": "m", "y_o": "m"}

#: Effects of the catalogue.
CATALOGUE: dict[str, Effect] = {
    "wall_repulsion": Effect(
        "sum over walls of A_w exp((r - d)/B_w) n, nearest point of each",
        {"A_w": "m/s²", "B_w": "m"},
        {"A_w": (0.3, 1.0), "B_w": (0.2, 0.6)},
        (("A_w",), 0.1, 2.0),
        _drawn("A_w", "B_w"),
    ),
    "pair_repulsion": Effect(
        "sum over j of A_2 exp((2 r - d)/B_2) n",
        {"A_2": "m/s²", "B_2": "m"},
        {"A_2": (0.15, 0.5), "B_2": (0.6, 1.2)},
        (("A_2",), 0.05, 1.5),
        _drawn("A_2", "B_2"),
    ),
    "field_of_view": Effect(
        "base pair force times lambda_ + (1 - lambda_)(1 + cos phi)/2",
        {"lambda_": "1"},
        {"lambda_": (0.0, 0.4)},
        None,
        _drawn("lambda_"),
    ),
    "anticipation": Effect(
        "base pair force at the positions that both will reach in T_a",
        {"T_a": "s"},
        {"T_a": (0.3, 1.0)},
        (("T_a",), 0.2, 1.0),
        _drawn("T_a"),
    ),
    "side_preference": Effect(
        "c (1 - exp(-sum_j h(e_i e_ij) h(-e_i e_j) / (1 + exp((d - 3 m)/0.3 m)))) to the right",
        {"c": "m/s²"},
        {"c": (0.3, 0.8)},
        (("c",), 0.05, 1.2),
        {"side": "c"},
        signed=("c",),
    ),
    "evasive_rotation": Effect(
        "base pair force turned to the left by theta (1 - e_i e_j)/2",
        {"theta": "rad"},
        {"theta": (0.3, 1.0)},
        (("theta",), 0.15, 1.3),
        _drawn("theta"),
        signed=("theta",),
    ),
    "alignment": Effect(
        "c sum_j w (v_j - v_i) / sum_j w, w = exp(-d / 2 m)",
        {"c": "1/s"},
        {"c": (0.15, 0.5)},
        (("c",), 0.03, 1.0),
        {"align": "c"},
    ),
    "group_cohesion": Effect(
        "c (mean place of the others of the group - x)",
        {"c": "1/s²"},
        {"c": (0.2, 0.8)},
        (("c",), 0.05, 1.5),
        {"cohesion": "c"},
    ),
    "obstacle": Effect(
        "A_o exp(-d/B_o) n from a place",
        _PLACE,
        {"A_o": (1.0, 3.0), "B_o": (0.5, 1.0), "x_o": (-2.0, 2.0), "y_o": (0.25, 0.75)},
        (("A_o",), 0.2, 4.0),
        _drawn(*_PLACE),
    ),
    "attraction": Effect(
        "-A_o exp(-d/B_o) n towards a place",
        _PLACE,
        {"A_o": (0.8, 2.0), "B_o": (0.8, 1.5), "x_o": (-2.0, 2.0), "y_o": (0.25, 0.75)},
        (("A_o",), 0.15, 3.0),
        _drawn(*_PLACE),
        factor=-1.0,
    ),
    "drift": Effect(
        "(a_x, a_y)",
        {"a_x": "m/s²", "a_y": "m/s²"},
        {"a_x": (0.04, 0.12), "a_y": (0.06, 0.15)},
        (("a_x", "a_y"), 0.02, 0.6),
        _drawn("a_x", "a_y"),
        signed=("a_x", "a_y"),
    ),
    "preferred_speed": Effect(
        "c (v_pref - |v|) v/|v|",
        {"c": "1/s", "v_pref": "m/s"},
        {"c": (0.3, 0.8), "v_pref": (1.0, 1.7)},
        (("c",), 0.1, 1.5),
        {"pull": "c", "v_pref": "v_pref"},
    ),
    "density_slowdown": Effect(
        "-c rho v, rho = sum_j exp(-d²/(2 m²)) / (2 pi m²)",
        {"c": "m²/s"},
        {"c": (0.2, 0.7)},
        (("c",), 0.05, 1.5),
        {"dense": "c"},
    ),
    "sliding_friction": Effect(
        "sum over j of c exp((2 r - d)/0.5 m) ((v_j - v_i) t) t",
        {"c": "1/s"},
        {"c": (0.2, 0.8)},
        (("c",), 0.05, 2.0),
        {"friction": "c"},
    ),
    "gait_sway": Effect(
        "a sin(2 pi f clock + phase_i) to the right, phase_i even",
        {"a": "m/s²", "f": "Hz"},
        {"a": (0.7, 2.0), "f": (0.8, 1.1)},
        (("a",), 0.2, 2.5),
        {"sway": "a", "sway_f": "f"},
    ),
    "walker_heterogeneity": Effect(
        "relaxation times 1 + eta_i, eta_i normal of mean 0 and standard deviation sigma",
        {"sigma": "1"},
        {"sigma": (0.2, 0.4)},
        (("sigma",), 0.15, 0.45),
        {},
    ),
}

#: Effects that no member of the catalogue can express.
OUTSIDE: dict[str, Effect] = {
    "vortex": Effect(
        "around a place: size exp(-d²/(2 reach²)) d/reach, to the left of n",
        {"size": "m/s²", "x_v": "m", "y_v": "m", "reach": "m"},
        {"size": (0.6, 1.5), "x_v": (-1.5, 1.5), "y_v": (0.3, 0.7), "reach": (1.2, 2.5)},
        (("size",), 0.1, 3.0),
        {"spin": "size", "spin_x": "x_v", "spin_y": "y_v", "spin_s": "reach"},
        signed=("size",),
    ),
    "common_push": Effect(
        "size sin(2 pi clock / period + phase) along y, the same for all",
        {"size": "m/s²", "period": "s", "phase": "1"},
        {"size": (0.3, 0.8), "period": (2.0, 3.6), "phase": (0.0, 6.28)},
        (("size",), 0.05, 1.5),
        {"push": "size", "push_T": "period", "push_0": "phase"},
    ),
    "lane_wave": Effect(
        "size sin(2 pi x / length + phase) along y",
        {"size": "m/s²", "length": "m", "phase": "1"},
        {"size": (0.3, 0.8), "length": (2.5, 5.0), "phase": (0.0, 6.28)},
        (("size",), 0.05, 1.5),
        {"wave": "size", "wave_L": "length", "wave_0": "phase"},
    ),
    "tiring": Effect(
        "-rate times the time since the sequence began, along the walking direction",
        {"rate": "m/s³"},
        {"rate": (0.04, 0.1)},
        (("rate",), 0.015, 0.2),
        {"tiring": "rate"},
    ),
}

EFFECTS: dict[str, Effect] = {**CATALOGUE, **OUTSIDE}

#: What cannot show while all people walk the same way at the same speed.
NEEDS_EXCITATION = (
    "anticipation",
    "side_preference",
    "evasive_rotation",
    "alignment",
    "sliding_friction",
)
