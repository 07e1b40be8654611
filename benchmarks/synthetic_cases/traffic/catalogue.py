"""What can be hidden in traffic: the effects of the catalogue, and some that it lacks.

W is the base law of the gap, v_a the speed of the vehicle ahead, f the product of all factors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Coefficients = dict[str, float]


@dataclass(frozen=True)
class Surroundings:
    """What a coefficient's plausible value depends on.

    Attributes:
        law: ``lin`` or ``log``.
        v0, L: of the base law, m/s and m.
        slow, fast: leaders' range of speeds, m/s.
        clocks: ``(S,)`` start of each sequence, s.
        duration: of a sequence, s.
    """

    law: str
    v0: float
    L: float
    slow: float
    fast: float
    clocks: np.ndarray
    duration: float

    def gap(self, speed: float) -> float:
        """The gap (m) at which the base law gives a speed (m/s)."""
        if self.law == "lin":
            return self.L / (1 - speed / self.v0)
        return self.L * float(np.exp(speed / self.v0))


Rescaling = Callable[[Coefficients, float, Surroundings], Coefficients]


@dataclass(frozen=True)
class Effect:
    """One hidden effect.

    Attributes:
        formula: what it does to W.
        units: of the coefficients.
        draw: random coefficients of plausible size.
        rescaled: the coefficients with the effect's size times a factor, as far as its range
            goes; None where the size is left as it was drawn.
        fields: names in :class:`~benchmarks.synthetic_cases.traffic.motion.Hidden`, and the
            coefficients that go there; others act elsewhere.
    """

    formula: str
    units: dict[str, str]
    draw: Callable[[np.random.Generator, Surroundings], Coefficients]
    rescaled: Rescaling | None
    fields: dict[str, str]


def _towards(name: str, nothing: float, low: float, high: float) -> Rescaling:
    """Scales the distance of one coefficient from the value that means no effect."""

    def rescaled(values: Coefficients, factor: float, _: Surroundings) -> Coefficients:
        value = nothing + factor * (values[name] - nothing)
        return {**values, name: float(np.clip(value, low, high))}

    return rescaled


def _uniform(**limits: tuple[float, float]) -> Callable[..., Coefficients]:
    def draw(rng: np.random.Generator, _: Surroundings) -> Coefficients:
        return {name: float(rng.uniform(*ends)) for name, ends in limits.items()}

    return draw


def _simple(
    formula: str,
    name: str,
    limits: tuple[float, float],
    unit: str = "1",
    *,
    nothing: float = 0.0,
    reach: tuple[float, float] | None = None,
    fields: dict[str, str] | None = None,
) -> Effect:
    """An effect of one coefficient, drawn evenly; ``reach`` is its range where rescaled."""
    return Effect(
        formula=formula,
        units={name: unit},
        draw=_uniform(**{name: limits}),
        rescaled=_towards(name, nothing, *(reach or limits)),
        fields={name: name} if fields is None else fields,
    )


#: Factors on W as drawn, and as strength may move them.
_REDUCED, _REDUCED_REACH = (0.6, 0.85), (0.6, 0.97)


def _zone(rng: np.random.Generator, _: Surroundings) -> Coefficients:
    a = float(rng.uniform(280, 580))
    width = float(rng.uniform(100, 250))
    return {"alpha": float(rng.uniform(*_REDUCED)), "a": a, "b": a + width}


def _period(rng: np.random.Generator, around: Surroundings) -> Coefficients:
    """Both edges lie inside sequences, where they can be seen."""
    clocks, duration = around.clocks, around.duration
    span = clocks[-1] + duration - clocks[0]
    width = min(max(float(rng.uniform(0.14, 0.28)) * span, 60.0), max(200.0, 0.2 * span))
    edges = [k + duration * u for k in clocks for u in (0.3, 0.4, 0.5, 0.6, 0.7)]
    pairs = [(a, b) for a in edges for b in edges if abs(b - a - width) < 0.25 * duration]
    if not pairs:
        a = clocks[0] + 0.3 * span
        pairs = [(a, a + width)]
    a, b = pairs[int(rng.integers(len(pairs)))]
    return {"alpha": float(rng.uniform(*_REDUCED)), "a": float(a), "b": float(b)}


def _asymmetric(rng: np.random.Generator, _: Surroundings) -> Coefficients:
    """Two responses that differ by at least 0.25."""
    low, high = float(rng.uniform(0.0, 0.25)), float(rng.uniform(0.5, 0.7))
    first = bool(rng.integers(2))
    return {"kappa_open": high if first else low, "kappa_close": low if first else high}


def _top_speed(rng: np.random.Generator, around: Surroundings) -> Coefficients:
    share = float(rng.uniform(0.6, 0.85))
    return {"v_max": around.slow + share * (around.fast - around.slow)}


def _nearer_top(values: Coefficients, factor: float, around: Surroundings) -> Coefficients:
    """The nearer to the fastest leader, the less a top speed shows; it always binds sometimes.

    It binds less often and less far at once: the root makes up for the higher power.
    """
    span = around.fast - around.slow
    below = np.sqrt(factor) * (around.fast - values["v_max"])
    return {"v_max": around.fast - float(np.clip(below, 0.12 * span, 0.5 * span))}


def _bump(rng: np.random.Generator, around: Surroundings) -> Coefficients:
    """In the middle of the gaps that occur, too narrow for the base law to follow."""
    near, far = around.gap(around.slow), around.gap(around.fast)
    return {
        "size": float(rng.choice([-1, 1]) * rng.uniform(2.0, 4.0)),
        "gap": float(near + rng.uniform(0.3, 0.5) * (far - near)),
        "width": float(0.1 * (far - near)),
    }


#: Effects of the catalogue that a diagnosis can name where drivers may differ.
CATALOGUE: dict[str, Effect] = {
    "relative_speed": _simple(
        "W + kappa (v_a - W)",
        "kappa",
        (0.2, 0.6),
        fields={"kappa_open": "kappa", "kappa_close": "kappa"},
    ),
    "multi_anticipation": _simple("W + c (W(next gap) - W(gap))", "c", (0.2, 0.5)),
    "reaction_delay": _simple("W(gap(t - T))", "T", (0.3, 1.0), "s", reach=(0.25, 1.0)),
    "inertia": _simple("tau_v dv/dt = W - v", "tau_v", (0.3, 1.2), "s", reach=(0.25, 1.2)),
    "speed_zone": Effect(
        formula="alpha W for x in [a, b]",
        units={"alpha": "1", "a": "m", "b": "m"},
        draw=_zone,
        rescaled=_towards("alpha", 1.0, *_REDUCED_REACH),
        fields={"zone_alpha": "alpha", "zone_a": "a", "zone_b": "b"},
    ),
    "speed_period": Effect(
        formula="alpha W for the clock in [a, b]",
        units={"alpha": "1", "a": "s", "b": "s"},
        draw=_period,
        rescaled=_towards("alpha", 1.0, *_REDUCED_REACH),
        fields={"period_alpha": "alpha", "period_a": "a", "period_b": "b"},
    ),
    "vehicle_class": _simple(
        "phi W where the follower is a truck",
        "phi",
        (0.75, 0.9),
        nothing=1.0,
        reach=(0.75, 0.97),
        fields={},
    ),
    "free_flow_speed": Effect(
        formula="min(W, v_max)",
        units={"v_max": "m/s"},
        draw=_top_speed,
        rescaled=_nearer_top,
        fields={"v_max": "v_max"},
    ),
    # two responses have to stay apart: they are left as they were drawn
    "asymmetric_response": Effect(
        formula="W + kappa_open (v_a - W)+ - kappa_close (v_a - W)-",
        units={"kappa_open": "1", "kappa_close": "1"},
        draw=_asymmetric,
        rescaled=None,
        fields={"kappa_open": "kappa_open", "kappa_close": "kappa_close"},
    ),
    "time_gap": _simple("W with L + h v_a in place of L", "h", (0.1, 0.4), "s"),
}

#: Effects that no member of the catalogue can express.
OUTSIDE: dict[str, Effect] = {
    "rear_pressure": Effect(
        formula="W + push exp(-gap behind / reach)",
        units={"push": "m/s", "reach": "m"},
        draw=_uniform(push=(4.0, 9.0), reach=(8.0, 15.0)),
        rescaled=_towards("push", 0.0, 0.5, 15.0),
        fields={"rear_push": "push", "rear_reach": "reach"},
    ),
    "road_wave": Effect(
        formula="W (1 + size sin(2 pi x / length + phase))",
        units={"size": "1", "length": "m", "phase": "1"},
        draw=_uniform(size=(0.1, 0.3), length=(40.0, 90.0), phase=(0.0, 6.28)),
        rescaled=_towards("size", 0.0, 0.05, 0.4),
        fields={"wave_size": "size", "wave_length": "length", "wave_phase": "phase"},
    ),
    "clock_wave": Effect(
        formula="W (1 + size sin(2 pi clock / length + phase))",
        units={"size": "1", "length": "s", "phase": "1"},
        draw=_uniform(size=(0.05, 0.2), length=(8.0, 16.0), phase=(0.0, 6.28)),
        rescaled=_towards("size", 0.0, 0.03, 0.4),
        fields={"clock_size": "size", "clock_length": "length", "clock_phase": "phase"},
    ),
    "tiring": Effect(
        formula="W (1 - rate times the time since the sequence began)",
        units={"rate": "1/s"},
        draw=_uniform(rate=(0.003, 0.01)),
        rescaled=_towards("rate", 0.0, 0.0015, 0.02),
        fields={"tiring": "rate"},
    ),
    "law_bump": Effect(
        formula="W + size exp(-((own gap - gap) / width)^2 / 2)",
        units={"size": "m/s", "gap": "m", "width": "m"},
        draw=_bump,
        rescaled=_towards("size", 0.0, -6.0, 6.0),
        fields={"bump_size": "size", "bump_gap": "gap", "bump_width": "width"},
    ),
}

#: What acts in the variant ``heterogeneous``: the diagnosis estimates it with the law.
NUISANCE: dict[str, Effect] = {
    "driver_heterogeneity": _simple(
        "(1 + eta_i) W, eta_i normal of mean 0 and standard deviation sigma",
        "sigma",
        (0.04, 0.1),
        fields={},
    )
}

EFFECTS: dict[str, Effect] = {**CATALOGUE, **OUTSIDE, **NUISANCE}

#: What cannot show while every leader keeps its speed and the platoon is in equilibrium.
NEEDS_EXCITATION = (
    "relative_speed",
    "multi_anticipation",
    "reaction_delay",
    "inertia",
    "asymmetric_response",
)

#: Widths over which the edges of near misses are smeared, m and s.
SMOOTH_EDGE = {"speed_zone": (30.0, 70.0), "speed_period": (8.0, 20.0)}
