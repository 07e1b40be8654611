"""Compiled building blocks of crowds: receivers of forces against shifted rows of sources.

A block of ``width`` simulations is one row of numbers: person i of simulation b stands at
``i * width + b``. Sources (people, wall points, destinations) stand in longer rows that
continue periodically. Receiver i then meets source (i + shift) modulo their number, which is
a difference of two slices, whatever the number of people and simulations.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from nnode.simulate._math import real
from nnode.solvers.fused.crowd_laws import LANES, LOOP, SIZE, law, law_pull


@njit(**LOOP)
def blank(rows: int, length: int, like: Any) -> Any:
    """Zeros ``(rows, length)`` of the type of the array ``like``."""
    return np.zeros((rows, length), like.dtype)


@njit(**LOOP)
def subtract(target: Any, a: Any, b: Any) -> None:
    for t in range(len(target)):
        target[t] = a[t] - b[t]


@njit(**LOOP)
def copy(target: Any, a: Any) -> None:
    for t in range(len(a)):
        target[t] = a[t]


@njit(**LOOP)
def multiply(target: Any, a: Any, factor: Any) -> None:
    for t in range(len(target)):
        target[t] = factor * a[t]


@njit(**LOOP)
def clear(rows: Any) -> None:
    """Zeros in all rows of two axes."""
    zero = real(0, rows[0, 0])
    for c in range(rows.shape[0]):
        for t in range(rows.shape[1]):
            rows[c, t] = zero


@njit(**LOOP)
def add_product(target: Any, a: Any, b: Any) -> None:
    for t in range(len(target)):
        target[t] = target[t] + a[t] * b[t]


@njit(**LOOP)
def subtract_product(target: Any, a: Any, b: Any) -> None:
    for t in range(len(target)):
        target[t] = target[t] - a[t] * b[t]


@njit(**LOOP)
def increase(target: Any, a: Any) -> None:
    for t in range(len(target)):
        target[t] = target[t] + a[t]


@njit(**LOOP)
def decrease(target: Any, a: Any) -> None:
    for t in range(len(target)):
        target[t] = target[t] - a[t]


@njit(**LOOP)
def product(target: Any, a: Any, b: Any) -> None:
    for t in range(len(target)):
        target[t] = a[t] * b[t]


@njit(**LOOP)
def fill_up(room: Any, n: int, rows: int) -> int:
    """Zeros after the first ``n`` numbers of the first rows, up to a whole vector."""
    full = (n + LANES - 1) // LANES * LANES
    zero = real(0, room[0])
    for row in range(rows):
        for t in range(row * SIZE + n, row * SIZE + full):
            room[t] = zero
    return full


@njit(**LOOP)
def pieces(length: int) -> int:
    """Length of equal pieces of at most SIZE numbers."""
    number = max(1, (length + SIZE - 1) // SIZE)
    piece = max(1, (length + number - 1) // number)
    return (piece + LANES - 1) // LANES * LANES


@njit(**LOOP)
def meeting(length: int, shift: int, number: int, mutual: bool) -> int:
    """Receivers that act at this shift: half of them where both partners would be one."""
    return length // 2 if mutual and 2 * shift == number else length


@njit(**LOOP)
def interact(
    room: Any, sides: Any, span: Any, mutual: bool, q: Any, force: Any, reaction: Any, memory: Any
) -> None:
    """Add the forces of sources on receivers.

    Args:
        sides: x, y, u, v of the receivers ``(4, L)``; 1 for every receiver that exists, else
            0; the same two of the sources, periodic.
        span: simulations in a row, first shift, and one more than the last shift.
        mutual: the sources are the receivers, and feel the opposite force.
        force: ``(2, L)`` sums over existing sources.
        reaction: ``(2, 2 L)`` sums over existing receivers, where ``mutual``.
        memory: not used here.
    """
    own, real_own, other, real_other = sides
    width, first, last = span
    length = own.shape[1]
    piece = pieces(length)
    for shift in range(first, last):
        away = shift * width
        stop = meeting(length, shift, length // width, mutual)
        for low in range(0, stop, piece):
            n = min(piece, stop - low)
            for c in range(4):
                subtract(room[c * SIZE : c * SIZE + n], own[c, low:], other[c, low + away :])
            law(room, fill_up(room, n, 4), q)
            for c in range(2):
                found = room[(4 + c) * SIZE : (5 + c) * SIZE]
                add_product(force[c, low : low + n], real_other[low + away :], found)
                if mutual:
                    target = reaction[c, low + away : low + away + n]
                    subtract_product(target, real_own[low:], found)


@njit(**LOOP)
def interact_pull(
    room: Any, sides: Any, span: Any, mutual: bool, moving: bool, q: Any, weight: Any,
    total: Any, to_own: Any, to_other: Any, memory: Any,
) -> None:  # fmt: skip
    """Gradient of :func:`interact`.

    Args:
        moving: the gradient with respect to the sources is wanted.
        weight: ``(2, 2 L)`` of the forces, periodic.
        total: gradient with respect to ``q``, added to.
        to_own, to_other: gradients with respect to receivers and sources, added to.
    """
    own, real_own, other, real_other = sides
    width, first, last = span
    length = own.shape[1]
    piece = pieces(length)
    for shift in range(first, last):
        away = shift * width
        stop = meeting(length, shift, length // width, mutual)
        for low in range(0, stop, piece):
            n = min(piece, stop - low)
            for c in range(4):
                subtract(room[c * SIZE : c * SIZE + n], own[c, low:], other[c, low + away :])
            for c in range(2):
                row = room[(4 + c) * SIZE : (4 + c) * SIZE + n]
                product(row, weight[c, low:], real_other[low + away :])
                if mutual:
                    subtract_product(row, weight[c, low + away :], real_own[low:])
            law_pull(room, fill_up(room, n, 6), q, total)
            for c in range(4):
                found = room[(6 + c) * SIZE : (7 + c) * SIZE]
                increase(to_own[c, low : low + n], found)
                if moving:
                    decrease(to_other[c, low + away : low + away + n], found)
