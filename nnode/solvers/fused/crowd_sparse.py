"""Everybody meets his neighbours: simulation and gradient of crowds one by one.

Cell lists are made anew in every step, and again on the way back: they take less time than to
find out whether old ones would do, and nothing has to be kept.

The package loads a copy of this file from the cache folder, see
:mod:`nnode.solvers.fused.crowd_cache`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from nnode.solvers.fused.crowd_laws import LOOP, ROWS, SIZE, law, law_pull
from nnode.solvers.fused.crowd_rows import blank, clear, copy, fill_up, increase
from nnode.solvers.fused.neighbours import (
    both_ways,
    grid,
    people_near,
    points_near,
    sort,
    with_oneself,
)


@njit(**LOOP)
def _meet(
    room: Any, own: Any, other: Any, pairs: Any, number: int, mutual: bool, q: Any, force: Any
) -> None:
    """Add the forces of sources ``other`` (M, 4) on receivers ``own`` (N, 4), by pairs."""
    for low in range(0, number, SIZE):
        n = min(SIZE, number - low)
        for t in range(n):
            i, j = pairs[0, low + t], pairs[1, low + t]
            for c in range(4):
                room[c * SIZE + t] = own[i, c] - other[j, c]
        law(room, fill_up(room, n, 4), q)
        for t in range(n):
            i, j = pairs[0, low + t], pairs[1, low + t]
            for c in range(2):
                force[i, c] += room[(4 + c) * SIZE + t]
                if mutual:
                    force[j, c] -= room[(4 + c) * SIZE + t]


@njit(**LOOP)
def _meet_pull(
    room: Any,
    own: Any,
    other: Any,
    pairs: Any,
    number: int,
    mutual: bool,
    moving: bool,
    q: Any,
    weight: Any,
    total: Any,
    to_own: Any,
) -> None:
    """Gradient of :func:`_meet`; ``to_own`` receives that of moving sources, too."""  # fmt: skip
    for low in range(0, number, SIZE):
        n = min(SIZE, number - low)
        for t in range(n):
            i, j = pairs[0, low + t], pairs[1, low + t]
            for c in range(4):
                room[c * SIZE + t] = own[i, c] - other[j, c]
            for c in range(2):
                back = weight[i, c] - weight[j, c] if mutual else weight[i, c]
                room[(4 + c) * SIZE + t] = back
        law_pull(room, fill_up(room, n, 6), q, total)
        for t in range(n):
            i, j = pairs[0, low + t], pairs[1, low + t]
            for c in range(4):
                to_own[i, c] += room[(6 + c) * SIZE + t]
                if moving:
                    to_own[j, c] -= room[(6 + c) * SIZE + t]


@njit(**LOOP)
def _take(rows: Any, values: Any, chosen: Any) -> None:
    """Chosen rows of values (·, 4)."""
    for k in range(len(chosen)):
        for c in range(4):
            rows[k, c] = values[chosen[k], c]


@njit(**LOOP)
def _put(rows: Any, values: Any, chosen: Any) -> None:
    """Rows (·, 4) to chosen rows of values."""
    for k in range(len(chosen)):
        for c in range(4):
            values[chosen[k], c] = rows[k, c]


@njit(**LOOP)
def _who(exists: Any) -> Any:
    """Indices of what exists."""
    found, number = np.empty(len(exists), np.int64), 0
    for i in range(len(exists)):
        found[number] = i
        number += 1 if exists[i] > 0 else 0
    return found[:number]


@njit(**LOOP)
def _scene(still: Any, wall: Any, points: int, cutoff: Any) -> tuple[Any, ...]:
    """What does not move in a simulation.

    Returns:
        indices of existing people; their destinations (N, 4); each of them with his own
        destination (2, N); existing wall points sorted by cell (P, 4); their cells; where every
        cell begins.
    """
    who = _who(still[:, 2])
    goal, everybody = blank(len(who), 4, still), np.empty((2, len(who)), np.int32)
    for k in range(len(who)):
        goal[k, 0], goal[k, 1] = still[who[k], 0], still[who[k], 1]
        everybody[0, k] = everybody[1, k] = k
    solid = _who(wall[:points, 4])
    some, barrier = blank(len(solid), 4, wall), blank(len(solid), 4, wall)
    _take(some, wall, solid)
    cells = grid(some[:, 0], some[:, 1], cutoff)
    order, _, start = sort(some[:, 0], some[:, 1], cells)
    _take(barrier, some, order)
    return who, goal, everybody, barrier, cells, start


@njit(**LOOP)
def _people(
    y: Any, own: Any, cutoff: Any, mutual: bool, first: int, pairs: Any
) -> tuple[Any, Any, int]:
    """Sort people by cell into ``own``; their order, pairs of places in it, their number."""
    cells = grid(y[:, 0], y[:, 1], cutoff)
    order, cell, start = sort(y[:, 0], y[:, 1], cells)
    _take(own, y, order)
    pairs, number = people_near(own[:, 0], own[:, 1], cells, cell, start, cutoff, pairs)
    if not mutual:
        pairs, number = both_ways(pairs, number)
    if first == 0:
        pairs, number = with_oneself(pairs, number, len(own))
    return order, pairs, number


@njit(**LOOP)
def _slip(rows: Any, slip: Any) -> None:
    """Velocities of rows (·, 4) times ``slip``."""
    for k in range(len(rows)):
        rows[k, 2] *= slip
        rows[k, 3] *= slip


@njit(nogil=True, cache=True, **LOOP)
def forward(
    jobs: Any, order: Any, per: int, dt: Any, y0: Any, still: Any, wall: Any, scale: Any,
    end: Any, rate: Any, slip: Any, mutual: bool, first: int, q: Any, q_wall: Any, states: Any,
    out: Any, cutoff: Any, cutoff_wall: Any,
) -> None:  # fmt: skip
    """As the function of the same name in crowd_dense; every block is one simulation."""
    room = blank(1, ROWS * SIZE, scale)[0]
    steps = per * (out.shape[0] - 1)
    pairs, touched = np.empty((2, 1024), np.int32), np.empty((2, 1024), np.int32)
    for job in range(jobs.shape[0]):
        b, points, place = order[jobs[job, 0]], jobs[job, 3], jobs[job, 4]
        who, goal, everybody, barrier, cells, start = _scene(still[b], wall[b], points, cutoff_wall)
        number = len(who)
        y, own = blank(number, 4, scale), blank(number, 4, scale)
        force, push = blank(number, 2, scale), blank(number, 2, scale)
        drive = blank(number, 2, scale)
        _take(y, y0[b], who)
        for step in range(steps):
            if step % per == 0:
                _put(y, out[step // per, b], who)
            if states.shape[0] > 0:
                begin = place + 4 * step * number
                for i in range(number):
                    copy(states[begin + 4 * i :], y[i])
            if step > end[b]:
                continue
            sequel, pairs, meetings = _people(y, own, cutoff, mutual, first, pairs)
            clear(force)
            _meet(room, own, own, pairs, meetings, mutual, q, force)
            clear(push)
            if points:
                touched, meetings = points_near(
                    own[:, 0], own[:, 1], barrier[:, 0], barrier[:, 1], cells, start,
                    cutoff_wall, touched,
                )  # fmt: skip
                _slip(own, slip)
                _meet(room, own, barrier, touched, meetings, False, q_wall, push)
            clear(drive)
            _meet(room, y, goal, everybody, number, False, (rate,), drive)
            for k in range(number):
                i = sequel[k]
                for c in range(2):
                    both = force[k, c] * scale[b, 0] + push[k, c] * scale[b, 1]
                    y[i, c] += dt * y[i, 2 + c]
                    y[i, 2 + c] += dt * (drive[i, c] + both)
        _put(y, out[steps // per, b], who)


@njit(nogil=True, cache=True, **LOOP)
def backward(
    jobs: Any, order: Any, per: int, dt: Any, still: Any, wall: Any, scale: Any, end: Any,
    rate: Any, slip: Any, mutual: bool, first: int, q: Any, q_wall: Any, states: Any,
    grad_out: Any, grad_y0: Any, total: Any, total_wall: Any, cutoff: Any, cutoff_wall: Any,
) -> None:  # fmt: skip
    """As the function of the same name in crowd_dense."""
    room = blank(1, ROWS * SIZE, scale)[0]
    steps = per * (grad_out.shape[0] - 1)
    pairs, touched = np.empty((2, 1024), np.int32), np.empty((2, 1024), np.int32)
    for job in range(jobs.shape[0]):
        b, points, place = order[jobs[job, 0]], jobs[job, 3], jobs[job, 4]
        who, goal, everybody, barrier, cells, start = _scene(still[b], wall[b], points, cutoff_wall)
        number = len(who)
        y, own = blank(number, 4, scale), blank(number, 4, scale)
        adjoint, observed = blank(number, 4, scale), blank(number, 4, scale)
        change, to_own = blank(number, 4, scale), blank(number, 4, scale)
        to_wall, weight = blank(number, 4, scale), blank(number, 2, scale)
        weight_own, weight_wall = blank(number, 2, scale), blank(number, 2, scale)
        for step in range(steps - 1, -1, -1):
            if (step + 1) % per == 0:
                _take(observed, grad_out[(step + 1) // per, b], who)
                for i in range(number):
                    increase(adjoint[i], observed[i])
            if step > end[b]:
                continue
            begin = place + 4 * step * number
            for i in range(number):
                copy(y[i], states[begin + 4 * i : begin + 4 * i + 4])
                for c in range(2):
                    weight[i, c] = dt * adjoint[i, 2 + c]
            sequel, pairs, meetings = _people(y, own, cutoff, mutual, first, pairs)
            for k in range(number):
                for c in range(2):
                    weight_own[k, c] = weight[sequel[k], c] * scale[b, 0]
                    weight_wall[k, c] = weight[sequel[k], c] * scale[b, 1]
            clear(to_own)
            _meet_pull(room, own, own, pairs, meetings, mutual, True, q, weight_own, total, to_own)
            clear(to_wall)
            if points:
                touched, meetings = points_near(
                    own[:, 0], own[:, 1], barrier[:, 0], barrier[:, 1], cells, start,
                    cutoff_wall, touched,
                )  # fmt: skip
                _slip(own, slip)
                _meet_pull(
                    room, own, barrier, touched, meetings, False, False, q_wall, weight_wall,
                    total_wall, to_wall,
                )  # fmt: skip
                _slip(to_wall, slip)
            clear(change)
            _meet_pull(
                room, y, goal, everybody, number, False, False, (rate,), weight, total, change
            )
            for k in range(number):
                i = sequel[k]
                for c in range(4):
                    change[i, c] += to_own[k, c] + to_wall[k, c]
            for i in range(number):
                for c in range(2):
                    adjoint[i, 2 + c] += dt * adjoint[i, c]
                increase(adjoint[i], change[i])
        _take(observed, grad_out[0, b], who)
        for i in range(number):
            increase(adjoint[i], observed[i])
        _put(adjoint, grad_y0[b], who)
