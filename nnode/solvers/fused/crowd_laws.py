"""Forces on people as compiled functions of rows, and their derivatives.

A row holds one number of up to SIZE interactions. All rows of a call stand in one array,
``room``, at distances that are known when it is compiled: only so can the compiler tell that
nothing that it writes is something that it still has to read, and make vector instructions.

=======  ==========================  ===================================================
rows     forward                     backward
=======  ==========================  ===================================================
0, 1     x_i - x_j, m                the same
2, 3     v_i - v_j, m/s              the same
4, 5     force (written)             its weight in the gradient
6 ... 9                              gradient with respect to rows 0 ... 3 (written)
=======  ==========================  ===================================================

The type of the parameters chooses the law:

* a tuple (1 / tau,): relaxation, j is the destination and v_j = 0;
* one axis, (A, k, kappa, reach, 1 / B): social force, with reach = 2r, or r at walls;
* two axes, (hidden + 1, 7): a network; a row (four weights, bias, two output weights) for
  every hidden neuron, then (two output biases, 0, ...).
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import overload

from nnode.models.crowd import SMOOTHING
from nnode.simulate._math import exp, real, torch_softplus
from nnode.simulate.lane_rows import add

#: Numbers in a row; ten rows of float32 stay in the first-level cache.
SIZE = 512
#: Rows are filled up to a multiple of this with zeros, so that loops leave nothing over.
LANES = 16
ROWS = 10

#: Options of functions that hold a loop.
LOOP: Any = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}

# unsigned: a signed index may be negative, and would be tested for it in every load
_1, _2, _3, _4, _5, _6, _7, _8, _9 = (np.uint64(row * SIZE) for row in range(1, ROWS))


@njit(**LOOP)
def _relaxation(room: Any, n: int, rate: Any) -> None:
    small = real(SMOOTHING**2, rate)
    for t in range(np.uint64(n)):
        x, y, u, v = room[t], room[t + _1], room[t + _2], room[t + _3]
        pace = sqrt(u * u + v * v + small) / sqrt(x * x + y * y + small)
        room[t + _4] = -rate * (x * pace + u)
        room[t + _5] = -rate * (y * pace + v)


@njit(**LOOP)
def _relaxation_pull(room: Any, n: int, rate: Any) -> None:
    small, one = real(SMOOTHING**2, rate), real(1, rate)
    for t in range(np.uint64(n)):
        x, y, u, v = room[t], room[t + _1], room[t + _2], room[t + _3]
        g, h = -rate * room[t + _4], -rate * room[t + _5]
        speed = sqrt(u * u + v * v + small)
        nearness = one / sqrt(x * x + y * y + small)
        pace = speed * nearness
        slope = (g * x + h * y) * nearness
        toward = slope * pace * nearness
        faster = slope / speed
        room[t + _6] = g * pace - toward * x
        room[t + _7] = h * pace - toward * y
        room[t + _8] = g + faster * u
        room[t + _9] = h + faster * v


@njit(**LOOP)
def _social(room: Any, n: int, q: Any) -> None:
    A, k, kappa, reach, per_b = q[0], q[1], q[2], q[3], q[4]
    small, zero, one = real(SMOOTHING**2, A), real(0, A), real(1, A)
    for t in range(np.uint64(n)):
        x, y, u, v = room[t], room[t + _1], room[t + _2], room[t + _3]
        d = sqrt(x * x + y * y + small)
        inverse = one / d
        nx, ny = x * inverse, y * inverse
        overlap = reach - d
        contact = overlap if overlap > zero else zero
        push = A * exp(overlap * per_b) + k * contact
        slide = kappa * contact * (u * ny - v * nx)
        room[t + _4] = push * nx - slide * ny
        room[t + _5] = push * ny + slide * nx


@njit(**LOOP)
def _social_pull(room: Any, n: int, q: Any, total: Any) -> None:
    A, k, kappa, reach, per_b = q[0], q[1], q[2], q[3], q[4]
    small, zero, one = real(SMOOTHING**2, A), real(0, A), real(1, A)
    to_a, to_k, to_kappa = zero, zero, zero
    for t in range(np.uint64(n)):
        x, y, u, v = room[t], room[t + _1], room[t + _2], room[t + _3]
        g, h = room[t + _4], room[t + _5]
        d = sqrt(x * x + y * y + small)
        inverse = one / d
        nx, ny = x * inverse, y * inverse
        overlap = reach - d
        touch = overlap >= zero
        contact = overlap if touch else zero
        decay = exp(overlap * per_b)
        slip = u * ny - v * nx
        push, slide = A * decay + k * contact, kappa * contact * slip
        along, across = g * nx + h * ny, h * nx - g * ny
        to_a = add(to_a, along * decay)
        to_k = add(to_k, along * contact)
        to_kappa = add(to_kappa, across * contact * slip)
        steep = (along * k + across * kappa * slip) if touch else zero
        to_slip = across * kappa * contact
        to_nx = g * push + h * slide - to_slip * v
        to_ny = h * push - g * slide + to_slip * u
        to_d = -(along * A * decay * per_b + steep) - (to_nx * nx + to_ny * ny) * inverse
        room[t + _6] = to_nx * inverse + to_d * nx
        room[t + _7] = to_ny * inverse + to_d * ny
        room[t + _8] = to_slip * ny
        room[t + _9] = -to_slip * nx
    total[0] += to_a
    total[1] += to_k
    total[2] += to_kappa


@njit(**LOOP)
def _network(room: Any, n: int, q: Any) -> None:
    hidden = q.shape[0] - 1
    bias_x, bias_y = q[hidden, 0], q[hidden, 1]
    for t in range(np.uint64(n)):
        room[t + _4] = bias_x
        room[t + _5] = bias_y
    for m in range(hidden):
        a, b, c, d = q[m, 0], q[m, 1], q[m, 2], q[m, 3]
        bias, to_x, to_y = q[m, 4], q[m, 5], q[m, 6]
        for t in range(np.uint64(n)):
            z = bias + a * room[t] + b * room[t + _1] + c * room[t + _2] + d * room[t + _3]
            value, _ = torch_softplus(z)
            room[t + _4] = room[t + _4] + to_x * value
            room[t + _5] = room[t + _5] + to_y * value


@njit(**LOOP)
def _network_pull(room: Any, n: int, q: Any, total: Any) -> None:
    hidden = q.shape[0] - 1
    zero = real(0, q[0, 0])
    sum_x, sum_y = zero, zero
    for t in range(np.uint64(n)):
        sum_x = add(sum_x, room[t + _4])
        sum_y = add(sum_y, room[t + _5])
        room[t + _6] = zero
        room[t + _7] = zero
        room[t + _8] = zero
        room[t + _9] = zero
    total[hidden, 0] += sum_x
    total[hidden, 1] += sum_y
    for m in range(hidden):
        a, b, c, d = q[m, 0], q[m, 1], q[m, 2], q[m, 3]
        bias, to_x, to_y = q[m, 4], q[m, 5], q[m, 6]
        sum_a, sum_b, sum_c, sum_d, sum_bias = zero, zero, zero, zero, zero
        sum_x, sum_y = zero, zero
        for t in range(np.uint64(n)):
            x, y, u, v = room[t], room[t + _1], room[t + _2], room[t + _3]
            g, h = room[t + _4], room[t + _5]
            value, slope = torch_softplus(bias + a * x + b * y + c * u + d * v)
            back = (g * to_x + h * to_y) * slope
            sum_x = add(sum_x, g * value)
            sum_y = add(sum_y, h * value)
            sum_bias = add(sum_bias, back)
            sum_a = add(sum_a, back * x)
            sum_b = add(sum_b, back * y)
            sum_c = add(sum_c, back * u)
            sum_d = add(sum_d, back * v)
            room[t + _6] = room[t + _6] + back * a
            room[t + _7] = room[t + _7] + back * b
            room[t + _8] = room[t + _8] + back * c
            room[t + _9] = room[t + _9] + back * d
        total[m, 0] += sum_a
        total[m, 1] += sum_b
        total[m, 2] += sum_c
        total[m, 3] += sum_d
        total[m, 4] += sum_bias
        total[m, 5] += sum_x
        total[m, 6] += sum_y


def law(room: Any, n: int, q: Any) -> None:
    """Forces of ``n`` interactions; inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


def law_pull(room: Any, n: int, q: Any, total: Any) -> None:
    """Gradients of ``n`` interactions, those of the parameters added to ``total``, which has
    the shape of ``q`` and is float64; inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


def _axes(q: Any) -> int:
    return 0 if isinstance(q, types.BaseTuple) else int(q.ndim)


@overload(law)
def _law(room: Any, n: Any, q: Any) -> Callable[..., Any]:
    def relaxation(room: Any, n: Any, q: Any) -> None:
        _relaxation(room, n, q[0])

    def social(room: Any, n: Any, q: Any) -> None:
        _social(room, n, q)

    def network(room: Any, n: Any, q: Any) -> None:
        _network(room, n, q)

    return (relaxation, social, network)[_axes(q)]


@overload(law_pull)
def _law_pull(room: Any, n: Any, q: Any, total: Any) -> Callable[..., Any]:
    def relaxation(room: Any, n: Any, q: Any, total: Any) -> None:
        _relaxation_pull(room, n, q[0])

    def social(room: Any, n: Any, q: Any, total: Any) -> None:
        _social_pull(room, n, q, total)

    def network(room: Any, n: Any, q: Any, total: Any) -> None:
        _network_pull(room, n, q, total)

    return (relaxation, social, network)[_axes(q)]
