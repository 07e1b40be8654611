"""Compiled building blocks of crowds: receivers against shifted rows of sources.

A block of ``width`` simulations is one row of numbers: person i of simulation b stands at
``i * width + b``. Sources (people, wall points, walls) stand in longer rows that continue
periodically. Receiver i then meets source (i + shift) modulo their number, which is a difference
of two slices, whatever the number of people and simulations. Interactions are computed in a
``room`` of rows of SIZE numbers whose distances are known when it is compiled: only so can the
compiler tell that nothing that it writes is something that it still has to read.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from nnode.simulate._math import real

#: Numbers in a row of the room; ten rows of float32 stay in the first-level cache.
SIZE = 512
#: Rows are filled up to a multiple of this, so that loops leave nothing over.
LANES = 16
#: Options of functions that hold a loop.
LOOP: Any = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}


@njit(**LOOP)
def blank(rows: int, length: int, like: Any) -> Any:
    """Zeros ``(rows, length)`` of the type of the array ``like``."""
    return np.zeros((rows, length), like.dtype)


@njit(**LOOP)
def space(rows: int, like: Any) -> Any:
    """A room. What stands behind the numbers of a row is computed as well: ones at first, then
    what somebody was before; its weight is 0."""
    return np.ones(rows * SIZE, like.dtype)


@njit(**LOOP)
def clear(rows: Any) -> None:
    """Zeros in all rows of two axes."""
    for c in range(rows.shape[0]):
        for t in range(rows.shape[1]):
            rows[c, t] = 0


@njit(**LOOP)
def fold_in(rows: Any, more: Any) -> None:
    """Add rows to others."""
    for c in range(rows.shape[0]):
        for t in range(rows.shape[1]):
            rows[c, t] += more[c, t]


# Tables (., 2) say where a row begins in the room, and which row outside it is.


@njit(**LOOP)
def subtract(room: Any, table: Any, a: Any, low: int, b: Any, start: int, n: int) -> None:
    """Into the room: rows of a from ``low`` on, less those of b from ``start`` on."""
    for r in range(table.shape[0]):
        target, x, y = room[table[r, 0] :], a[table[r, 1], low:], b[table[r, 1], start:]
        for t in range(np.uint64(n)):
            target[t] = x[t] - y[t]


@njit(**LOOP)
def bring(room: Any, table: Any, a: Any, low: int, n: int) -> None:
    """Into the room: rows of a from ``low`` on."""
    for r in range(table.shape[0]):
        target, x = room[table[r, 0] :], a[table[r, 1], low:]
        for t in range(np.uint64(n)):
            target[t] = x[t]


@njit(**LOOP)
def less(room: Any, table: Any, a: Any, n: int) -> None:
    """From what is in the room: the first number of rows of a."""
    for r in range(table.shape[0]):
        target, first = room[table[r, 0] :], a[table[r, 1], 0]
        for t in range(np.uint64(n)):
            target[t] = target[t] - first


@njit(**LOOP)
def bring_back(a: Any, table: Any, low: int, room: Any, n: int) -> None:
    """Out of the room."""
    for r in range(table.shape[0]):
        x, source = a[table[r, 1], low:], room[table[r, 0] :]
        for t in range(np.uint64(n)):
            x[t] = source[t]


@njit(**LOOP)
def increase(a: Any, table: Any, low: int, room: Any, n: int) -> None:
    """Rows by what is in the room."""
    for r in range(table.shape[0]):
        x, source = a[table[r, 1], low:], room[table[r, 0] :]
        for t in range(np.uint64(n)):
            x[t] = x[t] + source[t]


@njit(**LOOP)
def decrease(a: Any, table: Any, low: int, room: Any, n: int) -> None:
    """Rows by what is in the room."""
    for r in range(table.shape[0]):
        x, source = a[table[r, 1], low:], room[table[r, 0] :]
        for t in range(np.uint64(n)):
            x[t] = x[t] - source[t]


@njit(**LOOP)
def add_product(a: Any, table: Any, low: int, there: Any, start: int, room: Any, n: int) -> None:
    """To rows what is in the room, of those who are there."""
    for r in range(table.shape[0]):
        x, y, source = a[table[r, 1], low:], there[start:], room[table[r, 0] :]
        for t in range(np.uint64(n)):
            x[t] = x[t] + y[t] * source[t]


@njit(**LOOP)
def subtract_product(
    a: Any, table: Any, low: int, there: Any, start: int, room: Any, n: int
) -> None:
    """From rows what is in the room, of those who are there."""
    for r in range(table.shape[0]):
        x, y, source = a[table[r, 1], low:], there[start:], room[table[r, 0] :]
        for t in range(np.uint64(n)):
            x[t] = x[t] - y[t] * source[t]


@njit(**LOOP)
def weigh(room: Any, table: Any, a: Any, low: int, there: Any, start: int, n: int) -> None:
    """Into the room: rows, of those who are there."""
    for r in range(table.shape[0]):
        target, x, y = room[table[r, 0] :], a[table[r, 1], low:], there[start:]
        for t in range(np.uint64(n)):
            target[t] = x[t] * y[t]


@njit(**LOOP)
def weigh_less(room: Any, table: Any, a: Any, low: int, there: Any, start: int, n: int) -> None:
    """From what is in the room: rows, of those who are there."""
    for r in range(table.shape[0]):
        target, x, y = room[table[r, 0] :], a[table[r, 1], low:], there[start:]
        for t in range(np.uint64(n)):
            target[t] = target[t] - x[t] * y[t]


@njit(**LOOP)
def clear_end(room: Any, table: Any, n: int, full: int) -> None:
    """Zeros behind the ``n`` numbers of rows: weights of what does not exist."""
    for r in range(table.shape[0]):
        row = room[table[r, 0] :]
        for t in range(np.uint64(n), np.uint64(full)):
            row[t] = 0


# Pairs (2, .) say who meets whom; receivers and sources are rows (., C) then.


@njit(**LOOP)
def subtract_pairs(room: Any, table: Any, own: Any, other: Any, pairs: Any) -> None:
    """Into the room: columns of the first less those of the second."""
    for r in range(table.shape[0]):
        target, c = room[table[r, 0] :], table[r, 1]
        for t in range(pairs.shape[1]):
            target[t] = own[pairs[0, t], c] - other[pairs[1, t], c]


@njit(**LOOP)
def bring_pairs(room: Any, table: Any, a: Any, who_of: Any) -> None:
    """Into the room: columns of one of both."""
    for r in range(table.shape[0]):
        target, c = room[table[r, 0] :], table[r, 1]
        for t in range(len(who_of)):
            target[t] = a[who_of[t], c]


@njit(**LOOP)
def bring_less(room: Any, table: Any, a: Any, who_of: Any) -> None:
    """From what is in the room: columns of one of both."""
    for r in range(table.shape[0]):
        target, c = room[table[r, 0] :], table[r, 1]
        for t in range(len(who_of)):
            target[t] -= a[who_of[t], c]


@njit(**LOOP)
def increase_pairs(a: Any, table: Any, room: Any, who_of: Any) -> None:
    """Columns of one of both by what is in the room."""
    for r in range(table.shape[0]):
        source, c = room[table[r, 0] :], table[r, 1]
        for t in range(len(who_of)):
            a[who_of[t], c] += source[t]


@njit(**LOOP)
def decrease_pairs(a: Any, table: Any, room: Any, who_of: Any) -> None:
    """Columns of one of both by what is in the room."""
    for r in range(table.shape[0]):
        source, c = room[table[r, 0] :], table[r, 1]
        for t in range(len(who_of)):
            a[who_of[t], c] -= source[t]


@njit(**LOOP)
def repeat(rows: Any, number: int, length: int) -> None:
    """The first numbers of rows once more behind them."""
    for c in range(number):
        for t in range(length):
            rows[c, length + t] = rows[c, t]


@njit(**LOOP)
def fold(rows: Any, both: Any, length: int) -> None:
    """Add what stands in rows and once more behind to other rows."""
    for c in range(rows.shape[0]):
        for t in range(length):
            rows[c, t] += both[c, t] + both[c, length + t]


@njit(**LOOP)
def filled(n: int) -> int:
    """The next multiple of LANES."""
    return (n + LANES - 1) // LANES * LANES


@njit(**LOOP)
def pieces(length: int) -> int:
    """Length of equal pieces of at most SIZE numbers."""
    number = max(1, (length + SIZE - 1) // SIZE)
    piece = max(1, (length + number - 1) // number)
    return filled(piece)


@njit(**LOOP)
def meeting(length: int, shift: int, number: int, mutual: bool) -> int:
    """Receivers that act at this shift: half of them where both partners would be one."""
    return length // 2 if mutual and 2 * shift == number else length


@njit(**LOOP)
def load(rows: Any, values: Any, members: Any, people: int) -> None:
    """Add values ``(B, N, C)`` to rows."""
    width = len(members)
    for b in range(width):
        for i in range(people):
            for c in range(values.shape[2]):
                rows[c, i * width + b] += values[members[b], i, c]


@njit(**LOOP)
def store(rows: Any, values: Any, members: Any, people: int) -> None:
    """Rows into values ``(B, N, C)``."""
    width = len(members)
    for b in range(width):
        for i in range(people):
            for c in range(values.shape[2]):
                values[members[b], i, c] = rows[c, i * width + b]


@njit(**LOOP)
def barrier(members: Any, people: int, number: int, table: Any) -> tuple[Any, Any]:
    """Rows ``(4, .)`` of walls or their points, which are ``number`` of the table ``(B, P, 5)``,
    and 1 where they exist; periodic."""
    width = len(members)
    length = (number + people) * width if number else 0
    rows, real_ones = blank(4, length, table), blank(1, length, table)[0]
    for p in range(length // width):
        for b in range(width):
            for c in range(4):
                rows[c, p * width + b] = table[members[b], p % number, c]
            real_ones[p * width + b] = table[members[b], p % number, 4]
    return rows, real_ones


@njit(**LOOP)
def keep(states: Any, begin: int, y: Any, sums: Any, table: Any) -> None:
    """Four rows of y, and rows of sums that a table names, into what is kept of a step."""
    length = sums.shape[1]
    for c in range(4):
        for t in range(length):
            states[begin + c * length + t] = y[c, t]
    for k in range(len(table)):
        for t in range(length):
            states[begin + (4 + k) * length + t] = sums[table[k, 1], t]


@njit(**LOOP)
def keep_back(states: Any, begin: int, y: Any, sums: Any, table: Any) -> None:
    """What was kept of a step."""
    length = sums.shape[1]
    for c in range(4):
        for t in range(length):
            y[c, t] = states[begin + c * length + t]
    for k in range(len(table)):
        for t in range(length):
            sums[table[k, 1], t] = states[begin + (4 + k) * length + t]


@njit(**LOOP)
def periods(move: Any, exists: Any, members: Any, end: Any, step: int, dt: Any) -> None:
    """Time step of every person, 0 for whoever stands still."""
    width = len(members)
    for b in range(width):
        now = dt if step <= end[members[b]] else real(0, dt)
        for at in range(b, len(move), width):
            move[at] = now * exists[at]


@njit(**LOOP)
def take(rows: Any, values: Any, chosen: Any) -> None:
    """Chosen rows of values ``(., C)``."""
    for k in range(len(chosen)):
        for c in range(values.shape[1]):
            rows[k, c] = values[chosen[k], c]


@njit(**LOOP)
def put(rows: Any, values: Any, chosen: Any) -> None:
    """Rows to chosen rows of values ``(., C)``."""
    for k in range(len(chosen)):
        for c in range(values.shape[1]):
            values[chosen[k], c] = rows[k, c]


@njit(**LOOP)
def who(exists: Any) -> Any:
    """Indices of what exists."""
    found, number = np.empty(len(exists), np.int64), 0
    for i in range(len(exists)):
        found[number] = i
        number += 1 if exists[i] > 0 else 0
    return found[:number]
