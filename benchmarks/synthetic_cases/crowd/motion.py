"""People in a corridor: accelerations, and Runge–Kutta of fourth order.

The right-hand sides are written down here once more on purpose: data that share code with the
models that are tested on them could not show a mistake in either.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

#: Farther away than this many ranges B beyond contact a person's force, or a wall point's, whose
#: share is smaller, is not worth counting.
_RANGES, _WALL_RANGES = 11.0, 8.0
#: Reach of alignment, of sliding friction and of the density's kernel, m.
ALIGNMENT_REACH, FRICTION_REACH, KERNEL = 2.0, 0.5, 1.0
#: Distance within which somebody who comes towards counts, and how sharply that ends, m.
ENCOUNTER, ENCOUNTER_EDGE = 3.0, 0.3


class Base(NamedTuple):
    """Relaxation towards the destination, and the social force; mass 1 kg."""

    A: float
    k: float
    kappa: float
    r: float = 0.25
    B: float = 0.3
    tau: float = 0.5


class Hidden(NamedTuple):
    """What can act on people beside the base law, m/s²; the defaults change nothing.

    d and n are distance and unit vector from the other to the person, e walking directions,
    f_ij the base law's force from j on i, averaged over all N people as there.
    """

    A_w: float = 0.0  # sum over walls of A_w exp((r - d)/B_w) n, nearest point of each
    B_w: float = 1.0
    A_2: float = 0.0  # sum over j of A_2 exp((2 r - d)/B_2) n
    B_2: float = 1.0
    lambda_: float = 1.0  # f_ij (lambda + (1 - lambda)(1 + cos phi)/2), phi to where i walks
    T_a: float = 0.0  # f_ij at positions that both will reach in T_a
    side: float = 0.0  # side (1 - exp(-sum of encounters)) to the right
    theta: float = 0.0  # f_ij turned left by theta (1 - e_i e_j)/2
    align: float = 0.0  # align sum w (v_j - v_i) / sum w, w = exp(-d / 2 m)
    cohesion: float = 0.0  # cohesion (mean place of the others of the group - x)
    A_o: float = 0.0  # A_o exp(-d/B_o) n from a place; negative: towards it
    B_o: float = 1.0
    x_o: float = 0.0
    y_o: float = 0.0
    bell: float = 0.0  # 1: A_o exp(-d²/(2 B_o²)) n instead
    a_x: float = 0.0
    a_y: float = 0.0
    pull: float = 0.0  # pull (v_pref - |v|) e
    v_pref: float = 1.3
    dense: float = 0.0  # -dense rho v
    friction: float = 0.0  # sum over j of friction exp((2 r - d)/0.5 m) ((v_j - v_i) t) t
    sway: float = 0.0  # sway sin(2 pi f clock + phase_i) to the right
    sway_f: float = 1.0
    spin: float = 0.0  # spin exp(-d²/(2 s²)) around a place, to the left of n
    spin_x: float = 0.0
    spin_y: float = 0.0
    spin_s: float = 1.0
    push: float = 0.0  # push sin(2 pi clock / push_T + push_0) along y, the same for all
    push_T: float = 1.0
    push_0: float = 0.0
    wave: float = 0.0  # wave sin(2 pi x / wave_L + wave_0) along y
    wave_L: float = 1.0
    wave_0: float = 0.0
    tiring: float = 0.0  # -tiring (time since the sequence began) e


@njit(cache=True, error_model="numpy")
def _contact(
    base: Base, reach: float, dx: float, dy: float, ux: float, uy: float
) -> tuple[float, float]:
    """Force at the offset (dx, dy) of bodies of radius sum ``reach`` that slip at (ux, uy)."""
    d2, far = dx * dx + dy * dy, reach + _RANGES * base.B
    if d2 > far * far:
        return 0.0, 0.0
    d = math.sqrt(d2) + 1e-12
    overlap = reach - d
    nx, ny = dx / d, dy / d
    push = base.A * math.exp(overlap / base.B)
    if overlap <= 0.0:
        return push * nx, push * ny
    push += base.k * overlap
    slide = base.kappa * overlap * (-ux * ny + uy * nx)
    return push * nx - slide * ny, push * ny + slide * nx


@njit(cache=True, error_model="numpy")
def _walls(
    base: Base,
    fx: Hidden,
    x: float,
    y: float,
    u: float,
    w: float,
    points: np.ndarray,
    segments: np.ndarray,
) -> tuple[float, float]:
    """Acceleration by walls, of a person at (x, y) with the velocity (u, w)."""
    ax, ay = 0.0, 0.0
    far = base.r + _WALL_RANGES * base.B
    for p in range(len(points)):
        dx, dy = x - points[p, 0], y - points[p, 1]
        if abs(dx) < far and abs(dy) < far:
            fx_, fy_ = _contact(base, base.r, dx, dy, u, w)
            ax += fx_
            ay += fy_
    number = max(len(points), 1)
    ax, ay = ax / number, ay / number
    if fx.A_w != 0.0:
        for q in range(len(segments)):
            x1, y1, x2, y2 = segments[q]
            along = ((x - x1) * (x2 - x1) + (y - y1) * (y2 - y1)) / (
                (x2 - x1) ** 2 + (y2 - y1) ** 2
            )
            along = min(max(along, 0.0), 1.0)
            dx, dy = x - x1 - along * (x2 - x1), y - y1 - along * (y2 - y1)
            d = math.sqrt(dx * dx + dy * dy) + 1e-12
            push = fx.A_w * math.exp((base.r - d) / fx.B_w)
            ax += push * dx / d
            ay += push * dy / d
    return ax, ay


@njit(cache=True, error_model="numpy")
def _others(
    base: Base, fx: Hidden, i: int, x: np.ndarray, v: np.ndarray, e: np.ndarray, group: np.ndarray
) -> tuple[float, float]:
    """Acceleration of person i by everyone else."""
    n = len(x)
    ax, ay = 0.0, 0.0
    # most effects need nothing but the base force of each pair
    looks = fx.lambda_ != 1.0 or fx.theta != 0.0 or fx.A_2 != 0.0 or fx.friction != 0.0
    looks = looks or fx.side != 0.0 or fx.align != 0.0 or fx.dense != 0.0
    met, weights, wx, wy, rho, mates, gx, gy = 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0.0, 0.0
    for j in range(n):
        if j == i:
            continue
        dx, dy = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1]
        ux, uy = v[j, 0] - v[i, 0], v[j, 1] - v[i, 1]
        px, py = _contact(base, 2 * base.r, dx - fx.T_a * ux, dy - fx.T_a * uy, ux, uy)
        if group[j] == group[i] and group[i] >= 0:
            mates += 1
            gx -= dx
            gy -= dy
        if not looks:
            ax += px / n
            ay += py / n
            continue
        d = math.sqrt(dx * dx + dy * dy) + 1e-12
        nx, ny = dx / d, dy / d
        facing = e[i, 0] * e[j, 0] + e[i, 1] * e[j, 1]
        ahead = -(e[i, 0] * nx + e[i, 1] * ny)
        if fx.lambda_ != 1.0:
            weight = fx.lambda_ + (1.0 - fx.lambda_) * 0.5 * (1.0 + ahead)
            px, py = weight * px, weight * py
        if fx.theta != 0.0:
            angle = fx.theta * 0.5 * (1.0 - facing)
            c, s = math.cos(angle), math.sin(angle)
            px, py = c * px - s * py, s * px + c * py
        ax += px / n
        ay += py / n
        if fx.A_2 != 0.0:
            push = fx.A_2 * math.exp((2 * base.r - d) / fx.B_2)
            ax += push * nx
            ay += push * ny
        if fx.friction != 0.0:
            slip = -ux * ny + uy * nx
            drag = fx.friction * math.exp((2 * base.r - d) / FRICTION_REACH) * slip
            ax -= drag * ny
            ay += drag * nx
        if fx.side != 0.0:
            near = 1.0 / (1.0 + math.exp((d - ENCOUNTER) / ENCOUNTER_EDGE))
            met += max(ahead, 0.0) * max(-facing, 0.0) * near
        if fx.align != 0.0:
            weight = math.exp(-d / ALIGNMENT_REACH)
            weights += weight
            wx += weight * ux
            wy += weight * uy
        if fx.dense != 0.0:
            rho += math.exp(-d * d / (2 * KERNEL**2)) / (2 * math.pi * KERNEL**2)
    if weights > 0.0:
        ax += fx.align * wx / weights
        ay += fx.align * wy / weights
    if mates > 0:
        ax += fx.cohesion * gx / mates
        ay += fx.cohesion * gy / mates
    turn = fx.side * (1.0 - math.exp(-met))
    ax += turn * e[i, 1] - fx.dense * rho * v[i, 0]
    ay += -turn * e[i, 0] - fx.dense * rho * v[i, 1]
    return ax, ay


@njit(cache=True, error_model="numpy")
def _alone(
    base: Base,
    fx: Hidden,
    x: np.ndarray,
    v: np.ndarray,
    e: np.ndarray,
    goal: np.ndarray,
    eta: float,
    phase: float,
    clock: float,
    since: float,
) -> tuple[float, float]:
    """Acceleration of one person that nobody else has a part in."""
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1])
    wx, wy = goal[0] - x[0], goal[1] - x[1]
    way = math.sqrt(wx * wx + wy * wy) + 1e-12
    eager = (1.0 + eta) / base.tau
    ax = eager * (speed * wx / way - v[0]) + fx.a_x
    ay = eager * (speed * wy / way - v[1]) + fx.a_y
    along = fx.pull * (fx.v_pref - speed) - fx.tiring * max(since, 0.0)
    across = fx.sway * math.sin(2 * math.pi * fx.sway_f * clock + phase)
    ax += along * e[0] + across * e[1]
    ay += along * e[1] - across * e[0]
    if fx.A_o != 0.0:
        dx, dy = x[0] - fx.x_o, x[1] - fx.y_o
        d = math.sqrt(dx * dx + dy * dy) + 1e-12
        fall = math.exp(-d / fx.B_o)
        if fx.bell != 0.0:
            fall = math.exp(-0.5 * (d / fx.B_o) ** 2)
        ax += fx.A_o * fall * dx / d
        ay += fx.A_o * fall * dy / d
    if fx.spin != 0.0:
        dx, dy = x[0] - fx.spin_x, x[1] - fx.spin_y
        fall = math.exp(-0.5 * (dx * dx + dy * dy) / fx.spin_s**2) / fx.spin_s
        ax -= fx.spin * fall * dy
        ay += fx.spin * fall * dx
    if fx.push != 0.0:
        ay += fx.push * math.sin(2 * math.pi * clock / fx.push_T + fx.push_0)
    if fx.wave != 0.0:
        ay += fx.wave * math.sin(2 * math.pi * x[0] / fx.wave_L + fx.wave_0)
    return ax, ay


@njit(cache=True, error_model="numpy")
def accelerations(
    base: Base,
    fx: Hidden,
    x: np.ndarray,
    v: np.ndarray,
    goal: np.ndarray,
    group: np.ndarray,
    eta: np.ndarray,
    phase: np.ndarray,
    points: np.ndarray,
    segments: np.ndarray,
    clock: float,
    since: float,
    out: np.ndarray,
) -> None:
    """``out`` (N, 2), m/s², of people at ``x`` (N, 2) m with velocities ``v`` (N, 2) m/s."""
    e = np.empty_like(v)
    for i in range(len(x)):
        speed = math.sqrt(v[i, 0] ** 2 + v[i, 1] ** 2) + 1e-12
        e[i, 0], e[i, 1] = v[i, 0] / speed, v[i, 1] / speed
    for i in range(len(x)):
        a0, a1 = _alone(base, fx, x[i], v[i], e[i], goal[i], eta[i], phase[i], clock, since)
        b0, b1 = _others(base, fx, i, x, v, e, group)
        c0, c1 = _walls(base, fx, x[i, 0], x[i, 1], v[i, 0], v[i, 1], points, segments)
        out[i, 0] = a0 + b0 + c0
        out[i, 1] = a1 + b1 + c1


@njit(cache=True, error_model="numpy")
def simulate(
    base: Base,
    fx: Hidden,
    x0: np.ndarray,
    v0: np.ndarray,
    goal: np.ndarray,
    group: np.ndarray,
    eta: np.ndarray,
    phase: np.ndarray,
    points: np.ndarray,
    segments: np.ndarray,
    kick: np.ndarray,
    clock: np.ndarray,
    since: np.ndarray,
    step: float,
    steps: int,
    every: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of S crowds of N people.

    Args:
        x0, v0: ``(S, N, 2)`` m and m/s at the start.
        goal: ``(S, N, 2)`` destinations, m.
        group: ``(S, N)`` number of the social group, -1 for those who walk alone.
        eta: ``(S, N)`` how much more vigorously than others they steer.
        phase: ``(S, N)`` of their gait, rad.
        points: ``(P, 2)`` of the walls, m.
        segments: ``(W, 4)`` the walls, m.
        kick: ``(S, M + 1, N, 2)`` disturbance of accelerations, m/s², linear between steps; or
            ``(S, 1, N, 2)`` for one that is constant.
        clock, since: ``(S,)`` time of the day, and time since the sequence began, at the start, s.
        step, steps: s, and how many.
        every: so many steps lie between the values returned.

    Returns:
        ``(S, steps // every + 1, N, 2)`` positions (m) and velocities (m/s).
    """
    sequences, people = x0.shape[0], x0.shape[1]
    out_x = np.empty((sequences, steps // every + 1, people, 2))
    out_v = np.empty_like(out_x)
    dx, dv = np.empty((4, people, 2)), np.empty((4, people, 2))
    offset = np.array([0.0, 0.5, 0.5, 1.0])
    weight = np.array([1.0, 2.0, 2.0, 1.0]) / 6.0
    for s in range(sequences):
        x, v = x0[s].copy(), v0[s].copy()
        out_x[s, 0], out_v[s, 0] = x, v
        for m in range(steps):
            for q in range(4):
                part = offset[q]
                xq, vq = x.copy(), v.copy()
                if q > 0:
                    xq += part * step * dx[q - 1]
                    vq += part * step * dv[q - 1]
                t = (m + part) * step
                accelerations(
                    base,
                    fx,
                    xq,
                    vq,
                    goal[s],
                    group[s],
                    eta[s],
                    phase[s],
                    points,
                    segments,
                    clock[s] + t,
                    since[s] + t,
                    dv[q],
                )
                if kick.shape[1] > 1:
                    dv[q] += kick[s, m] + part * (kick[s, m + 1] - kick[s, m])
                else:
                    dv[q] += kick[s, 0]
                dx[q] = vq
            for q in range(4):
                x += step * weight[q] * dx[q]
                v += step * weight[q] * dv[q]
            if (m + 1) % every == 0:
                out_x[s, (m + 1) // every] = x
                out_v[s, (m + 1) // every] = v
    return out_x, out_v
