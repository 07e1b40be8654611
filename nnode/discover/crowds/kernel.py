"""Relaxation and social force of people who walk alone among others, in compiled code.

A person is a number p; his surroundings are tables:

* ``others`` ``(H, W, 4, N)``: positions and velocities of the N people of W windows at H moments;
* ``window`` ``(P,)``: his window; ``meets`` ``(P, N)``: 1/(mass * people) for everyone he meets;
* ``wall`` ``(P, 2, M)``: the wall points near him, the first ``points[p]`` of them real;
* ``fixed`` ``(P, 3)``: his destination and 1/(mass * wall points);
* ``law`` ``(4,)``: 1/tau, r, 1/B, sign of the walls' friction; ``q`` ``(R, 3)``: A, k, kappa.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numba import njit

from nnode.models.crowd import SMOOTHING
from nnode.simulate._math import exp

_SMALL = SMOOTHING**2
# sums may be reordered: they are over a handful of neighbours
_OPTIONS: Any = {"error_model": "numpy", "fastmath": {"contract", "nsz", "reassoc"}}


@njit(**_OPTIONS)
def _people(x: float, y: float, u: float, v: float, seen: Any, meets: Any, law: Any, q: Any) -> Any:
    a, k, kappa, reach, per_b = q[0], q[1], q[2], 2 * law[1], law[2]
    fx, fy = 0.0, 0.0
    for j in range(seen.shape[1]):
        dx, dy = x - seen[0, j], y - seen[1, j]
        d = sqrt(dx * dx + dy * dy + _SMALL)
        nx, ny = dx / d, dy / d
        overlap = reach - d
        contact = overlap if overlap > 0.0 else 0.0
        slip = (u - seen[2, j]) * ny - (v - seen[3, j]) * nx
        push = meets[j] * (a * exp(overlap * per_b) + k * contact)
        slide = meets[j] * kappa * contact * slip
        fx += push * nx - slide * ny
        fy += push * ny + slide * nx
    return fx, fy


@njit(**_OPTIONS)
def _walls(x: float, y: float, u: float, v: float, wall: Any, points: int, law: Any, q: Any) -> Any:
    a, k, kappa, reach, per_b, sign = q[0], q[1], q[2], law[1], law[2], law[3]
    fx, fy = 0.0, 0.0
    for j in range(points):
        dx, dy = x - wall[0, j], y - wall[1, j]
        d = sqrt(dx * dx + dy * dy + _SMALL)
        nx, ny = dx / d, dy / d
        overlap = reach - d
        contact = overlap if overlap > 0.0 else 0.0
        push = a * exp(overlap * per_b) + k * contact
        slide = kappa * contact * sign * (v * nx - u * ny)
        fx += push * nx - slide * ny
        fy += push * ny + slide * nx
    return fx, fy


@njit(**_OPTIONS)
def _rate(
    x: float, y: float, u: float, v: float, seen: Any, meets: Any, wall: Any, points: int,
    fixed: Any, law: Any, q: Any,
) -> Any:  # fmt: skip
    wx, wy = fixed[0] - x, fixed[1] - y
    pace = sqrt(u * u + v * v + _SMALL) / sqrt(wx * wx + wy * wy + _SMALL)
    px, py = _people(x, y, u, v, seen, meets, law, q)
    bx, by = _walls(x, y, u, v, wall, points, law, q)
    ax = (wx * pace - u) * law[0] + px + fixed[2] * bx
    ay = (wy * pace - v) * law[0] + py + fixed[2] * by
    return ax, ay


@njit(nogil=True, cache=True, **_OPTIONS)
def accelerations(
    state: Any, person: Any, moment: Any, row: Any, others: Any, window: Any, meets: Any,
    wall: Any, points: Any, fixed: Any, law: Any, q: Any,
) -> Any:  # fmt: skip
    """``(S, 2)`` m/s² of states ``(S, 4)`` of some people at some moments with some rows."""
    out = np.empty((state.shape[0], 2))
    for s in range(state.shape[0]):
        p = person[s]
        out[s, 0], out[s, 1] = _rate(
            state[s, 0], state[s, 1], state[s, 2], state[s, 3], others[moment[s], window[p]],
            meets[p], wall[p], points[p], fixed[p], law, q[row[s]],
        )  # fmt: skip
    return out


@njit(nogil=True, cache=True, **_OPTIONS)
def advance(
    now: Any, before: Any, after: Any, out: Any, n: int, h: float, others: Any, window: Any,
    meets: Any, wall: Any, points: Any, fixed: Any, law: Any, q: Any,
) -> None:  # fmt: skip
    """Step ``n`` of ``h`` s by the classical Runge-Kutta method, from states ``now`` to ``out``.

    Both are ``(R, P, 4)``. Accelerations ``before`` and ``after`` ``(R, P, 2)`` are added, linear
    in between; the moments of the tables are half steps.
    """
    k, y = np.empty((4, 4)), np.empty(4)
    for r in range(now.shape[0]):
        for p in range(now.shape[1]):
            for stage in range(4):
                moment = 2 * n + (0 if stage == 0 else (2 if stage == 3 else 1))
                share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                for c in range(4):
                    y[c] = now[r, p, c] + (share * h * k[stage - 1, c] if stage else 0.0)
                k[stage, 0], k[stage, 1] = y[2], y[3]
                ax, ay = _rate(
                    y[0], y[1], y[2], y[3], others[moment, window[p]], meets[p], wall[p],
                    points[p], fixed[p], law, q[r],
                )  # fmt: skip
                k[stage, 2] = ax + (1 - share) * before[r, p, 0] + share * after[r, p, 0]
                k[stage, 3] = ay + (1 - share) * before[r, p, 1] + share * after[r, p, 1]
            for c in range(4):
                slope = k[0, c] + 2 * k[1, c] + 2 * k[2, c] + k[3, c]
                out[r, p, c] = now[r, p, c] + h / 6 * slope
