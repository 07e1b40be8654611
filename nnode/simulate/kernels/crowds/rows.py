"""Compiled building blocks of crowds: numbers of pairs, brought into a room.

Whoever acts and whom he acts on stand in rows of arrays. ``n`` pairs of them are named by two
places: a number where they follow each other, so that a difference is one of two slices, and an
array of indices where they do not. Interactions are computed in a ``room`` of rows of SIZE numbers
whose distances are known when it is compiled: only so can the compiler tell that nothing that it
writes is something that it still has to read.

A block of ``width`` simulations is one row: person i of simulation b stands at ``i * width + b``.
Sources (people, wall points, walls) stand in longer rows that continue periodically. Receiver i
then meets source (i + shift) modulo their number, whatever the number of people and simulations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import overload

from nnode.simulate.kernels.functions import INLINE, real

#: Numbers in a row of the room; ten rows of float32 stay in the first-level cache.
SIZE = 512
#: Rows are filled up to a multiple of this, so that loops leave nothing over.
LANES = 16
#: Options of functions that hold a loop.
LOOP: Any = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}


def _since(row: Any, at: Any) -> Any:
    """A row from a place on, the row itself where there are many."""


@overload(_since, jit_options=INLINE, strict=False)
def _since_overload(row: Any, at: Any) -> Callable[..., Any]:
    if isinstance(at, types.Integer) and not isinstance(row, types.NoneType):
        return lambda row, at: row[at:]
    return lambda row, at: row


def _nth(at: Any, t: Any) -> Any:
    """Where the t-th number of a row since ``at`` stands."""


@overload(_nth, jit_options=INLINE, strict=False)
def _nth_overload(at: Any, t: Any) -> Callable[..., Any]:
    return (lambda at, t: t) if isinstance(at, types.Integer) else (lambda at, t: at[t])


def _share(there: Any, at: Any, t: Any, value: Any) -> Any:
    """``value`` of who is there; everybody is where ``there`` is None."""


@overload(_share, jit_options=INLINE, strict=False)
def _share_overload(there: Any, at: Any, t: Any, value: Any) -> Callable[..., Any]:
    if isinstance(there, types.NoneType):
        return lambda there, at, t, value: value
    return lambda there, at, t, value: there[_nth(at, t)] * value


@njit(**LOOP)
def blank(rows: int, length: int, like: Any) -> Any:
    """Zeros ``(rows, length)`` of the type of the array ``like``."""
    return np.zeros((rows, length), like.dtype)


@njit(**LOOP)
def scattered(rows: int, length: int, like: Any) -> Any:
    """The same, where all that somebody has stands together, for those found by their index."""
    return np.zeros((length, rows), like.dtype).T


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
def begin(room: Any, own: Any, low: int, n: int) -> None:
    """Into the room: a row; zeros behind it, in its sum and in its weight."""
    for j in range(SIZE):
        room[j] = room[SIZE + j] = room[2 * SIZE + j] = 0
    for j in range(n):
        room[j] = own[low + j]


# Tables (., 2) say where a row begins in the room, and which row outside it is.


@njit(**LOOP)
def subtract(room: Any, table: Any, a: Any, at: Any, b: Any, to: Any, n: int) -> None:
    """Into the room: rows of a less those of b."""
    for r in range(table.shape[0]):
        target = room[table[r, 0] :]
        x, y = _since(a[table[r, 1]], at), _since(b[table[r, 1]], to)
        for t in range(np.uint64(n)):
            target[t] = x[_nth(at, t)] - y[_nth(to, t)]


@njit(**LOOP)
def bring(room: Any, table: Any, a: Any, at: Any, n: int) -> None:
    """Into the room: rows of a."""
    for r in range(table.shape[0]):
        target, x = room[table[r, 0] :], _since(a[table[r, 1]], at)
        for t in range(np.uint64(n)):
            target[t] = x[_nth(at, t)]


@njit(**LOOP)
def less(room: Any, table: Any, a: Any, n: int) -> None:
    """From what is in the room: the first number of rows of a."""
    for r in range(table.shape[0]):
        target, first = room[table[r, 0] :], a[table[r, 1], 0]
        for t in range(np.uint64(n)):
            target[t] = target[t] - first


@njit(**LOOP)
def bring_back(a: Any, table: Any, at: Any, room: Any, n: int) -> None:
    """Out of the room."""
    for r in range(table.shape[0]):
        x, source = _since(a[table[r, 1]], at), room[table[r, 0] :]
        for t in range(np.uint64(n)):
            x[_nth(at, t)] = source[t]


@njit(**LOOP)
def increase(a: Any, table: Any, at: Any, there: Any, to: Any, room: Any, n: int) -> None:
    """Rows by what is in the room, of those who are there."""
    real_ones = _since(there, to)
    for r in range(table.shape[0]):
        x, source = _since(a[table[r, 1]], at), room[table[r, 0] :]
        for t in range(np.uint64(n)):
            i = _nth(at, t)
            x[i] = x[i] + _share(real_ones, to, t, source[t])


@njit(**LOOP)
def decrease(a: Any, table: Any, at: Any, there: Any, to: Any, room: Any, n: int) -> None:
    """Rows by what is in the room, of those who are there."""
    real_ones = _since(there, to)
    for r in range(table.shape[0]):
        x, source = _since(a[table[r, 1]], at), room[table[r, 0] :]
        for t in range(np.uint64(n)):
            i = _nth(at, t)
            x[i] = x[i] - _share(real_ones, to, t, source[t])


@njit(**LOOP)
def weigh(room: Any, table: Any, a: Any, at: Any, there: Any, to: Any, n: int) -> None:
    """Into the room: rows, of those who are there."""
    real_ones = _since(there, to)
    for r in range(table.shape[0]):
        target, x = room[table[r, 0] :], _since(a[table[r, 1]], at)
        for t in range(np.uint64(n)):
            target[t] = _share(real_ones, to, t, x[_nth(at, t)])


@njit(**LOOP)
def weigh_less(room: Any, table: Any, a: Any, at: Any, there: Any, to: Any, n: int) -> None:
    """From what is in the room: rows, of those who are there."""
    real_ones = _since(there, to)
    for r in range(table.shape[0]):
        target, x = room[table[r, 0] :], _since(a[table[r, 1]], at)
        for t in range(np.uint64(n)):
            target[t] = target[t] - _share(real_ones, to, t, x[_nth(at, t)])


@njit(**LOOP)
def clear_end(room: Any, table: Any, n: int, full: int) -> None:
    """Zeros behind the ``n`` numbers of rows: weights of what does not exist."""
    for r in range(table.shape[0]):
        row = room[table[r, 0] :]
        for t in range(np.uint64(n), np.uint64(full)):
            row[t] = 0


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
def seats(members: Any, people: int, every: int) -> Any:
    """Places among all ``every`` people of all simulations of those of a block."""
    width = len(members)
    found = np.empty(people * width, np.int64)
    for b in range(width):
        for i in range(people):
            found[i * width + b] = members[b] * every + i
    return found


@njit(**LOOP)
def load(rows: Any, values: Any, chosen: Any) -> None:
    """Add values ``(B, N, C)`` of chosen people to rows."""
    flat = values.reshape(values.shape[0] * values.shape[1], values.shape[2])
    for t in range(len(chosen)):
        for c in range(flat.shape[1]):
            rows[c, t] += flat[chosen[t], c]


@njit(**LOOP)
def store(rows: Any, values: Any, chosen: Any) -> None:
    """Rows into values ``(B, N, C)`` of chosen people."""
    flat = values.reshape(values.shape[0] * values.shape[1], values.shape[2])
    for t in range(len(chosen)):
        for c in range(flat.shape[1]):
            flat[chosen[t], c] = rows[c, t]


@njit(**LOOP)
def barrier(members: Any, people: int, number: int, table: Any) -> tuple[Any, Any]:
    """Rows ``(4, .)`` of walls or their points, which are ``number`` of the table ``(B, P, 5)``,
    and 1 where they exist; periodic, LANES numbers more."""
    width = len(members)
    length = (number + people) * width if number else 0
    rows, real_ones = blank(4, length, table), blank(1, length + LANES, table)[0]
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
