"""Platoons behind a given leader: Runge–Kutta of fourth order, one sequence after the other.

The right-hand sides are written down here once more on purpose: data that share code with the
models that are tested on them could not show a mistake in either.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

#: A logarithm needs a positive gap, m.
_LEAST_GAP = 1e-3


class Base(NamedTuple):
    """The base law of the gap, W: linear, or logarithmic; v0 in m/s and L in m."""

    v0: float
    L: float
    logarithmic: bool = False


class Hidden(NamedTuple):
    """Everything that can act on a vehicle beside its base law; the defaults change nothing.

    W is the base law of the gap, f the product of the factors, v_a the speed of the vehicle
    ahead, dv = v_a - W. In this order:

    1. f: zone, period, wave, clock wave, tiring, and what belongs to the vehicle (its class, its
       driver), which is an array beside this one;
    2. W f, at most ``v_max``, of a gap seen ``T`` s late, with L + ``h`` v_a in place of L;
    3. + ``c`` (W f of the next gap - W f of the own gap) + bump of the own gap + rear pressure;
    4. + ``kappa_open`` dv where the gap opens, ``kappa_close`` dv where it closes;
    5. the speed follows with the time constant ``tau_v``.
    """

    kappa_open: float = 0.0
    kappa_close: float = 0.0
    c: float = 0.0
    T: float = 0.0  # s
    tau_v: float = 0.0  # s
    h: float = 0.0  # s
    v_max: float = math.inf  # m/s
    zone_alpha: float = 1.0
    zone_a: float = 0.0  # m
    zone_b: float = 0.0  # m
    zone_ramp: float = 0.0  # m over which an edge is smeared
    period_alpha: float = 1.0
    period_a: float = 0.0  # s
    period_b: float = 0.0  # s
    period_ramp: float = 0.0  # s
    rear_push: float = 0.0  # m/s
    rear_reach: float = 1.0  # m
    wave_size: float = 0.0
    wave_length: float = 1.0  # m
    wave_phase: float = 0.0
    clock_size: float = 0.0
    clock_length: float = 1.0  # s
    clock_phase: float = 0.0
    tiring: float = 0.0  # 1/s
    bump_size: float = 0.0  # m/s
    bump_gap: float = 0.0  # m
    bump_width: float = 1.0  # m


@njit(cache=True)
def base_speed(base: Base, length: float, gap: float) -> float:
    """W in m/s of a gap in m, with ``length`` in place of L."""
    if base.logarithmic:
        return base.v0 * math.log(max(gap, _LEAST_GAP) / length)
    return base.v0 * (1.0 - length / gap)


@njit(cache=True)
def inside(place: float, a: float, b: float, ramp: float) -> float:
    """1 in [a, b], 0 outside; edges are cosines over ``ramp``, centred on a and b."""
    if ramp <= 0.0:
        return 1.0 if a <= place <= b else 0.0
    rise = min(max((place - a) / ramp + 0.5, 0.0), 1.0)
    fall = min(max((b - place) / ramp + 0.5, 0.0), 1.0)
    return 0.25 * (1.0 - math.cos(math.pi * rise)) * (1.0 - math.cos(math.pi * fall))


@njit(cache=True)
def _factor(fx: Hidden, x: float, clock: float, since: float) -> float:
    f = 1.0
    if fx.zone_alpha != 1.0:
        f -= (1.0 - fx.zone_alpha) * inside(x, fx.zone_a, fx.zone_b, fx.zone_ramp)
    if fx.period_alpha != 1.0:
        within = inside(clock, fx.period_a, fx.period_b, fx.period_ramp)
        f *= 1.0 - (1.0 - fx.period_alpha) * within
    if fx.wave_size != 0.0:
        f *= 1.0 + fx.wave_size * math.sin(2 * math.pi * x / fx.wave_length + fx.wave_phase)
    if fx.clock_size != 0.0:
        turn = 2 * math.pi * clock / fx.clock_length + fx.clock_phase
        f *= 1.0 + fx.clock_size * math.sin(turn)
    return f * (1.0 - fx.tiring * max(since, 0.0))


@njit(cache=True)
def _past(xs: np.ndarray, vs: np.ndarray, at: float, i: int) -> float:
    """Position of vehicle i at the grid position ``at``, by cubic Hermite interpolation."""
    if at <= 0.0:
        return float(xs[0, i])
    k = int(at)
    s = at - k
    x0, x1, v0, v1 = xs[k, i], xs[k + 1, i], vs[k, i], vs[k + 1, i]
    return float(
        x0 * (1 + 2 * s) * (1 - s) ** 2
        + v0 * s * (1 - s) ** 2
        + x1 * s * s * (3 - 2 * s)
        + v1 * s * s * (s - 1)
    )


@njit(cache=True)
def _rates(
    base: Base,
    fx: Hidden,
    own: np.ndarray,
    x: np.ndarray,
    w: np.ndarray,
    kick: np.ndarray,
    lead_v: float,
    xs: np.ndarray,
    vs: np.ndarray,
    at: float,
    step: float,
    clock: float,
    since: float,
    dx: np.ndarray,
    dw: np.ndarray,
) -> None:
    """Rates (in m/s and m/s²) of one platoon; ``x`` holds the leader as the last vehicle."""
    n = x.shape[0]
    late = at - fx.T / step
    dx[n - 1] = lead_v
    dw[n - 1] = 0.0
    for i in range(n - 2, -1, -1):
        ahead = dx[i + 1]
        length = base.L + fx.h * ahead
        f = own[i] * _factor(fx, x[i], clock, since)
        gap = x[i + 1] - x[i]
        if fx.T > 0.0:
            gap = _past(xs, vs, late, i + 1) - _past(xs, vs, late, i)
        own_speed = min(f * base_speed(base, length, gap), fx.v_max)
        speed = own_speed
        if fx.c != 0.0 and i < n - 2:
            following = x[i + 2] - x[i + 1]
            if fx.T > 0.0:
                following = _past(xs, vs, late, i + 2) - _past(xs, vs, late, i + 1)
            other = min(f * base_speed(base, length, following), fx.v_max)
            speed += fx.c * (other - own_speed)
        if fx.bump_size != 0.0:
            speed += fx.bump_size * math.exp(-0.5 * ((gap - fx.bump_gap) / fx.bump_width) ** 2)
        if fx.rear_push != 0.0 and i > 0:
            speed += fx.rear_push * math.exp(-(x[i] - x[i - 1]) / fx.rear_reach)
        away = ahead - speed
        speed += (fx.kappa_open if away > 0.0 else fx.kappa_close) * away
        if fx.tau_v > 0.0:
            dw[i] = (speed - w[i]) / fx.tau_v
            dx[i] = w[i] + kick[i]
        else:
            dw[i] = 0.0
            dx[i] = speed + kick[i]


@njit(cache=True)
def _platoon(
    base: Base,
    fx: Hidden,
    own: np.ndarray,
    lead_x: np.ndarray,
    lead_v: np.ndarray,
    past_x: np.ndarray,
    past_v: np.ndarray,
    kick: np.ndarray,
    clock: float,
    since: float,
    step: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities ``(M + 1, N)`` of one platoon at every step."""
    before, steps = len(past_x) - 1, len(kick) - 1
    # the past is part of the path, velocities per step, as interpolation wants them
    xs, vs = np.empty((2, before + steps + 1, past_x.shape[1]))
    xs[: before + 1], vs[: before + 1] = past_x, past_v * step
    xs[before, -1] = lead_x[0]
    w_now = past_v[before] - kick[0]
    v = np.empty(kick.shape)
    dx, dw = np.empty((2, 4, kick.shape[1]))
    for k in range(steps + 1):
        here = before + k
        for j in range(4 if k < steps else 1):
            part = (0.0, 0.5, 0.5, 1.0)[j]
            half = 2 * k + int(2 * part)
            x, w = xs[here].copy(), w_now.copy()
            if j > 0:
                x += part * step * dx[j - 1]
                w += part * step * dw[j - 1]
            x[-1] = lead_x[half]
            noise = kick[k] + part * (kick[min(k + 1, steps)] - kick[k])
            t = (k + part) * step
            moment = here + part, step, clock + t, since + t
            _rates(base, fx, own, x, w, noise, lead_v[half], xs, vs, *moment, dx[j], dw[j])
            if j == 0:
                vs[here], v[k] = dx[0] * step, dx[0]
        if k < steps:
            xs[here + 1] = xs[here] + step * _mean(dx)
            w_now += step * _mean(dw)
            xs[here + 1, -1] = lead_x[half]
    return xs[before:], v


@njit(cache=True)
def _mean(stages: np.ndarray) -> np.ndarray:
    """Runge and Kutta's mean of the rates of four stages."""
    a, b = 1.0 / 6.0, 2.0 / 6.0
    return a * stages[0] + b * stages[1] + b * stages[2] + a * stages[3]


def simulate(
    base: Base,
    hidden: Hidden,
    own: np.ndarray,
    lead: tuple[np.ndarray, np.ndarray],
    past: tuple[np.ndarray, np.ndarray],
    kick: np.ndarray,
    clock: np.ndarray,
    since: float,
    step: float,
    every: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of S platoons of N vehicles, the leader last.

    Args:
        own: ``(S, N)`` factor on W of each vehicle.
        lead: ``(S, 2 M + 1)`` the leaders' positions (m) and speeds (m/s) at the whole and half
            steps.
        past: ``(S, P + 1, N)`` positions and velocities at the P steps before the start and at
            the start; earlier than that, vehicles are where they were at first.
        kick: ``(S, M + 1, N)`` disturbance of the velocities, m/s, linear between steps.
        clock: ``(S,)`` time of the day at the start, s.
        since: time at the start since the recording's beginning, s; negative before it.
        step: of Runge–Kutta's method, s.
        every: so many steps lie between the values returned.

    Returns:
        ``(S, M // every + 1, N)`` positions (m) and velocities (m/s).
    """
    arrays = [np.ascontiguousarray(a, dtype=float) for a in (own, *lead, *past, kick)]
    paths = [
        _platoon(base, hidden, *each, float(time), since, step)  # type: ignore[call-arg]
        for *each, time in zip(*arrays, clock, strict=True)
    ]
    x, v = (np.stack(parts)[:, ::every] for parts in zip(*paths, strict=True))
    return x, v
