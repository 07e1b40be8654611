"""Everybody meets everybody: simulation and gradient of blocks of crowds.

The package loads a copy of this file from the cache folder, see
:mod:`nnode.solvers.fused.crowd_cache`.
"""

from __future__ import annotations

from typing import Any

from numba import njit

from nnode.simulate._math import real
from nnode.solvers.fused.crowd_laws import LOOP, ROWS, SIZE
from nnode.solvers.fused.crowd_network import meet, meet_pull
from nnode.solvers.fused.crowd_rows import (
    blank,
    clear,
    copy,
    increase,
    interact,
    interact_pull,
    multiply,
    product,
)


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
    exists, goal = blank(1, 2 * length, scale)[0], blank(4, length, scale)
    scales = blank(2, length, scale)
    rows = (points + people) * width if points else 0
    barrier, solid = blank(4, rows, scale), blank(1, rows, scale)[0]
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
def _memory(kept: Any, length: int, hidden: int) -> tuple[Any, Any]:
    """Places (2, hidden, L) for what pair and wall networks keep; empty where nothing is kept."""
    size = 2 * hidden * length if len(kept) else 0
    shape = (2, hidden if size else 0, length)
    first = 4 * length if size else 0
    return (
        kept[first : first + size].reshape(shape),
        kept[first + size : first + 2 * size].reshape(shape),
    )


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
    first: int,
    q: Any,
    q_wall: Any,
    states: Any,
    out: Any,
) -> None:
    """Simulate the blocks ``jobs``, rows of first, width, people, wall points, place in
    ``states``; see :class:`nnode.solvers.fused.crowd._Plan` for the rest."""  # fmt: skip
    room, one = blank(1, ROWS * SIZE, scale)[0], real(1, dt)
    steps = per * (out.shape[0] - 1)
    hidden = q.shape[0] - 1 if q.ndim == 2 else 0
    for job in range(jobs.shape[0]):
        low, width, people = jobs[job, 0], jobs[job, 1], jobs[job, 2]
        points, place = jobs[job, 3], jobs[job, 4]
        members = order[low : low + width]
        length = people * width
        exists, goal, barrier, solid, scales = _scene(members, people, points, still, wall, scale)
        y, at_wall = blank(4, 2 * length, scale), blank(4, length, scale)
        pull, reaction = blank(2, length, scale), blank(2, 2 * length, scale)
        push, drive = blank(2, length, scale), blank(2, length, scale)
        move, always = blank(1, length, scale)[0], blank(1, length, scale)[0]
        for t in range(length):
            always[t] = one
        _load(y, y0, members, people)
        shifts = people // 2 + 1 if mutual else people
        for step in range(steps):
            if step % per == 0:
                _store(y, out[step // per], members, people)
            begin = place + step * (4 + 4 * hidden) * length
            kept = states[begin : begin + (4 + 4 * hidden) * length]
            if states.shape[0] > 0:
                for c in range(4):
                    copy(kept[c * length :], y[c, :length])
            sums, wall_sums = _memory(kept, length, hidden)
            for c in range(4):
                copy(y[c, length:], y[c, :length])
            own = y[:, :length]
            clear(drive)
            sides = (own, exists, goal, always)
            interact(room, sides, (width, 0, 1), False, (rate,), drive, reaction, sums)
            clear(pull)
            clear(reaction)
            sides = (own, exists, y, exists)
            meet(room, sides, (width, first, shifts), mutual, q, pull, reaction, sums)
            clear(push)
            if points:
                for c in range(4):
                    multiply(at_wall[c], own[c], one if c < 2 else slip)
                sides_wall = (at_wall, exists, barrier, solid)
                span = (width, 0, points)
                meet(room, sides_wall, span, False, q_wall, push, reaction, wall_sums)
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
    first: int,
    q: Any,
    q_wall: Any,
    states: Any,
    grad_out: Any,
    grad_y0: Any,
    total: Any,
    total_wall: Any,
) -> None:
    """Gradient of :func:`forward`; ``total`` and ``total_wall`` are added to."""  # fmt: skip
    room, one = blank(1, ROWS * SIZE, scale)[0], real(1, dt)
    steps = per * (grad_out.shape[0] - 1)
    hidden = q.shape[0] - 1 if q.ndim == 2 else 0
    for job in range(jobs.shape[0]):
        low, width, people = jobs[job, 0], jobs[job, 1], jobs[job, 2]
        points, place = jobs[job, 3], jobs[job, 4]
        members = order[low : low + width]
        length = people * width
        exists, goal, barrier, solid, scales = _scene(members, people, points, still, wall, scale)
        y, at_wall = blank(4, 2 * length, scale), blank(4, length, scale)
        adjoint, to_own = blank(4, length, scale), blank(4, length, scale)
        to_other, to_wall = blank(4, 2 * length, scale), blank(4, length, scale)
        weight, weighed = blank(2, length, scale), blank(2, 2 * length, scale)
        move, always = blank(1, length, scale)[0], blank(1, length, scale)[0]
        for t in range(length):
            always[t] = one
        shifts = people // 2 + 1 if mutual else people
        for step in range(steps - 1, -1, -1):
            if (step + 1) % per == 0:
                _load(adjoint, grad_out[(step + 1) // per], members, people)
            begin = place + step * (4 + 4 * hidden) * length
            kept = states[begin : begin + (4 + 4 * hidden) * length]
            for c in range(4):
                copy(y[c], kept[c * length : (c + 1) * length])
                copy(y[c, length:], y[c, :length])
            sums, wall_sums = _memory(kept, length, hidden)
            own = y[:, :length]
            _periods(move, exists, members, end, step, dt)
            for c in range(2):
                product(weight[c], move, adjoint[2 + c])
                product(weighed[c, :length], weight[c], scales[0])
                copy(weighed[c, length:], weighed[c, :length])
            clear(to_own)
            clear(to_other)
            span = (width, 0, 1)
            interact_pull(
                room, (own, exists, goal, always), span, False, False, (rate,), weight, total,
                to_own, to_other, sums,
            )  # fmt: skip
            span = (width, first, shifts)
            meet_pull(
                room, (own, exists, y, exists), span, mutual, True, q, weighed, total, to_own,
                to_other, sums,
            )  # fmt: skip
            if points:
                for c in range(4):
                    multiply(at_wall[c], own[c], one if c < 2 else slip)
                clear(to_wall)
                for c in range(2):
                    product(weighed[c, :length], weight[c], scales[1])
                span = (width, 0, points)
                meet_pull(
                    room, (at_wall, exists, barrier, solid), span, False, False, q_wall, weighed,
                    total_wall, to_wall, to_other, wall_sums,
                )  # fmt: skip
                for c in range(4):
                    multiply(to_wall[c], to_wall[c], one if c < 2 else slip)
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
