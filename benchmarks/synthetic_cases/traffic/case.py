"""Synthetic measured platoons in which an effect is hidden."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from benchmarks.synthetic_cases.case import Case
from benchmarks.synthetic_cases.catalogue import CATALOGUES, Coefficients
from benchmarks.synthetic_cases.noise import ornstein_uhlenbeck
from benchmarks.synthetic_cases.subject import Range, Subject, Truth
from benchmarks.synthetic_cases.traffic.motion import Base, Hidden, simulate

#: Steps of Runge–Kutta's method between two samples, and for a smooth right-hand side.
SUBSTEPS, _COARSE = 20, 4
#: Seconds that a platoon drives before it is recorded (transients fade, delays get a past), and
#: those that an oracle knows, which are more than any delay.
BURN_IN, _PAST = 30.0, 2.0
#: Seconds of the clock from one sequence's start to the next, beyond the sequence's length.
_PAUSE = (1.0, 11.0)
#: Where the last vehicle is about to be when recording begins, m.
_START = (0.0, 350.0)
#: A delay or an inertia of this many seconds times W' keeps a platoon stable, with a margin; the
#: largest product that may occur.
_STABLE, _UNSTABLE = 0.33, 0.4
#: Leaders vary their speed by at least this much, m/s.
_SMALLEST_RANGE = 6.0
_TRUCKS = 0.25
#: Drivers' disturbances are correlated over this time, s; in the variant ``recording`` over that.
_CORRELATION, _LASTING = (2.0, 5.0), 6.0
#: Effects that make vehicles react late, and their coefficients in s.
_LATE = {"reaction_delay": "T", "inertia": "tau_v"}
#: Widths over which the edges of near misses are smeared, m and s.
_SMOOTH_EDGE = {"speed_zone": (30.0, 70.0), "speed_period": (8.0, 20.0)}


class Motion(NamedTuple):
    """Simulated platoons.

    Attributes:
        x: ``(S, K + 1, N)`` positions at the samples, m.
        past: ``(S, P + 1, N)`` positions (m) and velocities (m/s) at the steps until the first
            sample.
    """

    x: np.ndarray
    past: tuple[np.ndarray, np.ndarray]


class TrafficCase(Subject):
    """A case of traffic: S platoons of N vehicles, whose leader is the last one.

    Attributes:
        slow, fast: leaders' range of speeds, m/s.
        lead: ``(S, 2 M + 1)`` positions (m) and speeds (m/s) of the leaders at the M whole and at
            the half steps; the burn-in is part of it.
        start: ``(S, 1, N)`` positions (m) and velocities (m/s) at the start of the burn-in.
        kick: ``(S, M + 1, N)`` disturbance of velocities, of variance 1.
        truck: ``(S, N)`` booleans. length: of the vehicles, m.
        eta: ``(S, N)`` of mean 0 and variance 1 among the followers.
    """

    unit = "m/s"
    range = Range(preferred=(0.02, 0.6), extreme=(0.005, 1.5), idle=(0.1, 0.4), probe=0.05)
    lowest = (1.0, 2.0)
    tolerance = 1e-7

    def __init__(self, case: Case) -> None:
        self.case, self.step = case, case.size[2] / SUBSTEPS
        rng, catalogue = case.generator("effects"), CATALOGUES["traffic"]
        self._set_surroundings(late=0.0)
        effects = {}
        for name in case.effects:
            special = DRAWS[name](rng, self) if name in DRAWS else {}
            values = special | catalogue.effects[name].draw(rng)
            effects[name] = {key: values[key] for key in catalogue.effects[name].coefficients}
        late = sum(effects[name][key] for name, key in _LATE.items() if name in effects)
        if late:
            self._set_surroundings(late)
        if case.variant == "heterogeneous":
            effects |= {name: nuisance.draw(rng) for name, nuisance in catalogue.nuisance.items()}
        edge = 0.0
        if case.variant == "smooth":
            edge = float(rng.uniform(*_SMOOTH_EDGE[case.effects[0]]))
        self.truth = Truth(effects, smooth=edge)
        self._lay_out()
        if late and (factor := _UNSTABLE / (self.steepest() * late)) < 1:
            # waves would grow along the platoon
            self.rescale({name: factor for name in _LATE if name in effects})
        self.set_strength(rng)

    def gap(self, speed: float) -> float:
        """The gap (m) at which the base law gives a speed (m/s)."""
        v0, L, logarithmic = self.law
        return L * float(np.exp(speed / v0)) if logarithmic else L / (1 - speed / v0)

    def steepest(self) -> float:
        """The largest W' (1/s) that is exceeded in 1 % of the samples."""
        gap = np.diff(self.simulate(self.truth).x, axis=2)
        v0, L, logarithmic = self.law
        return float(np.quantile(v0 / gap if logarithmic else v0 * L / gap**2, 0.99))

    def simulate(self, truth: Truth, some: slice = slice(None)) -> Motion:
        burn = round(BURN_IN / self.step)
        x, v = simulate(
            self.law,
            self._hidden(truth),
            self._own(truth),
            self.lead,
            self.start,
            truth.amplitude * self.kick,
            self.clocks - BURN_IN,
            -BURN_IN,
            self.step,
        )
        past = slice(burn - round(_PAST / self.step), burn + 1)
        return Motion(x[:, burn::SUBSTEPS], (x[:, past], v[:, past]))

    def errors(
        self, motion: Motion, measured: np.ndarray, parameters: object, truth: Truth | None = None
    ) -> np.ndarray:
        """Every platoon starts where it was recorded, behind its recorded leader.

        Of the time before, which a delay or an inertia needs, the truth knows how vehicles really
        moved.
        """
        sequences, samples, vehicles = measured.shape
        hidden, own, substeps = Hidden(), np.ones((sequences, vehicles)), _COARSE
        past = measured[:, :1], np.zeros((sequences, 1, vehicles))
        if truth is not None:
            hidden, own, substeps = self._hidden(truth), self._own(truth), SUBSTEPS
            past = motion.past[0] + (measured[:, :1] - motion.past[0][:, -1:]), motion.past[1]
        half = np.arange(2 * substeps * (samples - 1) + 1) / (2 * substeps)
        k = np.minimum(half.astype(int), samples - 2)
        away = np.diff(measured[:, :, -1], axis=1)[:, k]
        dt = self.case.size[2]
        simulated, _ = simulate(
            Base(*map(float, parameters), self.law.logarithmic),  # type: ignore[call-arg, call-overload]
            hidden,
            own,
            (measured[:, k, -1] + away * (half - k), away / dt),
            past,
            np.zeros((sequences, substeps * (samples - 1) + 1, vehicles)),
            self.clocks,
            0.0,
            dt / substeps,
            substeps,
        )
        return simulated - measured

    def squares(self, error: np.ndarray) -> np.ndarray:
        return error[:, :, :-1] ** 2

    def columns(self, x: np.ndarray) -> dict[str, np.ndarray]:
        length, kind = np.round(self.length, 2), np.where(self.truck, "truck", "car")
        return {"x": np.round(x, 4), "length": length, "kind": kind}

    def rescaled(self, name: str, values: Coefficients, factor: float) -> Coefficients:
        if name in _LATE:
            # it is as large as stability allows
            factor = min(factor, 1.0)
        if factor == 1.0:
            return values
        if name == "free_flow_speed":
            # The nearer to the fastest leader, the less a top speed shows; it always binds
            # sometimes. It binds less often and less far at once: the root makes up for the
            # higher power.
            span = self.fast - self.slow
            below = np.sqrt(factor) * (self.fast - values["v_max"])
            return {"v_max": self.fast - float(np.clip(below, 0.12 * span, 0.5 * span))}
        return super().rescaled(name, values, factor)

    def _hidden(self, truth: Truth) -> Hidden:
        return Hidden(**self.fields(truth), zone_ramp=truth.smooth, period_ramp=truth.smooth)

    def _own(self, truth: Truth) -> np.ndarray:
        """``(S, N)`` factor on W of each vehicle."""
        factor = np.ones(self.truck.shape)
        if "vehicle_class" in truth.effects:
            factor = np.where(self.truck, truth.effects["vehicle_class"]["phi"], factor)
        if "driver_heterogeneity" in truth.effects:
            factor = factor * (1 + truth.effects["driver_heterogeneity"]["sigma"] * self.eta)
        return factor

    def _set_surroundings(self, late: float) -> None:
        """Base law, range of speeds and clocks.

        Args:
            late: seconds by which drivers or vehicles react late; W' stays so small that no wave
                grows from it without bound.
        """
        rng = self.case.generator("law")
        _, duration, dt = self.case.size
        logarithmic = bool(rng.uniform() < 0.2)
        v0 = float(rng.uniform(*((10, 15) if logarithmic else (26, 34))))
        L = float(rng.uniform(7, 10))
        fast = 23.0 if logarithmic else min(25.0, 0.85 * v0)
        slow = 8.0
        if late > 0:
            # the speed at which W' = _STABLE / late
            if logarithmic:
                slow = max(slow, v0 * float(np.log(v0 * late / (L * _STABLE))))
            else:
                slow = max(slow, v0 - float(np.sqrt(_STABLE / late * v0 * L)))
        self.slow, self.fast = min(slow, fast - _SMALLEST_RANGE), fast
        pause = rng.uniform(*_PAUSE, self.case.n_sequences)
        clocks = np.cumsum(duration + pause) - duration - pause[0]
        # on the sampling grid: the same time reads the same in all rows
        self.clocks = np.round(clocks / dt) * dt
        self.law, self.base = Base(v0, L, logarithmic), {"v0": v0, "L": L}
        self.model = {"name": "log" if logarithmic else "lin", "options": {}}

    def _lay_out(self) -> None:
        """Everything random about a case's platoons, except what is hidden."""
        case = self.case
        sequences, vehicles = case.n_sequences, case.size[0]
        burn = round(BURN_IN / case.size[2]) * SUBSTEPS
        steps = burn + case.n_steps * SUBSTEPS
        half = 0.5 * self.step * np.arange(2 * steps + 1)
        lead_x, lead_v = self._leaders(case.generator("leaders"), half)

        rng, spread = case.generator("places"), 0.0 if case.arm == "no_excitation" else 0.08
        gap = np.array([self.gap(float(v)) for v in lead_v[:, 0]])
        factors = np.exp(rng.normal(0, spread, (sequences, vehicles)))
        behind = np.cumsum((gap[:, None] * factors)[:, ::-1], axis=1)[:, ::-1] - gap[:, None]
        behind[:, -1] = 0.0
        # where recording begins the last vehicle is about to be near ``first``
        first = rng.uniform(*_START, sequences)
        lead_x = lead_x + (first - lead_x[:, 2 * burn] + behind[:, 0])[:, None]
        self.lead = lead_x, lead_v
        speed = np.repeat(lead_v[:, :1], vehicles, axis=1)
        self.start = (lead_x[:, :1] - behind)[:, None], speed[:, None]

        rng = case.generator("vehicles")
        self.truck = rng.uniform(size=(sequences, vehicles)) < _TRUCKS
        car_length = rng.uniform(3.9, 4.9, self.truck.shape)
        self.length = np.where(self.truck, rng.uniform(6.2, 6.9, self.truck.shape), car_length)
        eta = rng.standard_normal(self.truck.shape)
        followers = eta[:, :-1]
        self.eta = (eta - followers.mean()) / followers.std()

        rng = case.generator("drivers")
        self.correlation = float(rng.uniform(*_CORRELATION))
        if case.variant == "recording":
            self.correlation = _LASTING
        kick = ornstein_uhlenbeck(
            rng,
            (sequences, vehicles, steps + 1),
            step=self.step,
            correlation=self.correlation,
            heavy_tails=case.variant == "heavy_tails",
        )
        self.kick = np.ascontiguousarray(kick.transpose(0, 2, 1))
        shape = sequences, case.n_steps + 1, vehicles
        self.error = case.generator("measurement").standard_normal(shape)

    def _leaders(self, rng: np.random.Generator, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions from 0 and speeds of leaders, ``(S, len(time))``; brakings and accelerations.

        Without excitation leaders keep their speeds, which are spread over the range, so that the
        base law itself can be seen.
        """
        slow, fast, number = self.slow, self.fast, self.case.n_sequences
        if self.case.arm == "no_excitation":
            place = (np.arange(number) + rng.uniform(0.2, 0.8, number)) / number
            level = slow + rng.permutation(place) * (fast - slow)
            return level[:, None] * time, np.repeat(level[:, None], len(time), axis=1)
        x, v = [], []
        for _ in range(number):
            knots = [0.0]
            while knots[-1] < time[-1]:
                knots.append(knots[-1] + float(rng.uniform(4, 9)))
            speeds = [float(rng.uniform(slow, fast))]
            for before, after in pairwise(knots):
                # no braking above 3 and no acceleration above 2 m/s² at the steepest point
                room = (after - before) / 1.5
                low = max(slow, speeds[-1] - 3.0 * room)
                high = min(fast, speeds[-1] + 2.0 * room)
                speeds.append(float(rng.uniform(low, high)))
            curve = PchipInterpolator(knots, speeds)
            x.append(curve.antiderivative()(time))
            v.append(curve(time))
        return np.array(x), np.array(v)


def _zone(rng: np.random.Generator, _: TrafficCase) -> Coefficients:
    a = float(rng.uniform(280, 580))
    return {"a": a, "b": a + float(rng.uniform(100, 250))}


def _period(rng: np.random.Generator, case: TrafficCase) -> Coefficients:
    """Both edges lie inside sequences, where they can be seen."""
    clocks, duration = case.clocks, case.case.size[1]
    span = clocks[-1] + duration - clocks[0]
    width = min(max(float(rng.uniform(0.14, 0.28)) * span, 60.0), max(200.0, 0.2 * span))
    edges = [k + duration * u for k in clocks for u in (0.3, 0.4, 0.5, 0.6, 0.7)]
    pairs = [(a, b) for a in edges for b in edges if abs(b - a - width) < 0.25 * duration]
    if not pairs:
        a = clocks[0] + 0.3 * span
        pairs = [(a, a + width)]
    a, b = pairs[int(rng.integers(len(pairs)))]
    return {"a": float(a), "b": float(b)}


def _asymmetric(rng: np.random.Generator, _: TrafficCase) -> Coefficients:
    """Two responses that differ by at least 0.25."""
    values = [float(rng.uniform(0.0, 0.25)), float(rng.uniform(0.5, 0.7))]
    if rng.integers(2):
        values.reverse()
    return dict(zip(("kappa_open", "kappa_close"), values, strict=True))


def _top_speed(rng: np.random.Generator, case: TrafficCase) -> Coefficients:
    return {"v_max": case.slow + float(rng.uniform(0.6, 0.85)) * (case.fast - case.slow)}


def _bump(rng: np.random.Generator, case: TrafficCase) -> Coefficients:
    """In the middle of the gaps that occur, too narrow for the base law to follow."""
    near, far = case.gap(case.slow), case.gap(case.fast)
    return {
        "size": float(rng.choice([-1, 1]) * rng.uniform(2.0, 4.0)),
        "gap": float(near + rng.uniform(0.3, 0.5) * (far - near)),
        "width": float(0.1 * (far - near)),
    }


#: Effects whose coefficients depend on each other, on leaders or on the clock.
DRAWS = {
    "speed_zone": _zone,
    "speed_period": _period,
    "asymmetric_response": _asymmetric,
    "free_flow_speed": _top_speed,
    "law_bump": _bump,
}
