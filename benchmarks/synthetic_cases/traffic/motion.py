"""Platoons behind a given leader: Runge–Kutta of fourth order, one sequence after the other.

The right-hand sides are written down here once more on purpose: data that share code with the
models that are tested on them could not show a mistake in either.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

LINEAR, LOGARITHMIC = 0, 1
LAWS = {"lin": LINEAR, "log": LOGARITHMIC}

#: A logarithm needs a positive gap, m.
_LEAST_GAP = 1e-3


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
def base_speed(law: int, v0: float, L: float, gap: float) -> float:
    """W in m/s of a gap in m."""
    if law == 0:
        return v0 * (1.0 - L / gap)
    return v0 * math.log(max(gap, _LEAST_GAP) / L)


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
    law: int,
    v0: float,
    L: float,
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
        length = L + fx.h * ahead
        f = own[i] * _factor(fx, x[i], clock, since)
        gap = x[i + 1] - x[i]
        if fx.T > 0.0:
            gap = _past(xs, vs, late, i + 1) - _past(xs, vs, late, i)
        own_speed = min(f * base_speed(law, v0, length, gap), fx.v_max)
        speed = own_speed
        if fx.c != 0.0 and i < n - 2:
            following = x[i + 2] - x[i + 1]
            if fx.T > 0.0:
                following = _past(xs, vs, late, i + 2) - _past(xs, vs, late, i + 1)
            other = min(f * base_speed(law, v0, length, following), fx.v_max)
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
def simulate(
    law: int,
    v0: float,
    L: float,
    fx: Hidden,
    own: np.ndarray,
    lead_x: np.ndarray,
    lead_v: np.ndarray,
    past_x: np.ndarray,
    past_v: np.ndarray,
    kick: np.ndarray,
    clock: np.ndarray,
    since: float,
    step: float,
    every: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of S platoons of N vehicles, the leader last.

    Args:
        law: :data:`LINEAR` or :data:`LOGARITHMIC`.
        v0, L: m/s and m.
        fx: what is hidden.
        own: ``(S, N)`` factor on W of each vehicle.
        lead_x, lead_v: ``(S, 2 M + 1)`` the leader's position (m) and speed (m/s) at the whole
            and half steps.
        past_x, past_v: ``(S, P + 1, N)`` positions and velocities at the P steps before the
            start and at the start; earlier than that, vehicles are where they were at first.
        kick: ``(S, M + 1, N)`` disturbance of the velocities, m/s, linear between steps; or
            ``(S, 1, N)`` for one that is constant.
        clock: ``(S,)`` time of the day at the start, s.
        since: time at the start since the recording's beginning, s; negative before it.
        step: of Runge–Kutta's method, s.
        every: so many steps lie between the values returned.

    Returns:
        ``(S, M // every + 1, N)`` positions (m) and velocities (m/s).
    """
    sequences, vehicles = past_x.shape[0], past_x.shape[2]
    before = past_x.shape[1] - 1
    steps = (lead_x.shape[1] - 1) // 2
    out_x = np.empty((sequences, steps // every + 1, vehicles))
    out_v = np.empty_like(out_x)
    xs = np.empty((before + steps + 1, vehicles))
    vs = np.empty_like(xs)  # per step, as interpolation wants them
    x, w, noise = np.empty(vehicles), np.empty(vehicles), np.empty(vehicles)
    dx, dw = np.empty((4, vehicles)), np.empty((4, vehicles))
    offset = np.array([0.0, 0.5, 0.5, 1.0])
    weight = np.array([1.0, 2.0, 2.0, 1.0]) / 6.0
    for s in range(sequences):
        xs[: before + 1] = past_x[s]
        vs[: before + 1] = past_v[s] * step
        xs[before, vehicles - 1] = lead_x[s, 0]
        w_now = past_v[s, before].copy()
        if kick.shape[1] > 1:
            w_now -= kick[s, 0]
        for k in range(steps + 1):
            here = before + k
            stages = 4 if k < steps else 1
            for j in range(stages):
                part = offset[j]
                half = 2 * k + int(2 * part)
                for i in range(vehicles):
                    x[i] = xs[here, i]
                    w[i] = w_now[i]
                    if j > 0:
                        x[i] += part * step * dx[j - 1, i]
                        w[i] += part * step * dw[j - 1, i]
                    if kick.shape[1] > 1:
                        later = kick[s, min(k + 1, steps), i]
                        noise[i] = kick[s, k, i] + part * (later - kick[s, k, i])
                    else:
                        noise[i] = kick[s, 0, i]
                x[vehicles - 1] = lead_x[s, half]
                t = (k + part) * step
                _rates(
                    law,
                    v0,
                    L,
                    fx,
                    own[s],
                    x,
                    w,
                    noise,
                    lead_v[s, half],
                    xs,
                    vs,
                    here + part,
                    step,
                    clock[s] + t,
                    since + t,
                    dx[j],
                    dw[j],
                )
                if j == 0:
                    for i in range(vehicles):
                        vs[here, i] = dx[0, i] * step
            if k % every == 0:
                out_x[s, k // every] = xs[here]
                out_v[s, k // every] = dx[0]
            if k < steps:
                for i in range(vehicles - 1):
                    gain = 0.0
                    push = 0.0
                    for j in range(4):
                        gain += weight[j] * dx[j, i]
                        push += weight[j] * dw[j, i]
                    xs[here + 1, i] = xs[here, i] + step * gain
                    w_now[i] += step * push
                xs[here + 1, vehicles - 1] = lead_x[s, half]
    return out_x, out_v
