"""Everybody meets everybody: simulation and gradient of blocks of crowds.

The package loads a copy of this file from the cache folder, see
:mod:`nnode.solvers.fused.crowd_cache`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from nnode.solvers.fused._math import real
from nnode.solvers.fused.crowd_laws import LOOP, ROWS, SIZE
from nnode.solvers.fused.crowd_rows import increase, interact, interact_pull, product


@njit(**LOOP)
def _scene(
    members: Any, people: int, points: int, still: Any, wall: Any, scale: Any
) -> tuple[Any, ...]:
    """Rows of what does not move in a block.

    Returns:
        existing people (2 L), destinations (4, L), wall points (4, ·), existing wall points,
        scales of pair and wall forces (2, L).
    """
    width = len(members)
    length = people * width
    exists, goal = np.zeros(2 * length, scale.dtype), np.zeros((4, length), scale.dtype)
    scales = np.zeros((2, length), scale.dtype)
    rows = (points + people) * width if points else 0
    barrier, solid = np.zeros((4, rows), scale.dtype), np.zeros(rows, scale.dtype)
    for b in range(width):
        member = members[b]
        for i in range(people):
            at = i * width + b
            goal[0, at], goal[1, at] = still[member, i, 0], still[member, i, 1]
            exists[at] = exists[at + length] = still[member, i, 2]
            scales[0, at], scales[1, at] = scale[member, 0], scale[member, 1]
        for p in range(rows // width):
            for c in range(4):
                barrier[c, p * width + b] = wall[member, p % points, c]
            solid[p * width + b] = wall[member, p % points, 4]
    return exists, goal, barrier, solid, scales


@njit(**LOOP)
def _load(rows: Any, values: Any, members: Any, people: int) -> None:
    """Add values (B, N, 4) to rows."""
    width = len(members)
    for b in range(width):
        for i in range(people):
            for c in range(4):
                rows[c, i * width + b] += values[members[b], i, c]


@njit(**LOOP)
def _store(rows: Any, values: Any, members: Any, people: int) -> None:
    """Rows into values (B, N, 4)."""
    width = len(members)
    for b in range(width):
        for i in range(people):
            for c in range(4):
                values[members[b], i, c] = rows[c, i * width + b]


@njit(**LOOP)
def _periods(move: Any, exists: Any, members: Any, end: Any, step: int, dt: Any) -> None:
    """Time step of every person, 0 for whoever stands still."""
    width = len(members)
    for b in range(width):
        now = dt if step <= end[members[b]] else real(0, dt)
        for at in range(b, len(move), width):
            move[at] = now * exists[at]


@njit(nogil=True, cache=True, **LOOP)
def forward(
    jobs: Any,
    order: Any,
    per: int,
    dt: Any,
    y0: Any,
    still: Any,
    wall: Any,
    scale: Any,
    end: Any,
    rate: Any,
    slip: Any,
    mutual: bool,
    q: Any,
    q_wall: Any,
    states: Any,
    out: Any,
) -> None:
    """Simulate the blocks ``jobs``, rows of first, width, people, wall points, place in
    ``states``; see :class:`nnode.solvers.fused.crowd._Plan` for the rest."""  # fmt: skip
    kind = y0.dtype
    room = np.zeros(ROWS * SIZE, kind)
    steps = per * (out.shape[0] - 1)
    for job in range(jobs.shape[0]):
        low, width, people, points, place = jobs[job]
        members = order[low : low + width]
        length = people * width
        exists, goal, barrier, solid, scales = _scene(members, people, points, still, wall, scale)
        y, at_wall = np.zeros((4, 2 * length), kind), np.zeros((4, length), kind)
        pull, reaction = np.zeros((2, length), kind), np.zeros((2, 2 * length), kind)
        push, drive = np.zeros((2, length), kind), np.zeros((2, length), kind)
        move, always = np.zeros(length, kind), np.ones(length, kind)
        _load(y, y0, members, people)
        shifts = people // 2 + 1 if mutual else people
        for step in range(steps):
            if step % per == 0:
                _store(y, out[step // per], members, people)
            if states.shape[0] > 0:
                for c in range(4):
                    begin = place + (step * 4 + c) * length
                    states[begin : begin + length] = y[c, :length]
            y[:, length:] = y[:, :length]
            own = y[:, :length]
            drive[:] = 0
            interact(room, own, exists, goal, always, width, 0, 1, False, (rate,), drive, reaction)
            pull[:] = 0
            reaction[:] = 0
            interact(room, own, exists, y, exists, width, 1, shifts, mutual, q, pull, reaction)
            push[:] = 0
            if points:
                at_wall[:2] = own[:2]
                at_wall[2:] = slip * own[2:]
                interact(
                    room,
                    at_wall,
                    exists,
                    barrier,
                    solid,
                    width,
                    0,
                    points,
                    False,
                    q_wall,
                    push,
                    reaction,
                )
            _periods(move, exists, members, end, step, dt)
            for c in range(2):
                increase(pull[c], reaction[c, :length])
                increase(pull[c], reaction[c, length:])
                for t in range(length):
                    both = pull[c, t] * scales[0, t] + push[c, t] * scales[1, t]
                    y[c, t] += move[t] * y[2 + c, t]
                    y[2 + c, t] += move[t] * (drive[c, t] + both)
        _store(y, out[steps // per], members, people)


@njit(nogil=True, cache=True, **LOOP)
def backward(
    jobs: Any,
    order: Any,
    per: int,
    dt: Any,
    still: Any,
    wall: Any,
    scale: Any,
    end: Any,
    rate: Any,
    slip: Any,
    mutual: bool,
    q: Any,
    q_wall: Any,
    states: Any,
    grad_out: Any,
    grad_y0: Any,
    total: Any,
    total_wall: Any,
) -> None:
    """Gradient of :func:`forward`; ``total`` and ``total_wall`` are added to."""  # fmt: skip
    kind = grad_out.dtype
    room = np.zeros(ROWS * SIZE, kind)
    steps = per * (grad_out.shape[0] - 1)
    for job in range(jobs.shape[0]):
        low, width, people, points, place = jobs[job]
        members = order[low : low + width]
        length = people * width
        exists, goal, barrier, solid, scales = _scene(members, people, points, still, wall, scale)
        y, at_wall = np.zeros((4, 2 * length), kind), np.zeros((4, length), kind)
        adjoint, to_own = np.zeros((4, length), kind), np.zeros((4, length), kind)
        to_other, to_wall = np.zeros((4, 2 * length), kind), np.zeros((4, length), kind)
        weight, weighed = np.zeros((2, length), kind), np.zeros((2, 2 * length), kind)
        move, always = np.zeros(length, kind), np.ones(length, kind)
        shifts = people // 2 + 1 if mutual else people
        for step in range(steps - 1, -1, -1):
            if (step + 1) % per == 0:
                _load(adjoint, grad_out[(step + 1) // per], members, people)
            for c in range(4):
                begin = place + (step * 4 + c) * length
                y[c, :length] = states[begin : begin + length]
                y[c, length:] = states[begin : begin + length]
            own = y[:, :length]
            _periods(move, exists, members, end, step, dt)
            for c in range(2):
                product(weight[c], move, adjoint[2 + c])
                product(weighed[c, :length], weight[c], scales[0])
                weighed[c, length:] = weighed[c, :length]
            to_own[:] = 0
            to_other[:] = 0
            interact_pull(
                room,
                own,
                exists,
                goal,
                always,
                width,
                0,
                1,
                False,
                False,
                (rate,),
                weight,
                total,
                to_own,
                to_other,
            )
            interact_pull(
                room,
                own,
                exists,
                y,
                exists,
                width,
                1,
                shifts,
                mutual,
                True,
                q,
                weighed,
                total,
                to_own,
                to_other,
            )
            if points:
                at_wall[:2] = own[:2]
                at_wall[2:] = slip * own[2:]
                to_wall[:] = 0
                for c in range(2):
                    product(weighed[c, :length], weight[c], scales[1])
                interact_pull(
                    room,
                    at_wall,
                    exists,
                    barrier,
                    solid,
                    width,
                    0,
                    points,
                    False,
                    False,
                    q_wall,
                    weighed,
                    total_wall,
                    to_wall,
                    to_other,
                )
                to_wall[2:] = slip * to_wall[2:]
                for c in range(4):
                    increase(to_own[c], to_wall[c])
            for c in range(4):
                increase(to_own[c], to_other[c, :length])
                increase(to_own[c], to_other[c, length:])
            for c in range(2):
                for t in range(length):
                    adjoint[2 + c, t] += move[t] * adjoint[c, t]
            for c in range(4):
                increase(adjoint[c], to_own[c])
        _load(adjoint, grad_out[0], members, people)
        _store(adjoint, grad_y0, members, people)
