"""Compiled building blocks of lanes, the same for every law.

A block of ``width`` simulations is one row of numbers: vehicle i of simulation b stands at
``i * w + b``, w >= width. What stands ahead of everything is then the row itself, w further on,
and every loop runs over neighbouring numbers.
"""

from __future__ import annotations

from typing import Any

from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from nnode.simulate.kernels.functions import INLINE, real

#: Rows are computed in multiples of this: four of the widest vectors of float32.
CHUNK = 64

_SCALAR: Any = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}


@njit(**INLINE)
def padded(number: int) -> int:
    """The next multiple of CHUNK."""
    return (number + CHUNK - 1) // CHUNK * CHUNK


@njit(**_SCALAR)
def place(row: Any, values: Any, low: int, width: int, w: int) -> None:
    """Add values ``(B, N)`` of the block's simulations to a row."""
    for i in range(values.shape[1]):
        for b in range(width):
            row[i * w + b] += values[low + b, i]


@njit(**_SCALAR)
def take(row: Any, values: Any, low: int, width: int, w: int) -> None:
    """A row into values ``(B, N)`` of the block's simulations."""
    for i in range(values.shape[1]):
        for b in range(width):
            values[low + b, i] = row[i * w + b]


@njit(**_SCALAR)
def spread(row: Any, values: Any, low: int, width: int, w: int, vehicles: int) -> None:
    """One value ``(B,)`` per simulation into a row, the same for all vehicles."""
    for i in range(vehicles):
        for b in range(width):
            row[i * w + b] = values[low + b]


@njit(**_SCALAR)
def collect(row: Any, values: Any, low: int, width: int, w: int, vehicles: int) -> None:
    """Add a row, summed over vehicles, to values ``(B,)``, and start a new one."""
    for i in range(vehicles):
        for b in range(width):
            values[low + b] += row[i * w + b]
            row[i * w + b] = 0


_memmove: Any = cgutils.raw_memmove


@intrinsic
def copy(typing_context: Any, target: Any, source: Any, number: Any) -> Any:
    """The first numbers of a row to another one, which may be the same array further on: a loop
    that cannot know how far would take them one by one."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        rows = [
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(signature.args[:2], args[:2], strict=True)
        ]
        _memmove(builder, *rows, args[2], context.get_abi_sizeof(rows[0].type.pointee))
        return context.get_dummy_value()

    return types.none(target, source, types.intp), emit


@njit(**_SCALAR)
def masks(
    behind: Any, second: Any, move: Any, first_move: Any, number: Any, end: Any, driven: bool,
    dt: Any, step: int, low: int, width: int, w: int, agents: int,
) -> tuple[int, int]:  # fmt: skip
    """Who follows somebody, who has a second vehicle ahead, and the time step of everybody who
    moves at ``step``, the vehicles of the first row apart.

    A simulation of ``number`` vehicles moves in its steps 0 ... ``end``. Leaders drive by
    themselves where ``driven``.

    Returns:
        the first and the last step for which this holds.
    """
    behind[:] = 0
    second[:] = 0
    move[:] = 0
    first_move[:] = 0
    first, last = 0, 1 << 62
    for b in range(width):
        stop = end[low + b]
        lead = number[low + b] - 1
        for j in range(lead):
            behind[j * w + b] = 1
            if j < lead - 1:
                second[j * w + b] = 1
        if stop < step:
            first = max(first, stop + 1)
            continue
        last = min(last, stop)
        for j in range(lead):
            move[j * w + b] = dt
        if driven:
            if lead == agents - 1:
                first_move[lead * w + b] = dt
            else:
                move[lead * w + b] = dt
    return first, last


@njit(**_SCALAR)
def lead_places(
    row: Any, path: Any, number: Any, step: int, per: int, fraction: Any, low: int, width: int,
    w: int,
) -> None:  # fmt: skip
    """Put what leaders have at the samples ``(K, B)``, linear between them, into their row.

    Args:
        fraction: of the step that has passed.
    """
    k = min(step // per, path.shape[0] - 2)
    part = real((step - k * per + fraction) / per, row[0])
    for b in range(width):
        i = number[low + b] - 1
        before = path[k, low + b]
        row[i * w + b] = before + part * (path[k + 1, low + b] - before)
