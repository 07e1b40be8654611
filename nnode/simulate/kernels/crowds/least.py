"""Smallest values over the others, and their gradients, in compiled code.

Everybody's smallest value stands in a row of sums, and in a row behind those the place of the
person who attains it, the first of several; -1 where it is nobody. Its gradient goes to the two of
them alone.
"""

from __future__ import annotations

from typing import Any

from numba import njit

from nnode.simulate.kernels.crowds.rows import LOOP

#: Everybody's smallest values; they are computed behind the sums, which they may depend on.
LEAST = """

@njit(**LOOP)
def into_{over}(room, own, low, other, start, sums, n):
    subtract(room, APART_{over}, own, low, other, start, n)
    bring(room, OWN_{over}, own, low, n)
    bring(room, OTHER_{over}, other, start, n)
    bring(room, FROM_{over}, sums, low, n)


@njit(**LOOP)
def least_{over}(room, own, length, there, width, q, t, dt, total, sums):
    nobody_yet(sums, SUMS_{over}, WHO_{over}, real({nobody}, dt), length)
    piece = pieces(length)
    for shift in range(1, length // width):
        for low in range(0, length, piece):
            n = min(piece, length - low)
            start = low + shift * width
            into_{over}(room, own, low, own, start, sums, n)
            law_{over}(room, 0, filled(n), q, t, dt, 0, total)
            least(sums, SUMS_{over}, WHO_{over}, low, there, start, length, room, n)


@njit(**LOOP)
def least_{over}_pull(
    room, own, length, width, q, t, dt, total, sums, weighed, to_own, to_other
):
    piece = pieces(length)
    # one after the other: each is attained by somebody else
    for which in range(len(WHO_{over})):
        for low in range(0, length, piece):
            n = min(piece, length - low)
            who = sums[WHO_{over}[which, 1], low:low + n]
            subtract_those(room, APART_{over}, own, low, who)
            bring(room, OWN_{over}, own, low, n)
            bring_those(room, OTHER_{over}, own, who)
            bring(room, FROM_{over}, sums, low, n)
            weigh_one(room, WEIGHTS_{over}, which, weighed, low, who)
            clear_end(room, WEIGHTS_{over}, n, filled(n))
            law_{over}_pull(room, 0, filled(n), q, t, dt, 0, total)
            increase(to_own, TO_BOTH_{over}, low, None, low, room, n)
            increase(to_own, TO_OWN_{over}, low, None, low, room, n)
            increase(weighed, TO_FROM_{over}, low, None, low, room, n)
            decrease_those(to_other, TO_BOTH_{over}, room, who)
"""


@njit(**LOOP)
def nobody_yet(sums: Any, table: Any, who: Any, value: Any, length: int) -> None:
    """Before anybody was met."""
    for r in range(table.shape[0]):
        for t in range(length):
            sums[table[r, 1], t], sums[who[r, 1], t] = value, -1


@njit(**LOOP)
def least(
    sums: Any, table: Any, who: Any, low: int, there: Any, start: int, length: int, room: Any,
    n: int,
) -> None:  # fmt: skip
    """What is in the room, where it is smaller, or as small and of an earlier person."""
    for r in range(table.shape[0]):
        best, whose, source = sums[table[r, 1], low:], sums[who[r, 1], low:], room[table[r, 0] :]
        for t in range(n):
            other, value = (start + t) % length, source[t]
            first = value == best[t] and other < whose[t]
            # a value that is no number stays
            if there[start + t] > 0 and (value < best[t] or first or value != value):
                best[t], whose[t] = value, other


@njit(**LOOP)
def subtract_those(room: Any, table: Any, own: Any, low: int, who: Any) -> None:
    """Into the room: rows less those of chosen people."""
    for r in range(table.shape[0]):
        target, x = room[table[r, 0] :], own[table[r, 1]]
        for t in range(len(who)):
            # ones of who meets nobody: no formula is in danger there
            target[t] = x[low + t] - (x[int(who[t])] if who[t] >= 0 else x[low + t] - 1)


@njit(**LOOP)
def bring_those(room: Any, table: Any, own: Any, who: Any) -> None:
    """Into the room: rows of chosen people."""
    for r in range(table.shape[0]):
        target, x = room[table[r, 0] :], own[table[r, 1]]
        for t in range(len(who)):
            target[t] = x[int(who[t])] if who[t] >= 0 else 1


@njit(**LOOP)
def weigh_one(room: Any, table: Any, which: int, weighed: Any, low: int, who: Any) -> None:
    """Into the room: the weights of one row, and zeros of the others."""
    for r in range(table.shape[0]):
        target, weight = room[table[r, 0] :], weighed[table[r, 1], low:]
        for t in range(len(who)):
            target[t] = weight[t] if r == which and who[t] >= 0 else 0


@njit(**LOOP)
def decrease_those(a: Any, table: Any, room: Any, who: Any) -> None:
    """Rows of chosen people by what is in the room."""
    for r in range(table.shape[0]):
        x, source = a[table[r, 1]], room[table[r, 0] :]
        for t in range(len(who)):
            if who[t] >= 0:
                x[int(who[t])] -= source[t]
