"""Forces by networks where everybody meets everybody: sums of hidden neurons, not of forces.

The first layer is linear, so the input of a neuron is a difference of two numbers, one of the
receiver and one of the source, and the output layer can act on sums over sources:

    force_i = b2 n_i + sum over neurons u of w2_u S_iu,   S_iu = sum over j of s(b_u + P_iu - P_ju)

with P = w_u (x, y, u, v), s the softplus and n_i the number of sources. The gradient needs the
same sums of s', taken over sources for receivers and over receivers for sources. What remains
per pair and neuron is one subtraction, one evaluation of s or s' and one addition.

S and the sums of s' over sources are kept from the simulation for the way back.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numba.extending import overload

from nnode.simulate._math import real, torch_softplus
from nnode.simulate.lane_rows import add
from nnode.solvers.fused.crowd_laws import LANES, LOOP, SIZE
from nnode.solvers.fused.crowd_rows import copy, interact, interact_pull, pieces

# unsigned: a signed index may be negative, and would be tested for it in every load
_1, _2 = np.uint64(SIZE), np.uint64(2 * SIZE)


@njit(**LOOP)
def _values(room: Any, source: Any, weight: Any, n: int) -> None:
    for t in range(np.uint64(n)):
        value, _ = torch_softplus(room[t] - source[t])
        room[t + _1] = room[t + _1] + weight[t] * value


@njit(**LOOP)
def _slopes(room: Any, source: Any, weight: Any, n: int) -> None:
    for t in range(np.uint64(n)):
        _, slope = torch_softplus(room[t] - source[t])
        room[t + _2] = room[t + _2] + weight[t] * slope


@njit(**LOOP)
def _both(room: Any, source: Any, weight: Any, n: int) -> None:
    for t in range(np.uint64(n)):
        value, slope = torch_softplus(room[t] - source[t])
        room[t + _1] = room[t + _1] + weight[t] * value
        room[t + _2] = room[t + _2] + weight[t] * slope


@njit(**LOOP)
def _sums(
    room: Any,
    own: Any,
    source: Any,
    weight: Any,
    width: int,
    first: int,
    last: int,
    value: Any,
    slope: Any,
) -> None:
    """Sums of weight s(own - source) and of weight s'(own - source) over sources.

    Args:
        own: ``(L,)``.
        source, weight: periodic, with LANES numbers of any kind behind the last.
        value, slope: ``(L,)`` each, or empty where they are not wanted.
    """  # fmt: skip
    length = len(own)
    piece = pieces(length)
    for low in range(0, length, piece):
        n = min(piece, length - low)
        full = (n + LANES - 1) // LANES * LANES
        for t in range(3 * SIZE):
            room[t] = 0
        copy(room, own[low : low + n])
        for shift in range(first, last):
            begin = low + shift * width
            there, share = source[begin : begin + full], weight[begin : begin + full]
            if len(value) == 0:
                _slopes(room, there, share, full)
            elif len(slope) == 0:
                _values(room, there, share, full)
            else:
                _both(room, there, share, full)
        if len(value):
            copy(value[low:], room[SIZE : SIZE + n])
        if len(slope):
            copy(slope[low:], room[2 * SIZE : 2 * SIZE + n])


@njit(**LOOP)
def _weigh(
    target: Any, x: Any, y: Any, u: Any, v: Any, at_x: Any, at_y: Any, q: Any, start: Any
) -> None:
    """``start`` and the weighted sum of states, places counted from (at_x, at_y)."""
    a, b, c, d = q[0], q[1], q[2], q[3]
    for t in range(len(x)):
        target[t] = start + (a * (x[t] - at_x) + b * (y[t] - at_y) + c * u[t] + d * v[t])


@njit(**LOOP)
def _numbers(real_other: Any, length: int, width: int, first: int) -> Any:
    """How many sources every receiver meets; receivers do not meet themselves."""
    lanes = np.zeros(width, real_other.dtype)
    for t in range(len(real_other) - length):
        lanes[t % width] += real_other[t]
    found = np.empty(length, real_other.dtype)
    for t in range(length):
        found[t] = lanes[t % width] - (real_other[t] if first else real(0, lanes[0]))
    return found


def _network(
    room: Any, sides: Any, span: Any, mutual: bool, q: Any, force: Any, reaction: Any, memory: Any
) -> None:
    own, _, other, real_other = sides
    width, first, last = span
    length, everywhere = own.shape[1], other.shape[1]
    hidden, zero = q.shape[0] - 1, real(0, q[0, 0])
    place = np.empty(length, q.dtype)
    source = np.zeros(everywhere + LANES, q.dtype)
    weight = np.zeros(everywhere + LANES, q.dtype)
    copy(weight, real_other)
    value, slope = np.empty(length, q.dtype), np.empty(length if memory.size else 0, q.dtype)
    # large coordinates would cost digits of the differences
    at_x, at_y = own[0, 0], own[1, 0]
    number = _numbers(real_other, length, width, first)
    for t in range(length):
        force[0, t] += q[hidden, 0] * number[t]
        force[1, t] += q[hidden, 1] * number[t]
    for m in range(hidden):
        _weigh(place, own[0], own[1], own[2], own[3], at_x, at_y, q[m], q[m, 4])
        _weigh(source, other[0], other[1], other[2], other[3], at_x, at_y, q[m], zero)
        _sums(room, place, source, weight, width, first, last, value, slope)
        to_x, to_y = q[m, 5], q[m, 6]
        for t in range(length):
            force[0, t] += to_x * value[t]
            force[1, t] += to_y * value[t]
        if memory.size:
            copy(memory[0, m], value)
            copy(memory[1, m], slope)


@njit(**LOOP)
def _dot(a: Any, b: Any) -> Any:
    total = real(0, a[0])
    for t in range(len(a)):
        total = add(total, a[t] * b[t])
    return total


@njit(**LOOP)
def _dot_from(a: Any, b: Any, at: Any) -> Any:
    total = real(0, a[0])
    for t in range(len(a)):
        total = add(total, a[t] * (b[t] - at))
    return total


@njit(**LOOP)
def _add_multiple(target: Any, a: Any, factor: Any) -> None:
    for t in range(len(a)):
        target[t] = target[t] + factor * a[t]


def _network_pull(
    room: Any, sides: Any, span: Any, mutual: bool, moving: bool, q: Any, weight: Any,
    total: Any, to_own: Any, to_other: Any, memory: Any,
) -> None:  # fmt: skip
    own, _, other, real_other = sides
    width, first, _ = span
    length = own.shape[1]
    sources = other.shape[1] - length
    hidden, zero = q.shape[0] - 1, real(0, q[0, 0])
    place, share = np.empty(length, q.dtype), np.empty(length, q.dtype)
    back = np.empty(length, q.dtype)
    goal, pushed = np.empty(sources, q.dtype), np.empty(sources, q.dtype)
    # roles are exchanged: receivers stand in the long rows
    receiver = np.zeros(sources + length + LANES, q.dtype)
    shares = np.zeros(sources + length + LANES, q.dtype)
    at_x, at_y = own[0, 0], own[1, 0]
    number = _numbers(real_other, length, width, first)
    for c in range(2):
        total[hidden, c] += _dot(number, weight[c, :length])
    for m in range(hidden):
        to_x, to_y = q[m, 5], q[m, 6]
        for t in range(length):
            share[t] = to_x * weight[0, t] + to_y * weight[1, t]
            back[t] = share[t] * memory[1, m, t]
        for c in range(2):
            total[m, 5 + c] += _dot(memory[0, m], weight[c, :length])
        _weigh(place, own[0], own[1], own[2], own[3], at_x, at_y, q[m], q[m, 4])
        _weigh(goal, other[0, :sources], other[1], other[2], other[3], at_x, at_y, q[m], zero)
        for low in range(0, sources + length, length):
            n = min(length, sources + length - low)
            for t in range(n):
                receiver[low + t] = -place[t]
                shares[low + t] = share[t]
        for t in range(sources):
            goal[t] = -goal[t]
        _sums(room, goal, receiver, shares, width, first, length // width, goal[:0], pushed)
        for t in range(sources):
            pushed[t] = pushed[t] * real_other[t]
        for c in range(4):
            at = at_x if c == 0 else (at_y if c == 1 else zero)
            total[m, c] += _dot_from(back, own[c], at) - _dot_from(pushed, other[c], at)
            _add_multiple(to_own[c], back, q[m, c])
            if moving:
                _add_multiple(to_other[c], pushed, -q[m, c])
        for t in range(length):
            total[m, 4] += back[t]


def meet(
    room: Any, sides: Any, span: Any, mutual: bool, q: Any, force: Any, reaction: Any, memory: Any
) -> None:
    """As :func:`nnode.solvers.fused.crowd_rows.interact`, by sums of neurons if ``q`` is a
    network, whose sums ``memory`` (2, hidden, L) keeps unless it is empty."""
    raise TypeError("this function works only inside functions compiled by Numba")


def meet_pull(
    room: Any, sides: Any, span: Any, mutual: bool, moving: bool, q: Any, weight: Any,
    total: Any, to_own: Any, to_other: Any, memory: Any,
) -> None:  # fmt: skip
    """Gradient of :func:`meet`, with the ``memory`` that it has filled."""
    raise TypeError("this function works only inside functions compiled by Numba")


@overload(meet, jit_options=LOOP)
def _meet(
    room: Any, sides: Any, span: Any, mutual: bool, q: Any, force: Any, reaction: Any, memory: Any
) -> Callable[..., Any]:
    return _network if q.ndim == 2 else interact.py_func


@overload(meet_pull, jit_options=LOOP)
def _meet_pull(
    room: Any, sides: Any, span: Any, mutual: bool, moving: bool, q: Any, weight: Any,
    total: Any, to_own: Any, to_other: Any, memory: Any,
) -> Callable[..., Any]:  # fmt: skip
    return _network_pull if q.ndim == 2 else interact_pull.py_func
