"""Compiled building blocks that all follow-the-leader laws share.

A block of ``width`` simulations is one row of numbers: vehicle i of simulation b stands at
``i * width + b``. The gap of everything is then one difference of two slices of the row, and
every loop runs over neighbouring numbers. Rows are padded, so that loops have no remainder:
what a loop leaves over after the last full vector is computed one by one.
"""

from __future__ import annotations

from typing import Any

from numba import njit

from nnode.solvers.fused._math import INLINE, real

#: Rows are padded to a multiple of this: four of the widest vectors of float32.
CHUNK = 64
#: Numbers between two rows of one array, where every simulation has its own parameters. Not a
#: power of two: rows would compete for the same lines of the cache.
APART = 1312

_SUM: Any = {**INLINE, "fastmath": {"contract", "nsz", "reassoc"}}
_SCALAR: Any = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}


@njit(**INLINE)
def padded(number: int) -> int:
    """The next multiple of CHUNK."""
    return (number + CHUNK - 1) // CHUNK * CHUNK


@njit(**_SUM)
def add(total: Any, value: Any) -> Any:
    """A sum whose order the compiler may choose; nothing else in a loop may be reordered."""
    return total + value


@njit(**_SCALAR)
def place(row: Any, values: Any, low: int, width: int) -> None:
    """Values (B, N) of the block's simulations into a row."""
    for i in range(values.shape[1]):
        for b in range(width):
            row[i * width + b] = values[low + b, i]


@njit(**_SCALAR)
def place_sum(row: Any, values: Any, low: int, width: int) -> None:
    """Add values (B, N) of the block's simulations to a row."""
    for i in range(values.shape[1]):
        for b in range(width):
            row[i * width + b] += values[low + b, i]


@njit(**_SCALAR)
def take(row: Any, values: Any, low: int, width: int) -> None:
    """A row into values (B, N) of the block's simulations."""
    for i in range(values.shape[1]):
        for b in range(width):
            values[low + b, i] = row[i * width + b]


@njit(**_SCALAR)
def place_leaders(
    row: Any, measured: Any, number: Any, step: int, per: int, low: int, width: int
) -> None:
    """Put the last vehicles where they were measured, linear between samples (K, B, N)."""
    k = min(step // per, measured.shape[0] - 2)
    fraction = real((step - k * per) / per, row[0])
    for b in range(width):
        i = number[low + b] - 1
        before = measured[k, low + b, i]
        row[i * width + b] = before + fraction * (measured[k + 1, low + b, i] - before)


@njit(**_SCALAR)
def masks(
    follow: Any,
    lead: Any,
    number: Any,
    end: Any,
    driven: bool,
    dt: Any,
    step: int,
    low: int,
    width: int,
) -> tuple[int, int]:
    """Time step of every follower and every leader at ``step``, 0 for what stands still.

    A simulation of ``number`` vehicles moves in its steps 0 ... ``end``. Leaders drive by
    themselves where ``driven``.

    Returns:
        the first and the last step for which this holds.
    """
    follow[:] = 0
    lead[:] = 0
    first, last = 0, 1 << 62
    for b in range(width):
        stop = end[low + b]
        if stop < step:
            first = max(first, stop + 1)
            continue
        last = min(last, stop)
        i = number[low + b] - 1
        for j in range(i):
            follow[j * width + b] = dt
        if driven:
            lead[i * width + b] = dt
    return first, last


@njit(**INLINE)
def gaps(ahead: Any, behind: Any, follow: Any, gap: Any) -> None:
    """Gaps of followers; 1 m for all others, which may be anywhere."""
    one = real(1, gap[0])
    zero = real(0, gap[0])
    for k in range(len(gap)):
        difference = ahead[k] - behind[k]
        gap[k] = difference if follow[k] > zero else one


@njit(**INLINE)
def advance(x: Any, follow: Any, speed: Any, lead: Any, v0: Any) -> None:
    """One Euler step."""
    for k in range(len(x)):
        x[k] = x[k] + (follow[k] * speed[k] + lead[k] * v0)


@njit(**INLINE)
def advance_compensated(x: Any, error: Any, follow: Any, speed: Any, lead: Any, v0: Any) -> None:
    """One Euler step that hands its rounding error to the next one (Kahan's summation).

    In float32 a vehicle 700 m from the origin moves in units of 0.06 mm, and steps of 30 mm
    would all be rounded in the same direction.
    """
    for k in range(len(x)):
        step = (follow[k] * speed[k] + lead[k] * v0) - error[k]
        moved = x[k] + step
        error[k] = (moved - x[k]) - step
        x[k] = moved


@njit(**INLINE)
def copy(source: Any, target: Any) -> None:
    for k in range(len(target)):
        target[k] = source[k]


@njit(**INLINE)
def weigh(adjoint: Any, follow: Any, weight: Any) -> Any:
    """Weights of the followers' speeds in the gradient, and their sum."""
    total = real(0, weight[0])
    for k in range(len(weight)):
        weight[k] = adjoint[k] * follow[k]
        total = add(total, weight[k])
    return total


@njit(**INLINE)
def pull_back(adjoint: Any, behind: Any, slope: Any, lead: Any) -> Any:
    """Adjoint of one step earlier; returns the weight of the leaders' speed."""
    total = real(0, adjoint[0])
    for k in range(len(adjoint)):
        total = add(total, adjoint[k] * lead[k])
        adjoint[k] = adjoint[k] + (behind[k] - slope[k])
    return total


@njit(**INLINE)
def weigh_lanes(adjoint: Any, follow: Any, weight: Any, total: Any) -> None:
    """As ``weigh``, with a sum for every number of the row."""
    for k in range(len(weight)):
        weight[k] = adjoint[k] * follow[k]
        total[k] = total[k] + weight[k]


@njit(**INLINE)
def pull_back_lanes(adjoint: Any, behind: Any, slope: Any, lead: Any, total: Any) -> None:
    """As ``pull_back``, with a sum for every number of the row."""
    for k in range(len(adjoint)):
        total[k] = total[k] + adjoint[k] * lead[k]
        adjoint[k] = adjoint[k] + (behind[k] - slope[k])


@njit(**INLINE)
def multiply(row: Any, factor: Any) -> None:
    for k in range(len(row)):
        row[k] = row[k] * factor[k]


@njit(**_SCALAR)
def spread(row: Any, values: Any, low: int, width: int, vehicles: int) -> None:
    """One value (B,) per simulation into a row, the same for all vehicles."""
    for i in range(vehicles):
        for b in range(width):
            row[i * width + b] = values[low + b]


@njit(**_SCALAR)
def collect(row: Any, values: Any, low: int, width: int, vehicles: int) -> None:
    """Add a row, summed over vehicles, to values (B,), and start a new one."""
    for i in range(vehicles):
        for b in range(width):
            values[low + b] += row[i * width + b]
            row[i * width + b] = 0
