"""People in a corridor: accelerations, and Runge–Kutta of fourth order.

Places, velocities and forces in the plane are complex numbers, x + i y.

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
#: Largest distance of the points of walls, m.
WALL_SPACING = 0.25
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


class People(NamedTuple):
    """S crowds of N people.

    Attributes:
        x, v: ``(S, N, 2)`` at the start, m and m/s.
        goal: ``(S, N, 2)`` destinations, m.
        group: ``(S, N)`` number of the social group, -1 for those who walk alone.
        eta: ``(S, N)`` how much more vigorously than others they steer.
    """

    x: np.ndarray
    v: np.ndarray
    goal: np.ndarray
    group: np.ndarray
    eta: np.ndarray


@njit(cache=True, error_model="numpy")
def _length(vector: complex) -> float:
    return math.sqrt(vector.real * vector.real + vector.imag * vector.imag) + 1e-12


@njit(cache=True, error_model="numpy")
def _dot(a: complex, b: complex) -> float:
    return a.real * b.real + a.imag * b.imag


@njit(cache=True, error_model="numpy")
def _contact(base: Base, reach: float, offset: complex, slip: complex) -> complex:
    """Force at an offset of bodies of radius sum ``reach`` that slip at this velocity."""
    far = reach + _RANGES * base.B
    if _dot(offset, offset) > far * far:
        return 0j
    d = _length(offset)
    overlap, n = reach - d, offset / d
    push = base.A * math.exp(overlap / base.B)
    if overlap <= 0.0:
        return push * n
    return n * complex(push + base.k * overlap, base.kappa * overlap * _dot(1j * n, slip))


@njit(cache=True, error_model="numpy")
def _walls(
    base: Base, fx: Hidden, x: complex, v: complex, points: np.ndarray, segments: np.ndarray
) -> complex:
    """Acceleration by walls."""
    a = 0j
    far = base.r + _WALL_RANGES * base.B
    for point in points:
        offset = x - point
        if abs(offset.real) < far and abs(offset.imag) < far:
            a += _contact(base, base.r, offset, v)
    a /= max(len(points), 1)
    if fx.A_w != 0.0:
        for start, end in segments:
            way = end - start
            along = min(max(_dot(x - start, way) / _dot(way, way), 0.0), 1.0)
            offset = x - start - along * way
            d = _length(offset)
            a += fx.A_w * math.exp((base.r - d) / fx.B_w) * offset / d
    return a


@njit(cache=True, error_model="numpy")
def _others(
    base: Base, fx: Hidden, i: int, x: np.ndarray, v: np.ndarray, e: np.ndarray, group: np.ndarray
) -> complex:
    """Acceleration of person i by everyone else."""
    n = len(x)
    a, weighted, towards = 0j, 0j, 0j
    # most effects need nothing but the base force of each pair
    looks = fx.lambda_ != 1.0 or fx.theta != 0.0 or fx.A_2 != 0.0 or fx.friction != 0.0
    looks = looks or fx.side != 0.0 or fx.align != 0.0 or fx.dense != 0.0
    met, weights, rho, mates = 0.0, 0.0, 0.0, 0
    for j in range(n):
        if j == i:
            continue
        offset, slip = x[i] - x[j], v[j] - v[i]
        push = _contact(base, 2 * base.r, offset - fx.T_a * slip, slip)
        if group[j] == group[i] and group[i] >= 0:
            mates += 1
            towards -= offset
        if not looks:
            a += push / n
            continue
        d = _length(offset)
        normal = offset / d
        facing, ahead = _dot(e[i], e[j]), -_dot(e[i], normal)
        if fx.lambda_ != 1.0:
            push *= fx.lambda_ + (1.0 - fx.lambda_) * 0.5 * (1.0 + ahead)
        if fx.theta != 0.0:
            angle = fx.theta * 0.5 * (1.0 - facing)
            push *= complex(math.cos(angle), math.sin(angle))
        a += push / n
        if fx.A_2 != 0.0:
            a += fx.A_2 * math.exp((2 * base.r - d) / fx.B_2) * normal
        if fx.friction != 0.0:
            drag = fx.friction * math.exp((2 * base.r - d) / FRICTION_REACH)
            a += drag * _dot(1j * normal, slip) * 1j * normal
        if fx.side != 0.0:
            near = 1.0 / (1.0 + math.exp((d - ENCOUNTER) / ENCOUNTER_EDGE))
            met += max(ahead, 0.0) * max(-facing, 0.0) * near
        if fx.align != 0.0:
            weight = math.exp(-d / ALIGNMENT_REACH)
            weights += weight
            weighted += weight * slip
        if fx.dense != 0.0:
            rho += math.exp(-d * d / (2 * KERNEL**2)) / (2 * math.pi * KERNEL**2)
    if weights > 0.0:
        a += fx.align * weighted / weights
    if mates > 0:
        a += fx.cohesion * towards / mates
    return a + (e[i] * complex(0.0, -fx.side * (1.0 - math.exp(-met))) - fx.dense * rho * v[i])


@njit(cache=True, error_model="numpy")
def _alone(
    base: Base,
    fx: Hidden,
    x: complex,
    v: complex,
    e: complex,
    goal: complex,
    eta: float,
    clock: float,
    since: float,
) -> complex:
    """Acceleration of one person that nobody else has a part in."""
    speed, way = math.sqrt(_dot(v, v)), goal - x
    a = (1.0 + eta) / base.tau * (speed * way / _length(way) - v) + complex(fx.a_x, fx.a_y)
    along = fx.pull * (fx.v_pref - speed) - fx.tiring * max(since, 0.0)
    a += e * along
    if fx.A_o != 0.0:
        offset = x - complex(fx.x_o, fx.y_o)
        d = _length(offset)
        fall = math.exp(-0.5 * (d / fx.B_o) ** 2) if fx.bell != 0.0 else math.exp(-d / fx.B_o)
        a += fx.A_o * fall * offset / d
    if fx.spin != 0.0:
        offset = x - complex(fx.spin_x, fx.spin_y)
        fall = math.exp(-0.5 * _dot(offset, offset) / fx.spin_s**2) / fx.spin_s
        a += fx.spin * fall * 1j * offset
    if fx.push != 0.0:
        a += 1j * (fx.push * math.sin(2 * math.pi * clock / fx.push_T + fx.push_0))
    if fx.wave != 0.0:
        a += 1j * (fx.wave * math.sin(2 * math.pi * x.real / fx.wave_L + fx.wave_0))
    return a


@njit(cache=True, error_model="numpy")
def accelerations(
    base: Base,
    fx: Hidden,
    people: People,
    points: np.ndarray,
    segments: np.ndarray,
    clock: float,
    since: float,
) -> np.ndarray:
    """``(N,)`` m/s² of one crowd among the points ``(P,)`` and segments ``(W, 2)`` of walls."""
    x, v, goal, group, eta = people
    e = np.empty_like(v)
    a = np.empty_like(v)
    for i in range(len(x)):
        e[i] = v[i] / _length(v[i])
    for i in range(len(x)):
        alone = _alone(base, fx, x[i], v[i], e[i], goal[i], eta[i], clock, since)
        a[i] = alone + _others(base, fx, i, x, v, e, group)
        a[i] += _walls(base, fx, x[i], v[i], points, segments)
    return a


@njit(cache=True, error_model="numpy")
def _crowd(
    base: Base,
    fx: Hidden,
    people: People,
    points: np.ndarray,
    segments: np.ndarray,
    kick: np.ndarray,
    clock: float,
    since: float,
    step: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities ``(M + 1, N)`` of one crowd at every step."""
    xs, vs = np.empty_like(kick), np.empty_like(kick)
    xs[0], vs[0] = people.x, people.v
    dx, dv = np.empty((2, 4, kick.shape[1]), kick.dtype)
    for m in range(len(kick) - 1):
        for q in range(4):
            part = (0.0, 0.5, 0.5, 1.0)[q]
            x, v = xs[m].copy(), vs[m].copy()
            if q > 0:
                x += part * step * dx[q - 1]
                v += part * step * dv[q - 1]
            t = (m + part) * step
            now = People(x, v, people.goal, people.group, people.eta)
            a = accelerations(base, fx, now, points, segments, clock + t, since + t)
            dx[q], dv[q] = v, a + (kick[m] + part * (kick[m + 1] - kick[m]))
        xs[m + 1], vs[m + 1] = xs[m], vs[m]
        for q in range(4):
            weight = (1.0 / 6.0, 2.0 / 6.0, 2.0 / 6.0, 1.0 / 6.0)[q]
            xs[m + 1] += step * weight * dx[q]
            vs[m + 1] += step * weight * dv[q]
    return xs, vs


def simulate(
    base: Base,
    hidden: Hidden,
    people: People,
    walls: np.ndarray,
    kick: np.ndarray,
    clock: np.ndarray,
    since: np.ndarray,
    step: float,
    every: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of S crowds of N people.

    Args:
        walls: ``(W, 4)`` the walls, m.
        kick: ``(S, M + 1, N, 2)`` disturbance of accelerations, m/s², linear between steps.
        clock, since: ``(S,)`` time of the day, and time since the sequence began, at the start, s.
        step: of Runge–Kutta's method, s.
        every: so many steps lie between the values returned.

    Returns:
        ``(S, M // every + 1, N, 2)`` positions (m) and velocities (m/s).
    """
    plane = [in_plane(part) for part in people[:3]]
    points, segments = in_plane(wall_points(walls)), in_plane(walls.reshape(-1, 2, 2))
    paths = [
        _crowd(
            base, hidden, People(*own), points, segments, forces, float(time), float(start), step
        )
        for *own, forces, time, start in zip(
            *plane, *people[3:], in_plane(kick), clock, since, strict=True
        )
    ]
    x, v = (np.stack(parts)[:, ::every] for parts in zip(*paths, strict=True))
    return np.stack([x.real, x.imag], -1), np.stack([v.real, v.imag], -1)


def in_plane(vectors: np.ndarray) -> np.ndarray:
    """Complex numbers from an array whose last axis has two coordinates."""
    return np.ascontiguousarray(vectors, dtype=float).view(complex)[..., 0]


def wall_points(walls: np.ndarray) -> np.ndarray:
    """``(P, 2)`` points of walls, no farther apart than :data:`WALL_SPACING`."""
    points = [np.empty((0, 2))]
    for x1, y1, x2, y2 in walls:
        number = math.ceil(math.hypot(x2 - x1, y2 - y1) / WALL_SPACING - 1e-9) + 1
        points.append(np.linspace((x1, y1), (x2, y2), number))
    return np.concatenate(points)
