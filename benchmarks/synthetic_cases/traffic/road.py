"""The stage on which traffic plays: leaders, clocks, places, vehicles and the moods of drivers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import PchipInterpolator

from benchmarks.synthetic_cases.case import Case
from benchmarks.synthetic_cases.noise import ornstein_uhlenbeck
from benchmarks.synthetic_cases.traffic.catalogue import Surroundings

#: Steps of Runge–Kutta's method between two samples.
SUBSTEPS = 20
#: Seconds that a platoon drives before it is recorded: transients fade, delays get a past.
BURN_IN = 30.0
#: Seconds of the clock from one sequence's start to the next, beyond the sequence's length.
_PAUSE = (1.0, 11.0)
#: Where the last vehicle is about to be when recording begins, m.
_START = (0.0, 350.0)
#: A delay or an inertia of this many seconds times W' keeps a platoon stable, with a margin.
_STABLE = 0.33
#: Leaders vary their speed by at least this much, m/s.
_LEAST_RANGE = 6.0
_TRUCKS = 0.25
#: Drivers' disturbances are correlated over this time, s; in the variant ``recording`` over that.
_CORRELATION, _LASTING = (2.0, 5.0), 6.0


@dataclass(frozen=True)
class Road:
    """S platoons of N vehicles before anyone has moved; M steps, K + 1 samples.

    Attributes:
        around: base law, leaders' speeds, clocks.
        step: of Runge–Kutta's method, s.
        lead_x, lead_v: ``(S, 2 M + 1)`` of the leaders at whole and half steps, m and m/s; the
            burn-in is part of it.
        start: ``(S, 1, N)`` positions at the start of the burn-in, m.
        speed: ``(S, 1, N)`` velocities there, m/s.
        kick: ``(S, M + 1, N)`` disturbance of velocities, of variance 1.
        correlation: its correlation time, s.
        error: ``(S, K + 1, N)`` error of the measured positions, of variance 1.
        truck: ``(S, N)`` booleans.
        length: ``(S, N)`` of the vehicles, m.
        eta: ``(S, N)`` of mean 0 and variance 1 among the followers.
    """

    around: Surroundings
    step: float
    lead_x: np.ndarray
    lead_v: np.ndarray
    start: np.ndarray
    speed: np.ndarray
    kick: np.ndarray
    correlation: float
    error: np.ndarray
    truck: np.ndarray
    length: np.ndarray
    eta: np.ndarray

    @property
    def burn(self) -> int:
        """Samples before the recording begins."""
        return round(BURN_IN / (self.step * SUBSTEPS))


def surroundings(case: Case, late: float) -> Surroundings:
    """Base law, range of speeds and clocks.

    Args:
        late: seconds by which drivers or vehicles react late; W' stays so small that no wave
            grows from it without bound.
    """
    rng = case.generator("law")
    law = "log" if rng.uniform() < 0.2 else "lin"
    if law == "lin":
        v0, L = float(rng.uniform(26, 34)), float(rng.uniform(7, 10))
        fast = min(25.0, 0.85 * v0)
    else:
        v0, L = float(rng.uniform(10, 15)), float(rng.uniform(7, 10))
        fast = 23.0
    slow = 8.0
    if late > 0:
        # the speed at which W' = _STABLE / late
        if law == "lin":
            slow = max(slow, v0 - float(np.sqrt(_STABLE / late * v0 * L)))
        else:
            slow = max(slow, v0 * float(np.log(v0 * late / (L * _STABLE))))
    slow = min(slow, fast - _LEAST_RANGE)
    pause = rng.uniform(*_PAUSE, case.n_sequences)
    clocks = np.cumsum(case.duration + pause) - case.duration - pause[0]
    # on the sampling grid: the same time reads the same in all rows
    clocks = np.round(clocks / case.dt) * case.dt
    return Surroundings(law, v0, L, slow, fast, clocks, case.duration)


def lay_out(case: Case, around: Surroundings) -> Road:
    """Everything random about a case's platoons, except what is hidden."""
    sequences, vehicles = case.n_sequences, case.n_agents
    step = case.dt / SUBSTEPS
    steps = round(BURN_IN / case.dt) * SUBSTEPS + case.n_steps * SUBSTEPS
    rng = case.generator("leaders")
    half = 0.5 * step * np.arange(2 * steps + 1)
    constant = case.arm == "no_excitation"
    lead_x, lead_v = _leaders(rng, sequences, half, around, constant=constant)

    rng = case.generator("places")
    gap = np.array([around.gap(float(v)) for v in lead_v[:, 0]])
    spread = np.exp(rng.normal(0, 0.0 if constant else 0.08, (sequences, vehicles)))
    behind = np.cumsum((gap[:, None] * spread)[:, ::-1], axis=1)[:, ::-1] - gap[:, None]
    behind[:, -1] = 0.0
    # where recording begins the last vehicle is about to be near ``first``
    first = rng.uniform(*_START, sequences)
    driven = lead_x[:, 2 * round(BURN_IN / step)]
    lead_x = lead_x + (first - driven + behind[:, 0])[:, None]
    start = lead_x[:, :1] - behind
    speed = np.repeat(lead_v[:, :1], vehicles, axis=1)

    rng = case.generator("vehicles")
    truck = rng.uniform(size=(sequences, vehicles)) < _TRUCKS
    car_length = rng.uniform(3.9, 4.9, truck.shape)
    length = np.where(truck, rng.uniform(6.2, 6.9, truck.shape), car_length)
    eta = rng.standard_normal(truck.shape)
    own = eta[:, :-1]
    eta = (eta - own.mean()) / own.std()

    rng = case.generator("drivers")
    correlation = float(rng.uniform(*_CORRELATION))
    if case.variant == "recording":
        correlation = _LASTING
    kick = ornstein_uhlenbeck(
        rng,
        (sequences, vehicles, steps + 1),
        step=step,
        correlation=correlation,
        heavy_tails=case.variant == "heavy_tails",
    )
    error = case.generator("measurement").standard_normal((sequences, case.n_steps + 1, vehicles))
    return Road(
        around=around,
        step=step,
        lead_x=lead_x,
        lead_v=lead_v,
        start=start[:, None],
        speed=speed[:, None],
        kick=np.ascontiguousarray(kick.transpose(0, 2, 1)),
        correlation=correlation,
        error=error,
        truck=truck,
        length=length,
        eta=eta,
    )


def _leaders(
    rng: np.random.Generator,
    number: int,
    time: np.ndarray,
    around: Surroundings,
    *,
    constant: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions from 0 and speeds of leaders, ``(S, len(time))``; brakings and accelerations."""
    if constant:
        # spread over the range, so that the base law itself can be seen
        place = (np.arange(number) + rng.uniform(0.2, 0.8, number)) / number
        level = around.slow + rng.permutation(place) * (around.fast - around.slow)
        return level[:, None] * time, np.repeat(level[:, None], len(time), axis=1)
    x, v = [], []
    for _ in range(number):
        knots = [0.0]
        while knots[-1] < time[-1]:
            knots.append(knots[-1] + float(rng.uniform(4, 9)))
        speeds = [float(rng.uniform(around.slow, around.fast))]
        for before, after in pairwise(knots):
            # no braking above 3 and no acceleration above 2 m/s² at the steepest point
            room = (after - before) / 1.5
            low = max(around.slow, speeds[-1] - 3.0 * room)
            high = min(around.fast, speeds[-1] + 2.0 * room)
            speeds.append(float(rng.uniform(low, high)))
        curve = PchipInterpolator(knots, speeds)
        x.append(curve.antiderivative()(time))
        v.append(curve(time))
    return np.array(x), np.array(v)
