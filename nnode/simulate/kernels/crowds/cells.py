"""Cell lists: who is near whom, in time proportional to the number of people.

The plane is cut into square cells at least as wide as the cutoff, people are sorted by cell, and
partners are sought in neighbouring cells only. Cells of one row follow each other in memory, so
that the neighbours of a person are two or three ranges of the sorted people.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from nnode.errors import ConfigError
from nnode.simulate.kernels.crowds.rows import LOOP, scattered

#: Cells are a hair wider than the cutoff, so that no rounding puts partners two cells apart.
_WIDER = 1.0001


def check_cutoff(cutoff: float | None, cutoff_error: float, touching: float = 0.0) -> None:
    """Refuse what cannot be a cutoff.

    Args:
        cutoff: m, or None.
        cutoff_error: largest force left out of one partner, in units of A.
        touching: distance of people who touch, m; a cutoff must not leave out contacts.

    Raises:
        ConfigError: ``cutoff`` is not a number larger than ``touching``, or ``cutoff_error``
            lies outside [0, 1).
    """
    if cutoff is not None and not touching < cutoff < math.inf:
        raise ConfigError(
            f"solver.cutoff={cutoff} m must be larger than {touching:g} m"
            + (", the distance of people who touch" if touching else "")
            + "; null derives it from solver.cutoff_error"
        )
    if not 0 <= cutoff_error < 1:
        raise ConfigError(
            f"solver.cutoff_error={cutoff_error} must be at least 0 and below 1, for example 1e-10"
        )


def cutoff_distance(reach: float, decay: float, cutoff_error: float) -> float:
    """Distance (m) beyond which a social force is left out.

    The force of one partner at distance d is A exp((reach - d) / B) in the far field; contact
    and friction end at d = reach. Beyond

        reach + B log(1 / cutoff_error)

    one partner's force is below ``cutoff_error`` A, so with N people

    * the sum of all that is left out on one person is below N ``cutoff_error`` A: 1e-6 of the
      force A of a single touching partner for 10,000 people and the default of 1e-10;
    * the acceleration, a mean over the N people, is off by less than ``cutoff_error`` A / m.

    Both hold for every arrangement of people. At one person per square metre, those just beyond
    the cutoff c contribute about 2 pi c B ``cutoff_error`` A, for any N.

    Args:
        reach: distance at which bodies touch, m.
        decay: B, m.
        cutoff_error: largest force left out of one partner, in units of A.

    Raises:
        ConfigError: ``cutoff_error`` is not between 0 and 1.
    """
    if not 0 < cutoff_error < 1:
        raise ConfigError(
            f"solver.cutoff_error={cutoff_error} must lie between 0 and 1, for example 1e-10"
        )
    return reach + decay * math.log(1 / cutoff_error)


@njit(**LOOP)
def grid(x: Any, y: Any, cutoff: float) -> tuple[float, float, float, float, int, int]:
    """Cells around the points: smallest x and y, width of cells in x and y, cells in x and y.

    There are at most 4 cells per point: somebody who runs away makes the cells wider, not many.
    """
    left, right, low, high = np.inf, -np.inf, np.inf, -np.inf
    for i in range(len(x)):
        if np.isfinite(x[i]) and np.isfinite(y[i]):
            left, right = min(left, x[i]), max(right, x[i])
            low, high = min(low, y[i]), max(high, y[i])
    if not left <= right:
        return 0.0, 0.0, 1.0, 1.0, 1, 1
    least, most = cutoff * _WIDER, 4.0 * len(x) + 16
    across = math.floor(min((right - left) / least, 1e9)) + 1.0
    along = math.floor(min((high - low) / least, 1e9)) + 1.0
    while across * along > most:
        if across > along:
            across = math.ceil(across / 2)
        else:
            along = math.ceil(along / 2)
    wide, tall = max(least, (right - left) / across), max(least, (high - low) / along)
    return left, low, wide, tall, int(across), int(along)


@njit(**LOOP)
def sort(x: Any, y: Any, cells: Any) -> tuple[Any, Any, Any]:
    """Sort points by cell.

    Returns:
        order: indices of the points, cell after cell, row after row.
        cell: cell of the k-th point in this order.
        start: ``(cells + 1,)`` where every cell begins in this order.
    """
    left, low, wide, tall, across, along = cells
    at = np.empty(len(x), np.int32)
    start = np.zeros(across * along + 1, np.int32)
    for i in range(len(x)):
        at[i] = 0  # who is nowhere is put anywhere: no distance to him is small
        if np.isfinite(x[i]) and np.isfinite(y[i]):
            column = min(int((x[i] - left) / wide), across - 1)
            row = min(int((y[i] - low) / tall), along - 1)
            at[i] = row * across + column
        start[at[i] + 1] += 1
    for c in range(across * along):
        start[c + 1] += start[c]
    place = start[:-1].copy()
    order, cell = np.empty(len(x), np.int32), np.empty(len(x), np.int32)
    for i in range(len(x)):
        k = place[at[i]]
        place[at[i]] += 1
        order[k] = i
        cell[k] = at[i]
    return order, cell, start


@njit(**LOOP)
def with_room(pairs: Any, number: int) -> Any:
    """``pairs`` (2, ·), or a larger copy that holds ``number``."""
    if number <= pairs.shape[1]:
        return pairs
    larger = np.empty((2, 2 * number), pairs.dtype)
    larger[:, : pairs.shape[1]] = pairs
    return larger


@njit(**LOOP)
def people_near(
    x: Any, y: Any, cells: Any, cell: Any, start: Any, cutoff: Any, pairs: Any
) -> tuple[Any, int]:
    """All pairs closer than ``cutoff``, each once, of points sorted by :func:`sort`.

    Returns:
        ``pairs``, enlarged where needed, and the number of its columns that count.
    """
    across, along = cells[4], cells[5]
    found, square = 0, cutoff * cutoff
    for i in range(len(x)):
        row = cell[i] // across
        column = cell[i] - row * across
        left, right = max(column - 1, 0), min(column + 1, across - 1)
        # the rest of the own cell and the one to the right, then the row above
        for above in range(2 if row + 1 < along else 1):
            base = (row + above) * across
            low = start[base + left] if above else i + 1
            high = start[base + right + 1]
            pairs = with_room(pairs, found + high - low + 1)
            for j in range(low, high):
                dx, dy = x[i] - x[j], y[i] - y[j]
                # written always, kept where near: no branch to guess
                pairs[0, found], pairs[1, found] = i, j
                found += 1 if dx * dx + dy * dy < square else 0
    return pairs, found


@njit(**LOOP)
def points_near(
    x: Any, y: Any, x_point: Any, y_point: Any, cells: Any, start: Any, cutoff: Any, pairs: Any
) -> tuple[Any, int]:
    """All pairs of a person and a wall point closer than ``cutoff``; points are sorted."""
    left, low, wide, tall, across, along = cells
    found, square = 0, cutoff * cutoff
    for i in range(len(x)):
        to_right, to_top = (x[i] - left) / wide, (y[i] - low) / tall
        if not (-1 < to_right < across + 1 and -1 < to_top < along + 1):
            continue
        column, row = math.floor(to_right), math.floor(to_top)
        first, last = max(column - 1, 0), min(column + 1, across - 1)
        if first > last:
            continue
        for near in range(max(row - 1, 0), min(row + 2, along)):
            begin, stop = start[near * across + first], start[near * across + last + 1]
            pairs = with_room(pairs, found + stop - begin + 1)
            for p in range(begin, stop):
                dx, dy = x[i] - x_point[p], y[i] - y_point[p]
                pairs[0, found], pairs[1, found] = i, p
                found += 1 if dx * dx + dy * dy < square else 0
    return pairs, found


@njit(**LOOP)
def both_ways(pairs: Any, number: int) -> tuple[Any, int]:
    """Every pair in both orders, where the two forces are not opposite."""
    pairs = with_room(pairs, 2 * number)
    pairs[0, number : 2 * number] = pairs[1, :number]
    pairs[1, number : 2 * number] = pairs[0, :number]
    return pairs, 2 * number


@njit(**LOOP)
def with_oneself(pairs: Any, number: int, people: int) -> tuple[Any, int]:
    """The pairs, and everyone with himself."""
    pairs = with_room(pairs, number + people)
    for i in range(people):
        pairs[0, number + i] = pairs[1, number + i] = i
    return pairs, number + people


@njit(**LOOP)
def who(exists: Any) -> Any:
    """Indices of what exists."""
    found, number = np.empty(len(exists), np.int64), 0
    for i in range(len(exists)):
        found[number] = i
        number += 1 if exists[i] > 0 else 0
    return found[:number]


@njit(**LOOP)
def take(rows: Any, values: Any, chosen: Any) -> None:
    """Chosen columns of values into rows."""
    for k in range(len(chosen)):
        for c in range(rows.shape[0]):
            rows[c, k] = values[c, chosen[k]]


@njit(**LOOP)
def scene(
    exists: Any, table_points: Any, table_walls: Any, points: int, walls: int, cutoff: Any
) -> Any:
    """What does not move in a simulation: who exists; wall points by cell (4, P), their cells and
    where every cell begins; walls (4, W); everybody with every wall (2, N W)."""
    there = who(exists)
    solid = who(table_points[:points, 4])
    barriers = scattered(4, len(solid), table_points)
    take(barriers, table_points.T, solid)
    cells = grid(barriers[0], barriers[1], cutoff)
    order, _, start = sort(barriers[0], barriers[1], cells)
    take(barriers, table_points.T, solid[order])
    stand = who(table_walls[:walls, 4])
    long = scattered(4, len(stand), table_walls)
    take(long, table_walls.T, stand)
    every = np.empty((2, len(there) * len(stand)), np.int32)
    for k in range(every.shape[1]):
        every[0, k], every[1, k] = k // len(stand), k % len(stand)
    return there, barriers, cells, start, long, every


@njit(**LOOP)
def arranged(y: Any, own: Any, cutoff: Any, first: int, mutual: bool, pairs: Any) -> Any:
    """Sort people by cell into ``own``.

    Returns:
        their order, pairs of places in it, the number of those that count.
    """
    cells = grid(y[0], y[1], cutoff)
    order, cell, start = sort(y[0], y[1], cells)
    take(own, y, order)
    pairs, number = people_near(own[0], own[1], cells, cell, start, cutoff, pairs)
    if not mutual:
        pairs, number = both_ways(pairs, number)
    if first == 0:
        pairs, number = with_oneself(pairs, number, own.shape[1])
    return order, pairs, number
